"""Localization in a map from nowhere: ``python -m tests.benchmarks.localize``.

    [--world intel|aces|identical ...] [--starts N] [--half 0|1] [--cache DIR] [--verbose]

From each start a log begins anew, in a map of another log or of an earlier part of its own, and is processed until
it is found and ``AFTER_M`` farther, or until it has traveled ``GIVE_UP_M``; logs of other places are run whole by
``tests.benchmarks.foreign``. Starts are evenly spread over places
that the map has seen: of the scans of the next ``SEEN_M`` the share ``SEEN_SHARE`` of points lies on its points.
Maps, logs and references stay in the cache. --half takes every second start.

  found     travel until the first accepted closure to the map
  wrong     a pose after that is more than 0.5 m or 5° off the reference
  error     median over the scans after that. The reference is the truth of a simulated log; of a real one it is
            SLAM over the whole log, moved to the map's nearest keyframe
  time      CPU time a scan, over that of odometry alone on the same scans
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scanchain import lie
from scanchain.api import open_recorder
from scanchain.data import ClosureVerdict, Matrix, Scan
from scanchain.logs import open_log
from scanchain.maps import SavedMap, open_saved_map
from scanchain.odometry import Odometry
from scanchain.runs.job import Job, Progress
from scanchain.runs.run import run
from scanchain.settings import load_settings, overrides_of
from scanchain.simulation import plan, record
from scanchain.slam import Slam
from scanchain.trajectory import read_tum

DATA = Path(os.environ.get("SCANCHAIN_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
SEEN_M, SEEN_SHARE, ON_MAP_M = 5.0, 0.6, 0.2
GIVE_UP_M, AFTER_M = 15.0, 3.0
WRONG_M, WRONG_RAD = 0.5, np.radians(5.0)
FOUND_M = (5.0, 10.0)


@dataclass(frozen=True, slots=True)
class Case:
    """A map, a log to localize in it, and the poses of both by one reference.

    ``map_poses`` are those of the scans that the map was made of, ``poses`` of the log's, ``first`` is its first
    scan that may be started from.
    """

    map: SavedMap
    log: Path
    map_poses: Matrix
    poses: Matrix
    first: int = 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """The travel until the log was found, infinite if it was not; errors (M, 2) of poses after that; CPU times."""

    found_m: float
    errors: NDArray[np.float64]
    is_wrong: bool
    slam_s: float
    odometry_s: float


def map_of(log: Path, out: Path, **options: object) -> Path:
    """The run directory of a log, made unless it is there."""
    if not (out / "map").is_dir():
        run(
            Job((log,), out, overrides=overrides_of(options), sinks=frozenset(), force=True),
            open_recorder,
            Progress(),
        )
    return out


def later_part(name: str, end_s: float) -> Callable[[Path], Case]:
    """A log, in the map of its first seconds."""

    def case(cache: Path) -> Case:
        log = DATA / "2d" / f"{name}.mcap"
        saved = open_saved_map(map_of(log, cache / f"{name}_{end_s:g}", log__end_s=end_s))
        poses = lie.flatten(read_tum(map_of(log, cache / name) / "trajectory.tum").poses)
        return Case(saved, log, poses, poses, max(keyframe.scan_index for keyframe in saved.keyframes) + 1)

    return case


def driven_twice(world: str, **options: float) -> Callable[[Path], Case]:
    """A simulated world, in the map of another drive through it."""

    def case(cache: Path) -> Case:
        first, second = plan(world, seed=0, **options), plan(world, seed=1, **options)
        drives = {f"{world}_map": (first, 0), f"{world}_log": (replace(second, solids=first.solids), 1)}
        for name, (drive, seed) in drives.items():
            if not (cache / f"{name}.mcap").exists():
                record(drive, cache / f"{name}.mcap", seed=seed, force=True)
        saved = open_saved_map(map_of(cache / f"{world}_map.mcap", cache / f"{world}_map"))
        return Case(saved, cache / f"{world}_log.mcap", first.truth().poses, second.truth().poses)

    return case


WORLDS: dict[str, Callable[[Path], Case]] = {
    "intel": later_part("intel", 1400.0),
    "aces": later_part("aces", 700.0),
    "identical": driven_twice("identical"),
}


def in_map(case: Case) -> Matrix:
    """(N, d+1, d+1) T_map_lidar of the log's scans by the reference, as seen from the map's nearest keyframe."""
    reference = case.map_poses[[keyframe.scan_index for keyframe in case.map.keyframes]]
    nearest = cKDTree(reference[:, :-1, -1]).query(case.poses[:, :-1, -1])[1]
    return case.map.poses[nearest] @ lie.between(reference[nearest], case.poses)


def starts_of(case: Case, scans: Sequence[Scan], poses: Matrix) -> NDArray[np.int64]:
    """Scans from which the log may begin."""
    surfaces = cKDTree(np.vstack([lie.transform(k.T_odom_lidar, k.points[::2]) for k in case.map.keyframes]))
    stride = 5
    some = np.arange(case.first, len(scans), stride)
    share = np.array([
        np.mean(surfaces.query(lie.transform(poses[i], scans[i].points[::3].astype(float)))[0] < ON_MAP_M)
        for i in some.tolist()
    ])  # fmt: skip
    traveled = np.cumsum(np.append(0.0, np.linalg.norm(np.diff(poses[some][:, :-1, -1], axis=0), axis=1)))
    ends = np.searchsorted(traveled, traveled + SEEN_M)
    is_seen = [
        share[k] > SEEN_SHARE and share[k : end + 1].mean() > SEEN_SHARE and traveled[-1] > traveled[k] + GIVE_UP_M
        for k, end in enumerate(ends.tolist())
    ]
    return some[is_seen]


def localized(case: Case, scans: Sequence[Scan], start: int, poses: Matrix) -> Outcome:
    """What becomes of the log that begins at this scan."""
    config, T_base_lidar = load_settings(case.map.dimension).config, open_log([case.log]).T_base_lidar
    slam, began_s = Slam(config, T_base_lidar, prior=case.map), time.process_time()
    found_m, traveled_m, count = np.inf, 0.0, 0
    errors: list[tuple[float, float]] = []
    T_last = None
    for scan in scans[start:]:
        step = slam.process(scan)
        count += 1
        traveled_m += 0.0 if T_last is None else lie.apart(T_last, step.T_odom_lidar)[0]
        T_last = step.T_odom_lidar
        if np.isfinite(found_m):
            errors.append(lie.apart(poses[scan.index], step.T_world_lidar))
        is_found = any(c.verdict is ClosureVerdict.ACCEPTED and c.target < slam.trail.first for c in step.closures)
        if is_found and np.isinf(found_m):
            found_m = traveled_m
        if traveled_m > min(found_m + AFTER_M, GIVE_UP_M):
            break
    slam_s, began_s = time.process_time() - began_s, time.process_time()
    odometry = Odometry(config, T_base_lidar)
    for scan in scans[start : start + count]:
        odometry.process(scan)
    odometry_s = time.process_time() - began_s
    found = np.array(errors).reshape(-1, 2)
    is_wrong = bool((found > (WRONG_M, WRONG_RAD)).any())
    return Outcome(found_m, found, is_wrong, slam_s, odometry_s)


def row(name: str, outcomes: Sequence[Outcome]) -> str:
    """The line of the table for one world."""
    found_m = np.array([each.found_m for each in outcomes])
    errors = np.vstack([each.errors for each in outcomes if not each.is_wrong])
    m, rad = np.median(errors, axis=0) if len(errors) else (np.nan, np.nan)
    ratio = sum(each.slam_s for each in outcomes) / max(sum(each.odometry_s for each in outcomes), 1e-9)
    shares = " | ".join(f"{100.0 * np.mean(found_m <= limit):.1f} %" for limit in FOUND_M)
    wrong = sum(each.is_wrong for each in outcomes)
    error = f"{100.0 * m:.1f} cm, {np.degrees(rad):.2f}°"
    return f"| {name} | {len(outcomes)} | {shares} | {wrong} | {error} | {ratio:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", nargs="+", choices=list(WORLDS), default=list(WORLDS))
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--half", type=int, choices=(0, 1))
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--verbose", action="store_true", help="print a line for each start")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        cache = options.cache or Path(folder)
        cache.mkdir(parents=True, exist_ok=True)
        limits = " | ".join(f"within {limit:g} m" for limit in FOUND_M)
        print(f"| world | starts | {limits} | wrong | error | time |\n|---|---|---|---|---|---|---|")
        for name in options.world:
            case = WORLDS[name](cache)
            scans, poses = list(open_log([case.log]).scans()), in_map(case)
            seen = starts_of(case, scans, poses)
            starts = seen[np.linspace(0, len(seen) - 1, min(options.starts, len(seen))).astype(int)]
            if options.half is not None:
                starts = starts[options.half :: 2]
            outcomes = []
            for start in starts.tolist():
                outcomes.append(localized(case, scans, start, poses))
                if options.verbose:
                    last = outcomes[-1]
                    worst = np.round(last.errors.max(axis=0, initial=0.0), 3).tolist()
                    print(
                        f"start {start}: {last.found_m:.1f} m {worst} {'WRONG' if last.is_wrong else ''}",
                        flush=True,
                    )
            print(row(name, outcomes), flush=True)


if __name__ == "__main__":
    main()
