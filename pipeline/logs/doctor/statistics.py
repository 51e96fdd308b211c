"""Statistics of a log's scans, computed in one pass, as the doctor's checks need them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.data import RawPoints
from scanchain.errors import InputError
from scanchain.logs.log import Log
from scanchain.logs.mcap.selection import whole_span
from scanchain.logs.mcap.stream import decoded_messages
from scanchain.logs.messages.cdr import MalformedMessageError
from scanchain.logs.messages.laser_scan import LaserScanDecoder, LaserScanMessage
from scanchain.logs.messages.point_cloud import PointCloudDecoder, PointCloudMessage, column
from scanchain.logs.messages.point_times import PointTimes
from scanchain.logs.messages.poses import StampedPose
from scanchain.logs.messages.readers import is_scan
from scanchain.logs.messages.returns import Returns
from scanchain.words import grouped

_FORGOTTEN = np.empty(0)
_NO_POINTS = np.empty((0, 2), np.float32)
_SAMPLED = 10  # number of scans whose points are analyzed

RING_FIELDS = ("ring", "line", "channel")
_AZIMUTHS, _ELEVATIONS = 72, 64  # cells of an outline
_STEEPEST = 0.7  # sine of the elevation of the uppermost cells
_OUTLINE_POINTS = 8192
_PERCENT = np.arange(101)
_NEXT_RAD = 0.2  # largest angle from one point to the next, usually, where their order is that of firing
_ONE_TURN_RAD = (1.5 * np.pi, 2.5 * np.pi)  # one revolution; clouds stored ring by ring turn many times

_QUARTER = 75.0  # percentile of the cells' changes: a wall ahead moves, those beside do not
_STILL_M = {2: 0.03, 3: 0.08}  # largest change at rest: above the noise of such scanners
LEAST_S = 1.0  # seconds below which a rest is not recorded


@dataclass(frozen=True, slots=True)
class Survey:
    """Statistics of a log's scans and wheels.

    Attributes
    ----------
    scans : facts of each readable scan, in the order of log time, their points and outlines left out
    log_ns, stamps_ns : (N,) int64 log times and header stamps of those scans
    samples : (N, d) meters, points of some ten scans from all over the log
    rests : when the surroundings stayed as they were, for a second or more
    wheels : poses of the wheels, in the order of log time; empty where there are none
    malformed : what is wrong with each message that is not readable
    point_times : what a run assumes about per-point times
    damage : what of the files could not be read
    """

    log: Log
    scans: tuple[ScanFacts, ...]
    log_ns: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    samples: tuple[RawPoints, ...]
    rests: tuple[Rest, ...]
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

    def share(self, part: Callable[[ScanFacts], int]) -> float:
        """A count of beams over all beams of all scans."""
        return sum(part(scan) for scan in self.scans) / max(sum(scan.beams for scan in self.scans), 1)


def survey(log: Log, progress: Callable[[int, int], None] | None = None) -> Survey:
    """Statistics of every scan of the chosen part. Raises InputError where none is readable."""
    times = PointTimes(log.config)
    decoders = {log.topic: facts_of(log.decoder(times)), **log.pose_decoders}
    damage = [line for index in log.indexes for line in index.damage]
    scans: list[ScanFacts] = []
    log_ns: list[int] = []
    samples: list[RawPoints] = []
    wheels: list[StampedPose] = []
    malformed: list[str] = []
    watch, read = RestWatch(log.dimension), 0
    for message in decoded_messages(log.indexes, decoders, log.span, damage=damage):
        match message.value:
            case ScanFacts() as facts:
                read += 1
                if (read - 1) % log.config.every:  # left out by a run
                    continue
                if len(scans) % max(1, log.scan_count // _SAMPLED) == 0 and facts.kept:
                    samples.append(facts.points)
                scans.append(facts._replace(outline=_FORGOTTEN, points=_NO_POINTS))
                watch.take(facts.outline, message.log_time_ns)
                log_ns.append(message.log_time_ns)
                if progress is not None:
                    progress(len(scans), log.scan_count)
            case StampedPose() as pose if message.channel.topic == log.odometry_topic:
                wheels.append(pose)
            case MalformedMessageError() as error if message.channel.topic == log.topic:
                malformed.append(str(error))
    watch.close()
    if not scans:
        reasons = "; ".join([*malformed[:1], *grouped(damage)]) or "the chosen part is empty"
        raise InputError(f"{log.name}: no scan of {log.topic} could be read: {reasons}")
    stamps_ns = np.array([scan.stamp_ns for scan in scans], np.int64)
    assumed = "" if is_scan(log.lidar) else times.assumed
    return Survey(
        log=log,
        scans=tuple(scans),
        log_ns=np.array(log_ns, np.int64),
        stamps_ns=stamps_ns,
        samples=tuple(samples),
        rests=tuple(watch.rests),
        wheels=tuple(wheels),
        malformed=tuple(malformed),
        point_times=assumed,
        damage=tuple(grouped(damage)),
    )


class ScanFacts(NamedTuple):
    """Statistics of one scan.

    Attributes
    ----------
    beams : measurements in the message; ``undefined`` are NaN or infinite, ``zero`` are at no distance at all
    below : closer than ``limits_m``, though not at no distance
    kept : what a run would use
    limits_m : the least and the largest valid range of the message, 0 and inf where it states none
    farthest_m, at_farthest : the largest finite range and the number of beams with just that one
    ranges_m : (101,) percentiles of the ranges that are kept, NaN where none is
    time_span_s : of the per-point times, NaN where there are none
    turn : 1 if the points, in their order, go around once counter-clockwise, −1 if clockwise, else 0
    start_rad : azimuth of the first point
    rings : rings with returns, 0 where points have no field for it
    digest : of the measurements, equal for equal ones
    points : (N, d) meters, those that are kept
    outline : (C,) meters, mean distance in each cell of direction, NaN where nothing was seen
    """

    stamp_ns: int
    frame: str
    beams: int
    undefined: int
    zero: int
    below: int
    kept: int
    limits_m: tuple[float, float]
    farthest_m: float
    at_farthest: int
    ranges_m: NDArray[np.float32]
    time_span_s: float
    turn: int
    start_rad: float
    rings: int
    digest: int
    points: RawPoints
    outline: NDArray[np.float64]


def facts_of(decoder: LaserScanDecoder | PointCloudDecoder) -> Callable[[memoryview], ScanFacts]:
    """Function from a message to its statistics, by a run's decoder."""
    if isinstance(decoder, LaserScanDecoder):
        return lambda data: _of_scan(decoder, decoder.read(data))
    return lambda data: _of_cloud(decoder, decoder.read(data))


