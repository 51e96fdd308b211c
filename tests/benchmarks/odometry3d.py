"""3D odometry, ours against others, on the same decoded scans, scan by scan in turn.

Methods, settings and warm-up are those of ``scanchain compare``, where each has a process of its own. LOG is any
MCAP with a 3D lidar. Its scans are decoded once into memory, then every one goes through all methods in turn,
starting with another one each time, so that whatever else the machine does meets all of them alike. The time is
that of ``track`` alone, the first scan left out. Poses hold at the scan's stamp; where a method's own hold
elsewhere in the sweep, its wrapper moves them. Every log has a process of its own. Memory and sharpness of maps
are figures of ``scanchain compare``. In the table x is over the same of the first row of ours; CPU time is the
median of all threads together, ATE the rmse after rigid alignment, KITTI the mean over all stretches of 10, 20 and
40 m, both from the second scan on: no method can predict the first motion.

--set: every world of scanchain.simulation that is driven with a 3D lidar, with every 3D sensor. A cell is the
KITTI translation error in % over stretches of 10, 20 and 40 m, and the ATE in meters. Where the path is shorter
than 20 m the first number is the ATE over the length of the path, marked *. LOST: the last pose, seen from the
first, is off by more than 5 % of the path or 2 m, whichever is larger, or there is none.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.comparison.methods import resolve
from scanchain.comparison.worker import start, warm_up
from scanchain.data import Scan, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import SHORT_LENGTHS_M, absolute_error, kitti_error, pair
from scanchain.logs import Log, open_log
from tests.benchmarks.harness import KITTI, SEQUENCES, drive_of, in_fresh_process, options_of, table
from tests.support.scenes import DATA

OURS = ("plicp", "svd")
INDOORS = frozenset({"corridor", "staircase", "hall"})  # where others' settings for indoors are taken
SHORT_PATH_M, LOST_SHARE, LOST_M = 20.0, 0.05, 2.0
COLUMNS = {"median ms": 2, "CPU ms": 2, "ATE m": 4, "KITTI %": 3, "KITTI deg/m": 4}  # heads and digits
TOPICS = {"pandaset_002_sweeps30to55.mcap": "/pandar64/points"}  # of a log with several lidars


@dataclass(frozen=True, slots=True)
class Run:
    """What a method made of a log, up to its ``failure``, which is empty if there was none.

    ``seconds`` (N,) passed on the clock while a scan was tracked, ``cpu_seconds`` were spent by all threads.
    """

    name: str
    description: str
    trajectory: Trajectory
    seconds: NDArray[np.float64]
    cpu_seconds: NDArray[np.float64]
    failure: str


def default_methods(path: Path) -> tuple[str, ...]:
    """Ours and all others that are worth a row; GenZ-ICP as its authors tuned it for such a log."""
    genz = "genz-icp-kitti" if "kitti" in path.name else "genz-icp"
    return (*OURS, "kiss-icp", "small-vgicp", "small-gicp", genz, "open3d-p2l")


def read(path: Path, count: int | None = None) -> tuple[Log, list[Scan]]:
    """A log, and its first scans."""
    log = open_log(path, topic=TOPICS.get(path.name, ""))
    if log.dimension != 3:
        raise InputError(f"{path}: {log.topic} is 2D; this benchmark is for 3D lidars")
    return log, list(islice(log.scans(), count))


def run_all(log: Log, scans: list[Scan], methods: Sequence[str]) -> list[Run]:
    """All methods over all scans, in turn, each scan starting with another one."""
    chosen = resolve(tuple(methods), 3, file=None)
    for method in chosen:
        warm_up(scans, method, log.T_base_lidar)
    racers = [start(method, log.T_base_lidar) for method in chosen]
    poses = np.full((len(methods), len(scans), 4, 4), np.nan)
    seconds, cpu_seconds = np.zeros((2, len(methods), len(scans)))
    failures = [""] * len(methods)
    for k, scan in enumerate(scans):
        for place in range(len(methods)):
            m = (place + k) % len(methods)
            if failures[m]:
                continue
            started, cpu_started = perf_counter(), process_time()
            try:
                poses[m, k] = racers[m].track(scan)
            except Exception as error:  # others' code may raise anything; the race goes on
                failures[m] = f"scan {k}: {type(error).__name__}: {error}"
            seconds[m, k], cpu_seconds[m, k] = perf_counter() - started, process_time() - cpu_started
    stamps_ns = np.array([scan.stamp_ns for scan in scans])
    held = [
        int(np.isfinite(each).all(axis=(1, 2)).argmin() if failed else len(each))
        for each, failed in zip(poses, failures, strict=True)
    ]
    trajectories = [Trajectory(stamps_ns[:count], each[:count]) for each, count in zip(poses, held, strict=True)]
    descriptions = [racer.description for racer in racers]
    return list(map(Run, methods, descriptions, trajectories, seconds, cpu_seconds, failures))


# ---------------------------------------------------------------- one log in detail


def run_log(path: Path, methods: Sequence[str], count: int) -> None:
    """One line a method, then what each one did."""
    log, scans = read(path, count)
    runs, truth = run_all(log, scans, methods), log.ground_truth()
    points = np.mean([len(scan.points) for scan in scans])
    timed = "with" if len(scans[0].times_s) else "without"
    print(f"\n{path.name}: {len(scans)} scans of {points:.0f} points, {timed} times")
    print(f"{os.cpu_count()} cores, load average of the last minute {os.getloadavg()[0]:.1f}; quiet is below 2")
    rows = {}
    for run in runs:
        spent_ms = (1e3 * np.median(each[1:]) for each in (run.seconds, run.cpu_seconds))
        found = score(run, truth)
        rows[run.name] = *spent_ms, found.ate_m, found.kitti_percent, found.kitti_deg_m
    base = rows[next((run.name for run in runs if run.name in OURS), runs[0].name)]
    line = table("method", *COLUMNS)
    for name, row in rows.items():
        line(name, *map(_cell, COLUMNS.values(), row, base))
    for run in runs:
        print(f"  {run.name}: {run.description}{'; FAILED at ' + run.failure if run.failure else ''}", flush=True)


def _cell(digits: int, value: float, base: float) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{value:.{digits}f}" + (f" x{value / base:.2f}" if base > 0.0 else "")


# ---------------------------------------------------------------- all worlds


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of a method; infinite where there is no truth or not every pose, NaN where the path is too short."""

    median_s: float
    ate_m: float = np.inf
    kitti_percent: float = np.inf
    kitti_deg_m: float = np.inf
    path_length_m: float = np.inf
    is_lost: bool = True

    @property
    def is_of_path(self) -> bool:
        return self.path_length_m < SHORT_PATH_M

    @property
    def translation_percent(self) -> float:
        return 100.0 * self.ate_m / self.path_length_m if self.is_of_path else self.kitti_percent

    def __str__(self) -> str:
        star = "*" if self.is_of_path else ""
        return f"{self.translation_percent:.3f}{star} {self.ate_m:.3f}m{' LOST' if self.is_lost else ''}"


