"""What benchmarks share: where real logs lie, simulated logs and runs kept in a cache, a process of its own."""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Matrix, Trajectory
from scanchain.evaluation import absolute_error, pair
from scanchain.maps import SavedMap
from scanchain.simulation import SENSORS, WORLDS, Drive, record
from tests.support import made

CACHE = Path(tempfile.gettempdir()) / "scanchain_benchmarks"
LIDARS = [name for name, sensor in SENSORS.items() if sensor.dimension == 3]
PLACES = [name for name, world in WORLDS.items() if world.sensor in LIDARS]
KITTI = ("kitti_0005_first60.mcap", "kitti_0001_first54.mcap")

Answer = TypeVar("Answer")


def command_line(description: str | None, *, cache: bool = True) -> argparse.ArgumentParser:
    """A parser whose help is the text of the benchmark; with the folder of what is made once."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    if cache:
        parser.add_argument("--cache", type=Path, default=CACHE, help="default: %(default)s")
    return parser


def choose_sequences(parser: argparse.ArgumentParser, *, worlds: Iterable[str] = PLACES, scans: int = 300) -> None:
    """Options that choose among the simulated sequences."""
    parser.add_argument("--worlds", default=",".join(worlds), help="default: %(default)s")
    parser.add_argument("--sensors", default=",".join(LIDARS), help="default: %(default)s")
    parser.add_argument("--scans", type=int, default=scans, help="at most, default: %(default)s")


def table(*heads: str) -> Callable[..., None]:
    """Print the head of a Markdown table; a function that prints a row of these cells."""
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}", flush=True)
    return lambda *cells: print(f"| {' | '.join(map(str, cells))} |", flush=True)


def settings_of(words: Iterable[str]) -> dict[str, object]:
    """``log.every=2`` as the keyword of a function of the library."""
    return {key.replace(".", "__"): value for key, _, value in (word.partition("=") for word in words)}


def drive_of(world: str, sensor: str, scans: int, cache: Path, seed: int = 1) -> Path:
    """The simulated log of the first scans of a world."""
    duration_s = min(WORLDS[world].duration_s, scans * SENSORS[sensor].period_ns * 1e-9)
    return made.log(world, folder=cache, seed=seed, seconds=duration_s, sensor=sensor)


def recorded(name: str, drive: Drive, cache: Path) -> Path:
    """The log of a drive, made once."""
    return made.recorded(name, lambda draft: record(drive, draft, force=True), cache)


def in_fresh_process(function: Callable[..., Answer], *arguments: object) -> Answer:
    """The function's answer from a process of its own: GenZ-ICP remembers its last log, others may crash.

    Threads wait asleep there: small_gicp's spin by default, and where somebody else has one of two cores they
    spin away the time that the other thread needs.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as executor:
        return executor.submit(function, *arguments).result()


def traveled_m(poses: Matrix) -> NDArray[np.float64]:
    """(N,) path up to each pose."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)))


def poses_at(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> Matrix:
    """Poses nearest in time."""
    order = np.argsort(trajectory.stamps_ns, kind="stable")
    stamps = trajectory.stamps_ns[order]
    after = np.clip(np.searchsorted(stamps, stamps_ns), 1, len(stamps) - 1)
    nearer = after - (stamps_ns - stamps[after - 1] < stamps[after] - stamps_ns)
    return trajectory.poses[order[nearer]]


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
    return absolute_error(pair(estimate, truth)).translation_m.rmse