def _of_scan(decoder: LaserScanDecoder, message: LaserScanMessage) -> ScanFacts:
    limits_m = message.range_min_m, message.range_max_m if message.range_max_m > 0.0 else float("inf")
    digest = zlib.crc32(message.ranges_m.tobytes())
    return _facts(decoder.returns(message), message.frame, message.ranges_m, limits_m, 0, digest)


def _of_cloud(decoder: PointCloudDecoder, message: PointCloudMessage) -> ScanFacts:
    returns = decoder.returns(message)
    x, y, z = (np.asarray(column(message, name), np.float32) for name in "xyz")
    with np.errstate(over="ignore", invalid="ignore"):
        ranges_m = np.sqrt(x * x + y * y + z * z)
    rings = next((values for name in RING_FIELDS if (values := column(message, name)) is not None), None)
    seen = 0 if rings is None else len(np.unique(rings[np.isfinite(ranges_m) & (ranges_m > 0.0)]))
    limits_m = (decoder.limits.min_m, float("inf"))
    return _facts(returns, message.frame, ranges_m, limits_m, seen, zlib.crc32(message.data))


def _facts(
    returns: Returns,
    frame: str,
    ranges_m: NDArray[np.float32],
    limits_m: tuple[float, float],
    rings: int,
    digest: int,
) -> ScanFacts:
    finite = ranges_m[np.isfinite(ranges_m)]
    farthest_m = float(finite.max()) if len(finite) else float("nan")
    kept_m = np.sqrt(np.sum(np.square(returns.points), axis=1))
    kept_m = np.percentile(kept_m, _PERCENT) if len(kept_m) else np.full(len(_PERCENT), np.nan)
    times_s = returns.times_s
    turn, start_rad = _turning(returns.points)
    return ScanFacts(
        stamp_ns=returns.stamp_ns,
        frame=frame,
        beams=len(ranges_m),
        undefined=len(ranges_m) - len(finite),
        zero=int(np.count_nonzero(finite == 0.0)),
        below=int(np.count_nonzero((finite > 0.0) & (finite < limits_m[0]))),
        kept=len(returns.points),
        limits_m=limits_m,
        farthest_m=farthest_m,
        at_farthest=int(np.count_nonzero(finite == np.float32(farthest_m))),
        ranges_m=kept_m.astype(np.float32),
        time_span_s=float(times_s.max() - times_s.min()) if len(times_s) else float("nan"),
        turn=turn,
        start_rad=start_rad,
        rings=rings,
        digest=digest,
        points=returns.points,
        outline=_outline(returns.points),
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


def _outline(points: RawPoints) -> NDArray[np.float64]:
    """Mean distance by direction, of every so-many-th point."""
    some = points[:: max(1, len(points) // _OUTLINE_POINTS)].astype(np.float64)
    ranges_m = np.sqrt(np.sum(np.square(some), axis=1))
    cell = _cell(np.arctan2(some[:, 1], some[:, 0]) / np.pi, _AZIMUTHS)
    count = _AZIMUTHS
    if points.shape[1] == 3:
        cell = cell * _ELEVATIONS + _cell(some[:, 2] / np.maximum(ranges_m, 1e-9) / _STEEPEST, _ELEVATIONS)
        count *= _ELEVATIONS
    seen = np.bincount(cell, minlength=count)
    total_m = np.bincount(cell, ranges_m, minlength=count)
    return np.where(seen > 0, total_m / np.maximum(seen, 1), np.nan)


def _cell(place: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Index of a number's cell among ``count`` equal cells of [-1, 1]."""
    return np.clip((0.5 * (place + 1.0) * count).astype(np.int64), 0, count - 1)


class Rest(NamedTuple):
    """A time at rest, from one scan to another, by their indices and log times."""

    first: int
    last: int
    begin_ns: int
    end_ns: int

    @property
    def duration_s(self) -> float:
        """Seconds from the first scan to the last."""
        return (self.end_ns - self.begin_ns) * 1e-9


class RestWatch:
    """Detector of rests: compares each scan with the first one of a rest; ``rests`` last a second or more."""

    def __init__(self, dimension: int) -> None:
        self.still_m = _STILL_M[dimension]
        self.anchor: NDArray[np.float64] | None = None
        self.count = 0
        self.current = Rest(0, 0, 0, 0)
        self.rests: list[Rest] = []

    def take(self, outline: NDArray[np.float64], log_time_ns: int) -> None:
        """Add the next scan, by the mean distances (C,) of its cells."""
        if self.anchor is None or self._change_m(outline, self.anchor) > self.still_m:
            self.close()
            self.anchor = outline
            self.current = Rest(self.count, self.count, log_time_ns, log_time_ns)
        else:
            self.current = self.current._replace(last=self.count, end_ns=log_time_ns)
        self.count += 1

    def close(self) -> None:
        """Store the last rest if it was long enough."""
        if self.current.duration_s >= LEAST_S:
            self.rests.append(self.current)
        self.anchor = None

    @staticmethod
    def _change_m(outline: NDArray[np.float64], anchor: NDArray[np.float64]) -> float:
        change_m = np.abs(outline - anchor)
        change_m = change_m[np.isfinite(change_m)]
        return float(np.percentile(change_m, _QUARTER)) if len(change_m) else float("inf")
