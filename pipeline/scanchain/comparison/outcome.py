"""Outcome of a method: its poses, times, memory, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from scanchain.data import Matrix, Trajectory

POSES_FILE, SECONDS_FILE, CPU_FILE = "poses.npy", "seconds.npy", "cpu_seconds.npy"
TRAJECTORY_FILE, REPORT_FILE = "trajectory.npy", "end.json"
STEPS_FILE, CLOSURES_FILE = "steps.parquet", "loops.parquet"


class Status(StrEnum):
    """End state of a run of a method."""

    OK = "ok"
    MISSING = "not installed"
    CRASHED = "crashed"
    TIMED_OUT = "timed out"
    OUT_OF_MEMORY = "out of memory"

    @property
    def is_failure(self) -> bool:
        """True if it started and failed."""
        return self not in (Status.OK, Status.MISSING)


class EndReport(Struct, frozen=True):
    """Report of a method's process.

    Attributes
    ----------
    status, reason : how it ended; the reason is empty where all went well
    description : what the method does, with its settings
    start_s : import, loading what is compiled, and a throwaway instance on the first scans
    finish_s : after the last scan, as for the last optimization
    peak_mib : of its resident memory, interpreter and packages included
    has_compiled : whether kernels were compiled in between, so that its times are not valid
    """

    status: Status
    reason: str
    description: str = ""
    start_s: float = 0.0
    finish_s: float = 0.0
    peak_mib: float = 0.0
    has_compiled: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """A run of a method.

    Attributes
    ----------
    report : how it ended
    odometry : (N, d+1, d+1) pose of each scan straight after it came; NaN from where it failed on
    trajectory : final poses, equal to ``odometry`` except with loop closures; empty if it did not finish
    seconds, cpu_seconds : (N,) tracking a scan, on the clock and spent by all threads; NaN like the poses
    folder : where its tables lie
    """

    report: EndReport
    odometry: Matrix
    trajectory: Trajectory
    seconds: NDArray[np.float64]
    cpu_seconds: NDArray[np.float64]
    folder: Path

    @property
    def is_whole(self) -> bool:
        """True if every scan has a pose."""
        return self.report.status is Status.OK


def read_outcome(folder: Path, report: EndReport, stamps_ns: NDArray[np.int64], dimension: int) -> Outcome:
    """Outcome of a run from its folder, complete or not."""
    size = dimension + 1
    empty = np.full((len(stamps_ns), size, size), np.nan)
    odometry = np.load(folder / POSES_FILE) if (folder / POSES_FILE).exists() else empty
    seconds, cpu_seconds = (
        np.load(folder / file) if (folder / file).exists() else empty[:, 0, 0] for file in (SECONDS_FILE, CPU_FILE)
    )
    is_whole = report.status is Status.OK
    poses = np.load(folder / TRAJECTORY_FILE) if is_whole else empty[:0]
    return Outcome(report, odometry, Trajectory(stamps_ns[: len(poses)], poses), seconds, cpu_seconds, folder)
