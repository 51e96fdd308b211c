"""Methods over the same stored scans, run by run, each in a process of its own with limits on time and memory.

Scans are read one by one rather than memory-mapped: mapped pages count as resident, and the measured memory of a
method would grow with the log. Right after decoding, the files are in the system's page cache.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from scanchain.comparison.methods import Method
from scanchain.data import Matrix, Pose, Scan, Trajectory
from scanchain.errors import counted
from scanchain.processes import KilledFor, Limits, run_within
from scanchain.runs.job import Progress

TASK_FILE, TRACK_FILE, TRAJECTORY_FILE, REPORT_FILE = "task.msgpack", "track.npy", "trajectory.npy", "end.json"
STEPS_FILE, CLOSURES_FILE = "steps.parquet", "loops.parquet"

T = TypeVar("T")
_SIZE_BYTES = 8  # of the size in front of a stored scan


@dataclass(frozen=True, slots=True)
class StoredScans:
    """Scans in a file, one after the other, and the data common to them.

    points : (N,) numbers of points of each scan
    stamps_ns, log_times_ns : (N,) as in ``Scan``
    wheels : (N, d+1, d+1) T_odom_base, NaN where the log has none
    T_base_lidar : (d+1, d+1); is_mounted : whether the log states it
    distorted_share : as of the log
    """

    file: str
    points: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    log_times_ns: NDArray[np.int64]
    wheels: NDArray[np.float64]
    T_base_lidar: Pose
    is_mounted: bool = True
    distorted_share: float = 0.0

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.T_base_lidar) - 1

    @property
    def track_type(self) -> np.dtype[np.void]:
        """A row of the file that a method's process writes scan by scan."""
        size = self.dimension + 1
        return np.dtype([("pose", np.float64, (size, size)), ("seconds", np.float64), ("cpu_seconds", np.float64)])

    def scans(self) -> Iterator[Scan]:
        """The scans as they were decoded."""
        with Path(self.file).open("rb") as file:
            while size := file.read(_SIZE_BYTES):
                yield decode(file.read(int.from_bytes(size, "little")), Scan)


def encode(value: object) -> bytes:
    """MessagePack of records with arrays: in a directory where others may write, a pickle could run their code."""
    return msgspec.msgpack.encode(value, enc_hook=lambda array: (array.dtype.str, array.shape, array.tobytes()))


def decode(data: bytes, kind: type[T]) -> T:
    """The records that ``encode`` was given."""

    def array(_: type, stored: Any) -> NDArray[Any]:
        dtype, shape, content = stored
        return np.frombuffer(bytearray(content), dtype).reshape(shape)

    return msgspec.msgpack.decode(data, type=kind, dec_hook=array)


def store(
    scans: Iterable[Scan], T_base_lidar: Pose, path: Path, *, is_mounted: bool = True, distorted_share: float = 0.0
) -> StoredScans:
    """Write scans into a file."""
    rows: list[tuple[int, ...]] = []
    wheels: list[Pose] = []
    unknown = np.full(T_base_lidar.shape, np.nan)
    with path.open("wb") as file:
        for scan in scans:
            data = encode(scan)
            file.write(len(data).to_bytes(_SIZE_BYTES, "little") + data)
            rows.append((len(scan.points), scan.stamp_ns, scan.log_time_ns))
            wheels.append(unknown if scan.T_odom_base is None else scan.T_odom_base)
    points, stamps_ns, log_times_ns = np.array(rows, np.int64).T.copy()
    return StoredScans(
        str(path), points, stamps_ns, log_times_ns, np.array(wheels), T_base_lidar, is_mounted, distorted_share
    )


class Status(StrEnum):
    """End state of a run of a method."""

    OK = "ok"
    MISSING = "not installed"
    NOT_APPLICABLE = "not applicable"
    CRASHED = "crashed"
    TIMED_OUT = "timed out"
    OUT_OF_MEMORY = "out of memory"

    @property
    def is_failure(self) -> bool:
        """True if it started and failed."""
        return self.took_part and self is not Status.OK

    @property
    def took_part(self) -> bool:
        """True if it is installed, and the log has what it needs."""
        return self not in (Status.MISSING, Status.NOT_APPLICABLE)


