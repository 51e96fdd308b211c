"""One log, many odometries: every scan goes through all of them in turn, so that they meet the same machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter, process_time
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline import baselines
from pipeline.baselines import Baseline
from pipeline.config import LogConfig
from pipeline.data import Pose, RawPoints, Scan, Trajectory
from pipeline.errors import InputError
from pipeline.logs import open_log
from pipeline.odometry import Odometry
from pipeline.settings import Override, load_settings

OURS = ("plicp", "svd")
WARM_UP_SCANS = 4

Answer = TypeVar("Answer")


class Ours:
    """Our odometry behind the verb of the baselines, with the configuration that a run would choose."""

    def __init__(self, matcher: str) -> None:
        config = load_settings(3, overrides=(Override("matching.matcher", matcher, "--methods"),)).config
        self.odometry = Odometry(config, np.eye(4))
        deskewing = "deskewing where the log has times" if config.preprocess.deskew else "no deskewing"
        self.description = f"ours, {matcher}, scan to map, one thread, preset lidar3d, no wheels, {deskewing}"
        self.index = 0

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        scan = Scan(self.index, stamp_ns, stamp_ns, points, times_s, 0, None)
        self.index += 1
        return self.odometry.track(scan).T_odom_lidar


@dataclass(frozen=True, slots=True)
class Recording:
    """A log in memory: scans and, where the log has it, the ground truth."""

    scans: list[Scan]
    ground_truth: Trajectory | None

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        return np.array([scan.stamp_ns for scan in self.scans])


@dataclass(frozen=True, slots=True)
class Run:
    """What a method made of a recording; the poses after a ``failure`` (empty if there was none) are NaN.

    ``seconds`` (N,) passed on the clock while a scan was tracked, ``cpu_seconds`` were spent by all threads.
    """

    name: str
    description: str
    trajectory: Trajectory
    seconds: NDArray[np.float64]
    cpu_seconds: NDArray[np.float64]
    failure: str

    @property
    def is_whole(self) -> bool:
        return bool(np.isfinite(self.trajectory.poses).all())


def read(path: Path, count: int) -> Recording:
    """The first ``count`` scans of a log, and its ground truth."""
    log = open_log([path], LogConfig())
    if log.dimension != 3:
        raise InputError(f"{path}: {log.topic} is 2D; this benchmark is for 3D lidars")
    return Recording(list(islice(log.scans(), count)), log.ground_truth())


def default_methods(path: Path, *, indoor: bool) -> tuple[str, ...]:
    """Ours and all others that are worth a row; GenZ-ICP as its authors tuned it for such a log."""
    genz = "genz-icp-indoor" if indoor else "genz-icp-kitti" if "kitti" in path.name else "genz-icp"
    return (*OURS, "kiss-icp", "small-vgicp", "small-gicp", genz, "open3d-p2l")


def create(name: str) -> Baseline:
    """One of ours or of the baselines, ready for the first scan."""
    return Ours(name) if name in OURS else baselines.create(name)


def run_all(recording: Recording, methods: Sequence[str]) -> list[Run]:
    """All methods over all scans, in turn, each scan starting with another one; the time is that of ``track``."""
    for name in methods:
        _warm_up(name, recording.scans)
    racers = [create(name) for name in methods]
    poses = np.full((len(methods), len(recording.scans), 4, 4), np.nan)
    seconds, cpu_seconds = np.zeros((2, len(methods), len(recording.scans)))
    failures = [""] * len(methods)
    for k, scan in enumerate(recording.scans):
        for place in range(len(methods)):
            m = (place + k) % len(methods)
            if failures[m]:
                continue
            started, cpu_started = perf_counter(), process_time()
            try:
                poses[m, k] = racers[m].track(scan.points, scan.times_s, scan.stamp_ns)
            except Exception as error:  # others' code may raise anything; the race goes on
                failures[m] = f"scan {k}: {type(error).__name__}: {error}"
            seconds[m, k], cpu_seconds[m, k] = perf_counter() - started, process_time() - cpu_started
    trajectories = [Trajectory(recording.stamps_ns, each) for each in poses]
    descriptions = [racer.description for racer in racers]
    columns = zip(methods, descriptions, trajectories, seconds, cpu_seconds, failures, strict=True)
    return [Run(*column) for column in columns]


def in_fresh_process(function: Callable[..., Answer], *arguments: object) -> Answer:
    """The function's answer from a process of its own: GenZ-ICP remembers its last log, others may crash.

    Threads wait asleep there: small_gicp's spin by default, and where somebody else has one of two cores they
    spin away the time that the other thread needs.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as executor:
        return executor.submit(function, *arguments).result()


def _warm_up(name: str, scans: list[Scan]) -> None:
    """Import and compile; GenZ-ICP, which is compiled, gets no scan here because it would remember it."""
    throwaway = create(name)
    if name.startswith("genz"):
        return
    for scan in scans[:WARM_UP_SCANS]:
        throwaway.track(scan.points, scan.times_s, scan.stamp_ns)
