"""One log, many odometries: every scan goes through all of them in turn, so that they meet the same machine.

They are those of ``scanchain compare``, with its settings, its warm-up and its verb, which alone is timed; there
each has a process of its own.
"""

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

from scanchain.comparison.methods import Method, resolve
from scanchain.comparison.worker import Runner, start, warm_up
from scanchain.config import LogConfig
from scanchain.data import Pose, Scan, Trajectory
from scanchain.errors import InputError
from scanchain.logs import open_log

OURS = ("plicp", "svd")

Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class Recording:
    """A log in memory: scans, where the lidar sits and, where the log has it, the ground truth."""

    scans: list[Scan]
    T_base_lidar: Pose
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
    return Recording(list(islice(log.scans(), count)), log.T_base_lidar, log.ground_truth())


def default_methods(path: Path, *, indoor: bool) -> tuple[str, ...]:
    """Ours and all others that are worth a row; GenZ-ICP as its authors tuned it for such a log."""
    genz = "genz-icp-indoor" if indoor else "genz-icp-kitti" if "kitti" in path.name else "genz-icp"
    return (*OURS, "kiss-icp", "small-vgicp", "small-gicp", genz, "open3d-p2l")


def create(name: str, T_base_lidar: Pose) -> Runner:
    """One of ours or of the baselines, ready for the first scan of a 3D log."""
    return start(_method(name), T_base_lidar)


def run_all(recording: Recording, methods: Sequence[str]) -> list[Run]:
    """All methods over all scans, in turn, each scan starting with another one; the time is that of ``track``."""
    for name in methods:
        warm_up(recording.scans, _method(name), recording.T_base_lidar)
    racers = [create(name, recording.T_base_lidar) for name in methods]
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
                poses[m, k] = racers[m].track(scan)
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


def _method(name: str) -> Method:
    return resolve((name,), 3, file=None)[0]
