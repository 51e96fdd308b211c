"""What benchmarks share: where real logs lie, simulated logs and runs kept in a cache, a process of its own."""

from __future__ import annotations

import os
import sys
import tempfile
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Matrix, Trajectory
from scanchain.evaluation import absolute_error, pair
from scanchain.evaluation.pairing import nearest
from scanchain.maps import SavedMap
from scanchain.simulation import SENSORS, WORLDS, Drive, record
from tests.support import made

CACHE = Path(tempfile.gettempdir()) / "scanchain_benchmarks"
LIDARS = [name for name, sensor in SENSORS.items() if sensor.dimension == 3]
PLACES = [name for name, world in WORLDS.items() if world.sensor in LIDARS and name != "garage"]
SEQUENCES = {"worlds": ",".join(PLACES), "sensors": ",".join(LIDARS), "scans": 300}  # simulated: options
KITTI = ("kitti_0005_first60.mcap", "kitti_0001_first54.mcap")


def options_of(text: str | None, argument: str = "", *, cache: bool = True, **defaults: object) -> Namespace:
    """What the command line says, whose help is the text of the benchmark.

    A default tells the type of its option. Of a list or the keys of a dict there may be several; a tuple has the
    choices, a type stands for no default. ``argument`` is the one without dashes.
    """
    command = f"python -m tests.benchmarks.{Path(sys.argv[0]).stem}"
    parser = ArgumentParser(command, description=text, formatter_class=RawDescriptionHelpFormatter)
    for name, default in (defaults | ({"cache": CACHE} if cache else {})).items():
        how: dict[str, object] = {"type": type(default), "default": default, "help": "default: %(default)s"}
        if default is False:
            how = {"action": "store_true"}
        elif isinstance(default, tuple):
            how = {"choices": default}
        elif isinstance(default, type):
            how = {"type": default}
        elif isinstance(default, list | dict):
            values = list(default)
            how |= {"default": values, "nargs": "*", "type": type(values[0]) if values else str}
            how |= {"choices": values} if isinstance(default, dict) else {}
        parser.add_argument(name if name == argument else f"--{name.replace('_', '-')}", **how)
    return parser.parse_args()


def table(*heads: str) -> Callable[..., None]:
    """Print the head of a Markdown table; a function that prints a row of these cells."""
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}", flush=True)
    return lambda *cells: print(f"| {' | '.join(map(str, cells))} |", flush=True)


def settings_of(words: Iterable[str]) -> dict[str, object]:
    """``log.every=2`` as the keyword of a function of the library."""
    return {key.replace(".", "__"): value for key, _, value in (word.partition("=") for word in words)}


def drive_of(world: str, sensor: str, scans: int, cache: Path, seed: int = 1, **options: object) -> Path:
    """The simulated log of the first scans of a world."""
    duration_s = min(WORLDS[world].duration_s, scans * SENSORS[sensor].period_ns * 1e-9)
    return made.log(world, folder=cache, seed=seed, seconds=duration_s, sensor=sensor, **options)


def recorded(name: str, drive: Drive, cache: Path) -> Path:
    """The log of a drive, made once."""
    return made.recorded(name, lambda draft: record(drive, draft, force=True), cache)


def in_fresh_process(function: Callable, *arguments: object) -> object:
    """The function's answer from a process of its own: GenZ-ICP remembers its last log, others may crash.

    Threads wait asleep there: small_gicp's spin by default, and where somebody else has one of two cores they
    spin away the time that the other thread needs.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as executor:
        return executor.submit(function, *arguments).result()


def poses_at(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> Matrix:
    """Poses nearest in time."""
    return trajectory.poses[nearest(stamps_ns, trajectory.stamps_ns)[0]]


def true_in_map(prior: SavedMap, map_truth: Trajectory, poses: Matrix) -> tuple[Matrix, NDArray[np.float64]]:
    """True poses (N, 4, 4) in the frame of a map, as it lies around them, and distances from its keyframes (N,).

    Both are seen from the keyframe that is nearest in truth, which leaves out the map's own error.
    """
    poses, map_poses = lie.lift(poses), lie.lift(prior.poses)
    true = lie.lift(poses_at(map_truth, np.array([keyframe.stamp_ns for keyframe in prior.keyframes])))
    away_m, nearest = KDTree(true[:, :3, 3]).query(poses[:, :3, 3])
    return map_poses[nearest] @ lie.inverse(true[nearest]) @ poses, away_m


def ate_m(estimate: Trajectory, truth: Trajectory) -> float:
    """Root mean square position error after rigid alignment."""
    return absolute_error(pair(estimate, truth).after_start).translation_m.rmse