class EndReport(Struct, frozen=True):
    """Report of a method's process.

    status, reason : how it ended; the reason is empty where all went well
    description : what the method does, with its settings
    start_s : import, loading what is compiled, and a throwaway instance on the first scans
    finish_s : after the last scan, as for the last optimization
    peak_mib : of its resident memory, interpreter and packages included
    """

    status: Status
    reason: str
    description: str = ""
    start_s: float = 0.0
    finish_s: float = 0.0
    peak_mib: float = 0.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """A run of a method.

    odometry : (N, d+1, d+1) pose of each scan right after it was processed; NaN from the failure on
    trajectory : final poses, equal to ``odometry`` except with loop closures; empty if it did not finish
    seconds, cpu_seconds : (N,) wall-clock and CPU time (all threads) per scan; NaN like the poses
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


def run_all(
    methods: Sequence[Method], scans: StoredScans, folder: Path, *, repeat: int, limits: Limits, progress: Progress
) -> dict[str, list[Outcome]]:
    """``repeat`` runs of every method that takes part, each round starting with another one."""
    outcomes: dict[str, list[Outcome]] = {method.name: [] for method in methods}
    for turn in range(repeat):
        for place in range(len(methods)):
            method = methods[(place + turn) % len(methods)]
            if not all(outcome.report.status.took_part for outcome in outcomes[method.name]):
                continue
            outcome = _run(method, scans, folder / f"run_{turn}_{place}", limits)
            outcomes[method.name].append(outcome)
            which = f" {turn + 1}/{repeat}" if repeat > 1 else ""
            end = f"{outcome.report.status}: {outcome.report.reason}"
            if outcome.is_whole:
                end = f"{counted(len(outcome.seconds), 'scan')} in {outcome.seconds.sum():.1f} s"
            progress.announce(f"{method.name}{which}: {end}")
    return outcomes


def _run(method: Method, scans: StoredScans, folder: Path, limits: Limits) -> Outcome:
    """A run in a process of its own; its folder takes what it writes and prints."""
    folder.mkdir()
    (folder / TASK_FILE).write_bytes(encode((method, scans)))
    # small_gicp's threads spin by default: on shared cores that delays other threads
    environment = os.environ | {"OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "PASSIVE")}
    output, own = folder / "output.txt", folder / REPORT_FILE
    ending = run_within(limits, "scanchain.comparison.worker", [str(folder)], environment, output=output)
    if ending.killed_for is KilledFor.NOTHING and own.exists():
        report = msgspec.json.decode(own.read_bytes(), type=EndReport)
    else:
        reason = ending.reason(limits, output.read_text(errors="replace"))
        report = EndReport(Status(ending.how), reason, peak_mib=ending.peak_mib)
    return _outcome(folder, report, scans)


def _outcome(folder: Path, report: EndReport, scans: StoredScans) -> Outcome:
    """Outcome of a run from its folder, complete or not; a failure's reason names the scan it occurred at."""
    track, where = np.full(len(scans), np.nan, scans.track_type), "while starting or warming up"
    if (folder / TRACK_FILE).exists():
        track = np.load(folder / TRACK_FILE)
        tracked = int(np.isfinite(track["seconds"]).sum())
        where = f"at scan {tracked}" if tracked < len(scans) else "after the last scan"
    if report.status.is_failure:
        report = msgspec.structs.replace(report, reason=f"{where}: {report.reason}")
    odometry, seconds, cpu_seconds = (np.ascontiguousarray(track[name]) for name in scans.track_type.names or ())
    poses = np.load(folder / TRAJECTORY_FILE) if report.status is Status.OK else odometry[:0]
    trajectory = Trajectory(scans.stamps_ns[: len(poses)], poses)
    return Outcome(report, odometry, trajectory, seconds, cpu_seconds, folder)
