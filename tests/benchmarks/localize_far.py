"""Localization in a town of many kilometers: memory of ``localize`` and ``run``, and scans that a search holds up.

    python -m tests.benchmarks.localize_far [--km 10] [--sensor vlp-16] [--every 2] [--starts 8] [--copies 1]
        [--at-once]

A town with so many kilometers of streets, each of which is driven once, is simulated with every so many sweeps of
a lidar, and mapped by ``run``; on another day, with other parked cars, it is driven the other way round. Memory
is the peak of the resident memory of ``run`` and of ``localize`` with that log, each a process of its own, with
what is written at the end. ``starts``: the log begins at scans spread evenly over it, and goes on until it is
found, or for 60 m: path and scans until then, the longest scan and the mean in CPU time, the first three left
out. With ``at-once`` a search is completed in one scan, as the command ``localize`` does. With ``copies``, the
map stands there so many times side by side, every other one mirrored, later pairs longer.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from time import perf_counter, thread_time

import numpy as np
from numpy.typing import NDArray

from scanchain.config import LogConfig
from scanchain.data import Keyframe, KeyframePoints, Matrix, Points
from scanchain.logs import open_log
from scanchain.maps import open_saved_map
from scanchain.maps.saved_map import write_saved_map
from scanchain.sessions.localizer import Localizer, MapState
from scanchain.settings import load_settings
from scanchain.simulation.drive import plan, record
from scanchain.simulation.worlds import WORLDS, World, outdoor
from tests.benchmarks.odometry3d_set import simulator_version

CACHE = Path(tempfile.gettempdir()) / "scanchain_localize_far"
STREET_M, BLOCK_M = 1000.0, (50.0, 40.0)
SEED, GIVEN_UP_M, WARM_UP = 1, 60.0, 3
MEAN_SPEED_M_S = 8.7  # bends included


def city(km: float) -> World:
    """A town whose streets that run east, a kilometer each, are so many kilometers together."""
    x_m = np.arange(0.0, min(STREET_M, 1e3 * km) + 1.0, BLOCK_M[0])
    y_m = np.arange(max(round(1e3 * km / STREET_M), 2)) * BLOCK_M[1]
    build = partial(outdoor.town, streets_x_m=x_m.tolist(), streets_y_m=y_m.tolist())
    return replace(WORLDS["town"], build=build, route=_serpentine(x_m[0], x_m[-1], y_m))


def _serpentine(west_m: float, east_m: float, streets_y_m: Matrix) -> Matrix:
    """Every street from end to end, one after the other."""
    ends = ((west_m, east_m), (east_m, west_m))
    return np.array([(x, y) for k, y in enumerate(streets_y_m.tolist()) for x in ends[k % 2]])


def log_of(world: str, name: str, cache: Path, *, sensor: str, every: int, **options: object) -> Path:
    """The simulated log of every so many sweeps, made if it is not there yet."""
    path = cache / simulator_version() / f"{world}_{name}_{sensor}_{every}.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        drive = plan(world, seed=SEED, sensor=sensor, **options)  # pyright: ignore[reportArgumentType]
        changed = options.get("changed")
        draft = path.with_suffix(".draft.mcap")
        thinned = replace(drive, scans=drive.scans[::every])
        record(thinned, draft, seed=SEED, changed=changed, force=True)  # pyright: ignore[reportArgumentType]
        draft.with_suffix(".tum").unlink()
        draft.rename(path)
    return path


def peak_mib(*arguments: str) -> tuple[float, float]:
    """Peak of the resident memory of a command of scanchain, MiB, and its seconds."""
    started = perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "scanchain", *arguments], stdout=subprocess.DEVNULL)
    status, usage = os.wait4(process.pid, 0)[1:]
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"scanchain {' '.join(arguments)}: exit code {process.returncode}")
    return usage.ru_maxrss / 1024.0, perf_counter() - started


def repeated(run: Path, copies: int) -> Path:
    """The map of a run and its copies, in a folder of its own."""
    folder = run.with_suffix(f".{copies}")
    if not folder.exists():
        prior = open_saved_map(run)
        width_m = 1.5 * float(np.ptp(prior.poses[:, 1, 3])) + 200.0
        keyframes = [_copy(keyframe, k, width_m) for k in range(copies) for keyframe in prior.keyframes]
        poses = np.array([keyframe.T_odom_lidar for keyframe in keyframes])
        session = np.zeros(len(keyframes), np.int64)
        write_saved_map(folder, keyframes, poses, session, prior.sessions, prior.edges)
    return folder


@dataclass(frozen=True, slots=True)
class Stretched:
    """Points of a keyframe, stretched along the axes (3,)."""

    stored: KeyframePoints
    stretch: NDArray[np.float64]

    def read(self) -> Points:
        return self.stored.read() * self.stretch


def _copy(keyframe: Keyframe, number: int, width_m: float) -> Keyframe:
    size = 1.0 + 0.1 * (number // 2)
    stretch = np.array([size, -size if number % 2 else size, size])
    T = keyframe.T_odom_lidar.copy()
    flip = np.sign(stretch)
    T[:3, :3] = flip[:, None] * T[:3, :3] * flip
    T[:3, 3] = stretch * T[:3, 3] + [0.0, number * width_m, 0.0]
    return replace(keyframe, stored=Stretched(keyframe.stored, stretch), T_odom_lidar=T)


def searched(log_path: Path, run: Path, starts: int, *, is_live: bool) -> None:
    """Begin the log at several scans: a line each."""
    config = load_settings(3).config
    started = perf_counter()
    prior = open_saved_map(run)
    opened_s = perf_counter() - started
    log = open_log([log_path], LogConfig())
    count = len(log.ground_truth())
    print(f"map of {len(prior.keyframes):,} keyframes, opened in {opened_s:.2f} s")
    print(f"{'scan':>6}{'found m':>9}{'scans':>7}{'longest ms':>12}{'mean ms':>9}")
    for first in np.linspace(0, 0.9 * count, starts + 1).astype(int).tolist():
        localizer = Localizer(prior, config, log.T_base_lidar, is_live=is_live)
        spent_s: list[float] = []
        for scan in islice(log.scans(config.preprocess), first, None):
            begun = thread_time()
            placed = localizer.process(replace(scan, index=len(spent_s)))
            spent_s.append(thread_time() - begun)
            if placed.state is not MapState.SEARCHING or localizer.traveled_m[-1] > GIVEN_UP_M:
                break
        warm = spent_s[WARM_UP:] or spent_s
        where = "never" if placed.state is MapState.SEARCHING else f"{localizer.traveled_m[-1]:.1f}"
        if first:  # the first start compiles
            longest_ms, mean_ms = 1e3 * max(warm), 1e3 * np.mean(warm)
            print(f"{first:6}{where:>9}{len(spent_s):7}{longest_ms:12.0f}{mean_ms:9.0f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--km", type=float, default=10.0, help="of streets, default: %(default)s")
    parser.add_argument("--sensor", default="vlp-16", help="default: %(default)s")
    parser.add_argument("--every", type=int, default=2, help="sweeps a scan, default: %(default)s")
    parser.add_argument("--starts", type=int, default=8, help="default: %(default)s")
    parser.add_argument("--copies", type=int, default=1, help="of the map, default: %(default)s")
    parser.add_argument("--at-once", action="store_true", help="searches in one scan, instead of live")
    parser.add_argument("--memory", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--cache", type=Path, default=CACHE)
    arguments = parser.parse_args()
    world = f"city-{arguments.km:g}"
    WORLDS[world] = city(arguments.km)
    duration_s = 1e3 * arguments.km / MEAN_SPEED_M_S
    options = {"sensor": arguments.sensor, "every": arguments.every, "duration_s": duration_s}
    log = log_of(world, "map", arguments.cache, **options)
    again = log_of(world, "log", arguments.cache, **options, changed=1, reverse=True)
    run, out = log.with_suffix(".run"), log.with_suffix(".localized")
    if not run.exists():
        report("run", *peak_mib("run", str(log), "--out", str(run)))
    if arguments.memory:
        found = ("localize", str(again), "--map", str(run), "--out", str(out), "--force")
        report("localize", *peak_mib(*found))
    if arguments.starts:
        prior = run if arguments.copies == 1 else repeated(run, arguments.copies)
        searched(again, prior, arguments.starts, is_live=not arguments.at_once)


def report(command: str, memory_mib: float, seconds: float) -> None:
    print(f"{command:10}{memory_mib:8.0f} MiB at most{seconds:8.0f} s", flush=True)


if __name__ == "__main__":
    main()
