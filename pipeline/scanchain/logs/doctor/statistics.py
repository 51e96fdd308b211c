"""Statistics of a log's scans, computed in one pass, as the doctor's checks need them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.data import RawPoints
from scanchain.errors import InputError, grouped
from scanchain.logs.log import Log
from scanchain.logs.mcap.selection import whole_span
from scanchain.logs.mcap.stream import decoded_messages
from scanchain.logs.messages.point_times import PointTimes
from scanchain.logs.messages.poses import StampedPose
from scanchain.logs.messages.readers import is_scan
from scanchain.logs.messages.returns import Returns

_PERCENT = np.arange(101)
_SAME_M = 1e-4  # largest difference of ranges that are one number: rounding of float32
_NEXT_RAD = 0.2  # largest angle from one point to the next, usually, where their order is that of firing
_ONE_TURN_RAD = (1.5 * np.pi, 2.5 * np.pi)  # one revolution; clouds stored ring by ring turn many times


@dataclass(frozen=True, slots=True)
class Survey:
    """Statistics of a log's scans and wheels.

    Attributes
    ----------
    scans : facts of each readable scan, in the order of log time
    log_ns, stamps_ns : (N,) int64 log times and header stamps of those scans
    wheels : poses of the wheels, in the order of log time; empty where there are none
    malformed : what is wrong with each message that is not readable
    point_times : what a run assumes about per-point times
    damage : what of the files could not be read
    """

    log: Log
    scans: tuple[ScanFacts, ...]
    log_ns: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    wheels: tuple[StampedPose, ...]
    malformed: tuple[str, ...]
    point_times: str
    damage: tuple[str, ...]

    @property
    def period_s(self) -> float:
        """Median time between two scans, by their stamps or, where those do not move, by log time; 0 if alone."""
        for times_ns in (self.stamps_ns, self.log_ns):
            steps_s = np.diff(times_ns) * 1e-9
            if len(steps_s) and np.median(steps_s) > 0.0:
                return float(np.median(steps_s))
        return 0.0

    def into_log_s(self, log_time_ns: int) -> float:
        """Seconds after the log's first message, as ``--start`` and ``--end`` count."""
        return (log_time_ns - whole_span(self.log.indexes).begin_ns) * 1e-9


def survey(log: Log, progress: Callable[[int, int], None] | None = None) -> Survey:
    """Statistics of every scan of the chosen part. Raises InputError where none is readable."""
    times = PointTimes(log.config)
    decode = log.decoder(times).decode
    decoders = {log.topic: lambda data: _facts(decode(data)), **log.pose_decoders}
    damage = [line for index in log.indexes for line in index.damage]
    scans: list[ScanFacts] = []
    log_ns: list[int] = []
    wheels: list[StampedPose] = []
    malformed: list[str] = []
    read = 0
    for message in decoded_messages(log.indexes, decoders, log.span, damage=damage):
        match message.value:
            case ScanFacts() as facts:
                read += 1
                if (read - 1) % log.config.every:  # left out by a run
                    continue
                scans.append(facts)
                log_ns.append(message.log_time_ns)
                if progress is not None:
                    progress(len(scans), log.scan_count)
            case StampedPose() as pose if message.channel.topic == log.odometry_topic:
                wheels.append(pose)
            case Exception() as error if message.channel.topic == log.topic:
                malformed.append(str(error))
    if not scans:
        reasons = "; ".join([*malformed[:1], *grouped(damage)]) or "the chosen part is empty"
        raise InputError(f"{log.name}: no scan of {log.topic} could be read: {reasons}")
    return Survey(
        log=log,
        scans=tuple(scans),
        log_ns=np.array(log_ns, np.int64),
        stamps_ns=np.array([scan.stamp_ns for scan in scans], np.int64),
        wheels=tuple(wheels),
        malformed=tuple(malformed),
        point_times="" if is_scan(log.lidar) else times.assumed,
        damage=tuple(grouped(damage)),
    )


class ScanFacts(NamedTuple):
    """Statistics of the returns that a run would get of one scan.

    Attributes
    ----------
    kept, dropped : number of valid returns, and of the others
    farthest_m, at_farthest : the largest range and the number of returns with just that one; NaN without any
    ranges_m : (101,) percentiles of the ranges, NaN without any
    time_span_s : of the per-point times, NaN where there are none
    turn : 1 if the points, in their order, go around once counter-clockwise, −1 if clockwise, else 0
    start_rad : azimuth of the first point
    digest : of the points, equal for equal ones
    """

    stamp_ns: int
    kept: int
    dropped: int
    farthest_m: float
    at_farthest: int
    ranges_m: NDArray[np.float32]
    time_span_s: float
    turn: int
    start_rad: float
    digest: int


def _facts(returns: Returns) -> ScanFacts:
    points, times_s = returns.points, returns.times_s
    ranges_m = np.sqrt(np.sum(np.square(points), axis=1))
    farthest_m = float(ranges_m.max()) if len(points) else float("nan")
    turn, start_rad = _turning(points)
    return ScanFacts(
        stamp_ns=returns.stamp_ns,
        kept=len(points),
        dropped=returns.dropped,
        farthest_m=round(farthest_m, 4),
        at_farthest=int(np.count_nonzero(ranges_m > farthest_m - _SAME_M)),
        ranges_m=np.percentile(ranges_m if len(points) else np.nan, _PERCENT).astype(np.float32),
        time_span_s=float(np.ptp(times_s)) if len(times_s) else float("nan"),
        turn=turn,
        start_rad=start_rad,
        digest=zlib.crc32(points.tobytes()),
    )


def _turning(points: RawPoints) -> tuple[int, float]:
    """Direction in which the points turn, 0 where they make no single turn, and their first azimuth."""
    if len(points) < 2:
        return 0, float("nan")
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    steps = (np.diff(azimuth) + np.pi) % (2.0 * np.pi) - np.pi
    turned = float(steps.sum())
    is_turn = _ONE_TURN_RAD[0] < abs(turned) < _ONE_TURN_RAD[1] and float(np.median(np.abs(steps))) < _NEXT_RAD
    return int(np.sign(turned)) * is_turn, float(azimuth[0])
