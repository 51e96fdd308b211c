"""Localization of 3D logs in a map from nowhere: how soon, how surely, how accurately, and what it costs.

    python -m tests.benchmarks.localize3d [--cases same,changed,...] [--starts 100] [--tracked 1] [--seed 1]

A town is mapped with an HDL-64 by ``run``. A log of another drive starts at scans spread evenly over it, and each
start goes on until it is found, or for 40 m. A start is found where the state is no longer ``searching``, within
10 m if the truth has not gone on farther by then; it is wrong if its first known pose is more than 1 m or 3° off.
ATE is that of the whole log, begun in the first scan and smoothed in the end: distance to the truth, both seen
from the keyframe of the map that is nearest in truth, which leaves out the map's own error; ``live`` is that known
at the time. The ratio is the CPU time of a scan over that of odometry alone, after the first quarter of the log.

Cases: the same drive again (``same``); another day, the other way round, from elsewhere, with other parked cars
and people (``changed``); that with other lidars (``vlp-16``, ``os1-32``); ``rounds`` the other way round; a forest
in the map of the town (``forest``), and in its own.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, thread_time

import numpy as np
import psutil

import scanchain
from scanchain import lie
from scanchain.config import LogConfig
from scanchain.data import Matrix, Scan, Trajectory
from scanchain.logs import open_log
from scanchain.maps import SavedMap, open_saved_map
from scanchain.odometry import Odometry
from scanchain.sessions.localizer import Localizer, MapState
from scanchain.settings import load_settings
from scanchain.simulation import simulate
from tests.benchmarks.contest import in_fresh_process
from tests.benchmarks.odometry3d_set import simulator_version

WITHIN_M, GIVEN_UP_M, WRONG_M, WRONG_RAD = 10.0, 40.0, 1.0, np.radians(3.0)
CACHE = Path(tempfile.gettempdir()) / "scanchain_localize3d"


@dataclass(frozen=True, slots=True)
class Case:
    """A log and the map that it is to be placed in: worlds, and what ``simulate`` makes of that of the log."""

    map_world: str
    log_world: str
    sensor: str = "hdl-64"
    changed: int | None = 1
    reverse: bool = True
    start_m: float = 130.0
    duration_s: float = 66.0
    belongs: bool = True


CASES = {
    "same": Case("town", "town", reverse=False, start_m=0.0, changed=None),
    "changed": Case("town", "town"),
    "vlp-16": Case("town", "town", "vlp-16", changed=2),
    "os1-32": Case("town", "town", "os1-32", changed=3, start_m=50.0),
    "rounds": Case("rounds", "rounds", changed=4, start_m=300.0, duration_s=160.0),
    "forest": Case("town", "forest", belongs=False),
    "forest in forest": Case("forest", "forest", changed=1),
}


@dataclass(frozen=True, slots=True)
class Found:
    """Starts of a log: path of each until it was found (NaN: never), and how far off (m, rad) it was."""

    after_m: list[float]
    off_m: list[float]
    off_rad: list[float]


@dataclass(frozen=True, slots=True)
class Tracked:
    """A whole log in a map. ATE in meters, seconds a scan and of opening, MiB of memory."""

    ate_m: float
    live_m: float
    scan_s: float
    odometry_s: float
    opening_s: float
    memory_mib: float


def starts(log_path: Path, run: Path, first_scans: list[int], map_truth: Trajectory | None) -> Found:
    """Every start of a log in the map, until it is found or given up."""
    prior = open_saved_map(run)
    log = open_log([log_path], LogConfig())
    truth = log.ground_truth()
    config = load_settings(3).config
    scans = list(log.scans(config.preprocess))
    path_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1)))
    found = Found([], [], [])
    for first in first_scans:
        localizer = Localizer(prior, config, log.T_base_lidar, is_live=False)
        after_m = off_m = off_rad = float("nan")
        for number in range(first, len(scans)):
            gone_m = float(path_m[number] - path_m[first])
            if gone_m > GIVEN_UP_M:
                break
            placed = localizer.process(_renumbered(scans[number], number - first))
            if placed.state is not MapState.SEARCHING and placed.T_map_lidar is not None:
                after_m = gone_m
                if map_truth is None:
                    off_m = off_rad = float("inf")
                else:
                    error = errors(prior, map_truth, placed.T_map_lidar[None], truth.poses[number : number + 1])
                    off_m, off_rad = float(np.linalg.norm(error[0, :3, 3])), float(lie.rotation_angle(error[0]))
                break
        found.after_m.append(after_m)
        found.off_m.append(off_m)
        found.off_rad.append(off_rad)
    return found


def track(log_path: Path, run: Path, map_truth: Trajectory) -> Tracked:
    """The whole log in the map, and odometry alone scan by scan beside it: both timed under the same load."""
    log = open_log([log_path], LogConfig())
    truth = log.ground_truth()
    config = load_settings(3).config
    held = psutil.Process().memory_info().rss
    started = perf_counter()
    prior = open_saved_map(run)
    localizer = Localizer(prior, config, log.T_base_lidar, is_live=False)
    opening_s = perf_counter() - started
    odometry = Odometry(config, log.T_base_lidar)
    seconds = np.array([_both(odometry, localizer, scan) for scan in log.scans(config.preprocess)])
    memory = psutil.Process().memory_info().rss - held
    odometry_s, scan_s = seconds[len(seconds) // 4 :].mean(axis=0).tolist()  # compiled and found by then
    result = localizer.finish()
    known = np.isfinite(result.live[:, 0, 0])
    smoothed = errors(prior, map_truth, result.trajectory.poses, truth.poses)
    live = errors(prior, map_truth, result.live[known], truth.poses[known])
    return Tracked(_rmse(smoothed), _rmse(live), scan_s, odometry_s, opening_s, memory / 2**20)


def _both(odometry: Odometry, localizer: Localizer, scan: Scan) -> tuple[float, float]:
    """Seconds of the processor that odometry takes, and localization."""
    started = thread_time()
    odometry.process(scan)
    between = thread_time()
    localizer.process(scan)
    return between - started, thread_time() - between


def errors(prior: SavedMap, map_truth: Trajectory, poses: Matrix, truth: Matrix) -> Matrix:
    """Estimated against true poses (N, 4, 4), both seen from the keyframe of the map that is nearest in truth."""
    stamps_ns = [keyframe.stamp_ns for keyframe in prior.keyframes]
    true_map = map_truth.poses[np.searchsorted(map_truth.stamps_ns, stamps_ns)]
    away_m = np.linalg.norm(truth[:, None, :3, 3] - true_map[:, :3, 3], axis=2)
    nearest = away_m.argmin(axis=1)
    seen_true = lie.inverse(true_map[nearest]) @ truth
    return lie.inverse(seen_true) @ lie.inverse(prior.poses[nearest]) @ poses


def _renumbered(scan: Scan, index: int) -> Scan:
    return replace(scan, index=index)


def _rmse(error: Matrix) -> float:
    return float(np.sqrt(np.mean(np.sum(error[:, :3, 3] ** 2, axis=1))))


def log_of(world: str, seed: int, cache: Path, **options) -> Path:
    """The simulated log, made if it is not there yet."""
    folder = cache / simulator_version()
    folder.mkdir(parents=True, exist_ok=True)
    name = "_".join([world, str(seed), *(f"{key}{value}" for key, value in options.items())])
    path = folder / f"{name}.mcap"
    if not path.exists():
        draft = path.with_suffix(".draft.mcap")
        simulate(world, draft, seed=seed, force=True, **options)
        draft.with_suffix(".tum").unlink()
        draft.rename(path)
    return path


def map_of(log: Path) -> Path:
    """The run of a log, made if it is not there yet."""
    run = log.with_suffix(".run")
    if not run.exists():
        scanchain.run(log, run, recording=False)
    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES), help="default: %(default)s")
    parser.add_argument("--starts", type=int, default=100, help="a case, default: %(default)s")
    parser.add_argument("--tracked", type=int, default=1, help="whole logs a case, 0 or 1, default: %(default)s")
    parser.add_argument("--seed", type=int, default=1, help="of the worlds, default: %(default)s")
    parser.add_argument("--cache", type=Path, default=CACHE)
    arguments = parser.parse_args()
    print(
        "case               starts  in 10 m    ever  median m  wrong    ATE m   live m   ms  ratio  open s    MiB"
    )
    for name in arguments.cases.split(","):
        case, seed = CASES[name], arguments.seed
        map_log = log_of(case.map_world, seed, arguments.cache, duration_s=case.duration_s)
        run = map_of(map_log)
        options = {
            "changed": case.changed,
            "reverse": case.reverse,
            "start_m": case.start_m,
            "sensor": case.sensor,
        }
        log = log_of(case.log_world, seed, arguments.cache, duration_s=case.duration_s, **options)
        truth = open_log([map_log], LogConfig()).ground_truth()
        count = len(open_log([log], LogConfig()).ground_truth())
        last = int(count * 0.9)  # so that there is path left
        chosen = np.linspace(0, last, arguments.starts).astype(int).tolist()
        found = in_fresh_process(starts, log, run, chosen, truth if case.belongs else None)
        after_m = np.array(found.after_m)
        wrong = (np.array(found.off_m) > WRONG_M) | (np.array(found.off_rad) > WRONG_RAD)
        within, ever = 100.0 * np.mean(after_m <= WITHIN_M), 100.0 * np.isfinite(after_m).mean()
        median_m = np.nanmedian(after_m) if ever else np.nan
        text = f"{name:18}{len(chosen):7}{within:8.1f}%{ever:7.1f}%{median_m:10.1f}{wrong.sum():7}"
        if arguments.tracked and case.belongs:
            t = in_fresh_process(track, log, run, truth)
            text += (
                f"{t.ate_m:9.4f}{t.live_m:9.4f}{1e3 * t.scan_s:5.0f}{t.scan_s / t.odometry_s:7.2f}"
                f"{t.opening_s:8.2f}{t.memory_mib:7.0f}"
            )
        print(text, flush=True)


if __name__ == "__main__":
    main()