def scores(path: Path, methods: Sequence[str]) -> list[Score]:
    """One score a method."""
    log, scans = read(path)
    return [score(run, log.ground_truth()) for run in run_all(log, scans, methods)]


def score(run: Run, truth: Trajectory | None) -> Score:
    """Errors of a run against the truth."""
    median_s = float(np.median(run.seconds[1:]))
    if truth is None or run.failure:
        return Score(median_s)
    pairs = pair(run.trajectory, truth).after_start  # no method can predict the first motion
    absolute = absolute_error(pairs)
    ends = (lie.between(poses[0], poses[-1])[:3, 3] for poses in (pairs.estimate, pairs.reference))
    is_lost = float(np.linalg.norm(next(ends) - next(ends))) > max(LOST_SHARE * absolute.path_length_m, LOST_M)
    kitti = np.nan, np.nan
    with suppress(InputError):  # no stretch fits into the path
        drift = kitti_error(pairs, SHORT_LENGTHS_M, every=1)
        kitti = 100.0 * drift.translation_share, float(np.degrees(drift.rotation_rad_per_m))
    return Score(median_s, absolute.translation_m.rmse, *kitti, absolute.path_length_m, is_lost)


def rank(row: Sequence[Score], first_rival: int, place: int) -> int:
    """Place of one of ours among itself and the rivals, 1 is best; the lost stand behind all others."""
    own = (row[place].is_lost, row[place].translation_percent)
    return 1 + sum((rival.is_lost, rival.translation_percent) < own for rival in row[first_rival:])


