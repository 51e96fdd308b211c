"""Methods over the same stored scans, run by run, each in a process of its own with limits on time and memory.

Scan by scan they are read into memory of their own rather than mapped: what is mapped counts as resident, and the
memory of a method would grow with the log. Straight after decoding the files lie in the system's page cache.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from scanchain.comparison.methods import Method
from scanchain.data import Matrix, Pose, Scan, Trajectory
from scanchain.errors import counted
from scanchain.processes import KilledFor, Limits, available_mib, run_within
from scanchain.runs.job import Progress

_ARRAYS, _TABLE = "points_and_times.npy", "scans.npz"
POSES_FILE, SECONDS_FILE, CPU_FILE = "poses.npy", "seconds.npy", "cpu_seconds.npy"
METHOD_FILE, TRAJECTORY_FILE, REPORT_FILE = "method.msgpack", "trajectory.npy", "end.json"
STEPS_FILE, CLOSURES_FILE = "steps.parquet", "loops.parquet"

_LEAST_S, _SCAN_S = 300.0, 1.0  # default time limit, seconds: at least, and for each scan
_SHARE = 0.75  # share of the free memory that is the default limit
_INTERVAL_S = 0.02  # between two readings of a process's memory


@dataclass(frozen=True, slots=True)
class StoredScans:
    """The scans of a folder, row by row.

    Attributes
    ----------
    folder : where their points and times lie
    points : (N,) numbers of points of each scan
    stamps_ns, log_times_ns, dropped : (N,) as in ``Scan``
    wheels : (N, d+1, d+1) T_odom_base, NaN where the log has none
    T_base_lidar : (d+1, d+1)
    """

    folder: Path
    points: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    log_times_ns: NDArray[np.int64]
    dropped: NDArray[np.int64]
    wheels: NDArray[np.float64]
    T_base_lidar: Pose

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.T_base_lidar) - 1

    def scans(self) -> Iterator[Scan]:
        """The scans as they were decoded."""
        with (self.folder / _ARRAYS).open("rb") as arrays:
            for index, wheels in enumerate(self.wheels):
                yield Scan(
                    index=index,
                    stamp_ns=int(self.stamps_ns[index]),
                    log_time_ns=int(self.log_times_ns[index]),
                    points=np.load(arrays),
                    times_s=np.load(arrays),
                    dropped=int(self.dropped[index]),
                    T_odom_base=wheels if np.isfinite(wheels).all() else None,
                )


def store(scans: Iterable[Scan], T_base_lidar: Pose, folder: Path) -> StoredScans:
    """Write scans into an empty folder."""
    rows: list[tuple[int, ...]] = []
    wheels: list[Pose] = []
    unknown = np.full(T_base_lidar.shape, np.nan)
    with (folder / _ARRAYS).open("wb") as arrays:
        for scan in scans:
            rows.append((len(scan.points), scan.stamp_ns, scan.log_time_ns, scan.dropped))
            wheels.append(unknown if scan.T_odom_base is None else scan.T_odom_base)
            np.save(arrays, np.ascontiguousarray(scan.points, np.float32))
            np.save(arrays, np.ascontiguousarray(scan.times_s, np.float32))
    np.savez(folder / _TABLE, rows=np.array(rows, np.int64), wheels=np.array(wheels), T_base_lidar=T_base_lidar)
    return open_store(folder)


def open_store(folder: Path) -> StoredScans:
    """The scans that ``store`` wrote."""
    with np.load(folder / _TABLE) as table:
        points, stamps_ns, log_times_ns, dropped = table["rows"].T.copy()
        wheels, T_base_lidar = table["wheels"], table["T_base_lidar"]
    return StoredScans(folder, points, stamps_ns, log_times_ns, dropped, wheels, T_base_lidar)


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


def limits_for(scans: int, time_s: float | None, memory_mib: float | None) -> Limits:
    """The requested limits, else 300 s and one more a scan, and three quarters of the memory that is free."""
    return Limits(
        _LEAST_S + _SCAN_S * scans if time_s is None else time_s,
        _SHARE * available_mib() if memory_mib is None else memory_mib,
    )


def run_all(
    methods: Sequence[Method], scans: StoredScans, folder: Path, *, repeat: int, limits: Limits, progress: Progress
) -> dict[str, list[Outcome]]:
    """``repeat`` runs of every method, each round starting with another one; one not installed is tried once."""
    outcomes: dict[str, list[Outcome]] = {method.name: [] for method in methods}
    for turn in range(repeat):
        for place in range(len(methods)):
            method = methods[(place + turn) % len(methods)]
            if any(outcome.report.status is Status.MISSING for outcome in outcomes[method.name]):
                continue
            outcome = _run(method, scans, folder / f"run_{turn}_{place}", limits)
            if outcome.is_whole and outcome.report.has_compiled:
                progress.announce(f"{method.name}: compiled its kernels, once after the installation; run again")
                outcome = _run(method, scans, folder / f"run_{turn}_{place}_compiled", limits)
            outcomes[method.name].append(outcome)
            progress.announce(_progress_line(method.name, turn, repeat, outcome))
    return outcomes


def _run(method: Method, scans: StoredScans, folder: Path, limits: Limits) -> Outcome:
    folder.mkdir()
    report = run_watched(method, scans.folder, folder, limits)
    return read_outcome(folder, report, scans.stamps_ns, scans.dimension)


def _progress_line(name: str, turn: int, repeat: int, outcome: Outcome) -> str:
    which = f" {turn + 1}/{repeat}" if repeat > 1 else ""
    if outcome.report.status is Status.OK:
        return f"{name}{which}: {counted(len(outcome.seconds), 'scan')} in {outcome.seconds.sum():.1f} s"
    return f"{name}{which}: {outcome.report.status}: {outcome.report.reason}"


def run_watched(method: Method, scans: Path, folder: Path, limits: Limits) -> EndReport:
    """Run a method over stored scans; its own folder takes what it writes and prints."""
    (folder / METHOD_FILE).write_bytes(msgspec.msgpack.encode(method))
    # small_gicp's threads spin by default: where somebody else has a core, they spin away the other thread's time
    environment = os.environ | {"OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "PASSIVE")}
    ending = run_within(
        limits,
        "scanchain.comparison.worker",
        [str(scans), str(folder)],
        environment,
        output=folder / "output.txt",
        interval_s=_INTERVAL_S,
    )
    if ending.killed_for is KilledFor.NOTHING and (folder / REPORT_FILE).exists():
        return _own_report(folder)
    status = Status.OUT_OF_MEMORY if ending.ran_out_of_memory else Status.CRASHED
    if ending.killed_for is KilledFor.TIME:
        status = Status.TIMED_OUT
    reason = ending.reason(limits, (folder / "output.txt").read_text(errors="replace"))
    return EndReport(status, f"{_where(folder)}: {reason}", peak_mib=ending.peak_mib)


def _own_report(folder: Path) -> EndReport:
    """Report of the process itself, with the scan at which it failed."""
    report = msgspec.json.decode((folder / REPORT_FILE).read_bytes(), type=EndReport)
    if not report.status.is_failure:
        return report
    return msgspec.structs.replace(report, reason=f"{_where(folder)}: {report.reason}")


def _where(folder: Path) -> str:
    """Stage at which it ended."""
    if not (folder / SECONDS_FILE).exists():
        return "while starting or warming up"
    seconds = np.load(folder / SECONDS_FILE)
    tracked = int(np.isfinite(seconds).sum())
    return f"at scan {tracked}" if tracked < len(seconds) else "after the last scan"