def run_set(arguments: argparse.Namespace, methods: Sequence[str]) -> None:
    """A line a sequence, then the summary."""
    methods = sorted(methods, key=lambda name: name not in OURS)
    first_rival = sum(name in OURS for name in methods)
    line = table("sequence", *methods, "rank")
    rows: dict[str, list[Score]] = {}
    for world in arguments.worlds.split(","):
        settings = {"genz-icp": "genz-icp-indoor"} if world in INDOORS else {}
        for sensor in arguments.sensors.split(","):
            path = drive_of(world, sensor, arguments.scans, arguments.cache)
            try:
                row = in_fresh_process(scores, path, tuple(settings.get(name, name) for name in methods))
            except BrokenProcessPool:
                print(f"{world} {sensor}: a method broke the process; try them one by one with --methods")
                continue
            rows[f"{world} {sensor}"] = row
            line(f"{world} {sensor}", *row, rank(row, first_rival, 0))
    summary(rows, methods, first_rival, line)


def summary(
    rows: dict[str, list[Score]], methods: Sequence[str], first_rival: int, line: Callable[..., None]
) -> None:
    """Means, ranks and losses."""
    table = list(rows.values())
    percent = np.array([[score.translation_percent for score in row] for row in table])
    lost = np.array([[score.is_lost for score in row] for row in table])
    median_ms = 1e3 * np.median([[score.median_s for score in row] for row in table], axis=0)
    held = percent[~lost.any(axis=1)]
    for head, values in (
        ("mean", [f"{value:.3f}" for value in percent.mean(axis=0)]),
        ("median", [f"{value:.3f}" for value in np.median(percent, axis=0)]),
        (f"mean of {len(held)} all hold", [f"{value:.3f}" for value in held.mean(axis=0)] if len(held) else []),
        ("lost", [str(value) for value in lost.sum(axis=0)]),
        ("ms a scan", [f"{value:.1f}" for value in median_ms]),
    ):
        line(head, *values, "")
    for place, name in enumerate(methods[:first_rival]):
        ranks = np.array([rank(row, first_rival, place) for row in table])
        is_lost_alone = lost[:, place] & ~lost[:, first_rival:].all(axis=1)
        alone = [case for case, is_alone in zip(rows, is_lost_alone, strict=True) if is_alone]
        print(
            f"{name}: first on {np.sum(ranks == 1)}, first or second on {np.sum(ranks <= 2)} of {len(ranks)} "
            f"({100.0 * np.mean(ranks <= 2):.0f} %); lost where another holds: {', '.join(alone) or 'never'}"
        )


def main() -> None:
    logs = [DATA / "3d" / name for name in (*TOPICS, *KITTI)]
    arguments = options_of(__doc__, "logs", logs=logs, methods="", set=False, **SEQUENCES)
    named = tuple(arguments.methods.split(",")) if arguments.methods else ()
    if arguments.set:
        run_set(arguments, named or default_methods(Path("log")))
        return
    for path in arguments.logs:
        methods = named or default_methods(path)
        in_fresh_process(run_log, path, methods, arguments.scans)


if __name__ == "__main__":
    main()
