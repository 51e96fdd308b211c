"""Times of the points of scans, whatever a driver's name and unit for them, and what refutes them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, pairwise
from math import inf, isfinite, nan
from statistics import median_low, mode
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.checks import LONGEST_SWEEP_S
from scanchain.config import LogConfig
from scanchain.data import RawPoints
from scanchain.errors import counted
from scanchain.kernels.geometry import largest_magnitude
from scanchain.logs.mcap.records import Decoded

NO_TIMES = np.empty(0, np.float32)
NO_TIMES.flags.writeable = False
_NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "timeOffset", "time_stamp")

UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NO, _AT_ONCE = "no point times", "every scan counts as measured at once"
_NONE = f"{_NO}: {_AT_ONCE}"
_STAMP, _EPOCH, _CLOCK = "after the stamp", "since the epoch", "of another clock, counted from the first point"
_SHORTEST_SCAN_NS = 500_000  # span of a scan's whole numbers, below which they are micro- or milliseconds
_LONGEST_SCAN = 1e4  # span in milliseconds, above which floats are micro- or nanoseconds
_NEAR_S = 1.0  # largest time between the stamp of a scan and its beginning
_ABSOLUTE_S = 3600.0  # least absolute time in seconds
_CORE = 0.7  # share of a scan's times, the densest, that tells its span: so many are right
_SAMPLE = np.sort(np.random.default_rng(0).random(512))  # places, 0 to 1, of times whose quantiles are taken

_BEFORE, _AFTER = 12, 3  # scans before and after a scan that are its neighbors
_SHORT, _LONG = 0.9, 1.2  # shares of the usual span outside which a sweep's times are looked at one by one
_LOW_RATE, _OVERLAPPED = 0.5, 1.25  # shares of the period outside which it does not confirm the usual span
_TAILS = 3.0  # spans of its core that a sweep is not longer than where the period says nothing
_FULL, _LONGEST = 0.85, 2.5  # least share of its core in a longer sweep that is right, up to so many usual spans
_OVERLAP = 10.0  # periods that no sweep is longer than, not one of a sliding window either
_STEP = 0.25  # of the usual span: a larger step back from point to point begins a row, or a counter anew
_COUNTERS, _WRAPPED = (1 << 16, 1 << 32), 0.98  # numbers at which counters wrap; share that the values then span
_EDGE = 0.1  # share of the span after which a sweep does not begin, and as much before which it does not end
_PART_OF_TURN, _MORE_THAN_TURN = 0.6, 1.2  # shares of a turn's time that the beams of one take, least and most
_FASTEST_TURN_S = 0.009  # no lidar turns faster
_SPANS = 100  # number of first scans whose point times are compared with the period
_SHORTEST_PART, _LONGEST_PART = 0.005, 2.0  # shares of the period outside which point times are of another unit

_LEFT_OUT = "contradict the others: these points are left out"
_UNWRAPPED = "fall back where a counter wrapped or was reset: repaired"
_ALL_SAME = "are constant: matched without them"
_ZERO = "are zero: matched without them"
_REFUTED = "contradict the period or the scans around: matched without them"
_BY_SCAN_TIME = "contradict scan_time and the period: taken from scan_time instead"
_NO_SCAN_TIME = "agree with the period, but not with scan_time, which is ignored"


class Field(NamedTuple):
    """Times of a cloud's points: ``values`` (N,) as in the message, of the type ``kind`` there.

    low : the least, but for some that lie farther below most than these spread
    span : of all, NaN where one is not finite; core : the same by the densest part; begin : few lie below
    unit, origin : by the message alone
    """

    name: str
    kind: str
    values: NDArray[np.int64 | np.float64]
    low: float
    span: float
    begin: float
    core: float
    unit: str
    origin: str

    def seconds(self, stamp_ns: int) -> NDArray[np.float32]:
        """Times (N,) after the stamp by unit and origin."""
        unit_s, zero = UNITS_S[self.unit], self.low if self.origin == _CLOCK else 0
        if self.origin == _EPOCH:
            zero = _in_units(stamp_ns, unit_s, is_whole=self.values.dtype.kind == "i")
        times_s = np.empty(len(self.values), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            values = self.values - zero if zero else self.values
            return np.multiply(values, unit_s, out=times_s, dtype=np.float64, casting="unsafe")

    def steps_back(self, least: float) -> int:
        """Number of points whose values fall so far behind those of the points before them."""
        with np.errstate(over="ignore", invalid="ignore"):
            return int(np.count_nonzero(np.diff(self.values) < -least))


class Beams(NamedTuple):
    """Times of a laser scan's beams: ``numbers`` (N,) came back, of so many, which cover so many turns."""

    numbers: NDArray[np.intp]
    beams: int
    turns: float
    increment_s: float
    scan_time_s: float

    def seconds(self, increment_s: float) -> NDArray[np.float32]:
        """Times (N,) after the stamp; (0,) where the beams are simultaneous."""
        with np.errstate(over="ignore", invalid="ignore"):
            return (increment_s * self.numbers).astype(np.float32) if increment_s else NO_TIMES


class Returns(NamedTuple):
    """The valid returns of one scan message.

    ``points`` (N, d) float32 meters, ``times_s`` (N,) float32 seconds after ``stamp_ns`` or (0,), by the message
    alone, which has them as ``stated``; ``dropped`` counts what was left out, ``why`` is the reason where nothing
    is left; ``frame`` is that of the points.
    """

    stamp_ns: int
    points: RawPoints
    times_s: NDArray[np.float32]
    dropped: int
    why: str
    frame: str = ""
    stated: Field | Beams | None = None


class PointTimes:
    """Seconds after the stamp for the points of scans.

    ``from_field`` reads them of each message alone, in any order and from any thread: the unit is that of
    ``log.point_times`` or, where that is ``auto``, the one that the values suggest. ``judged`` then repairs what
    the sweep's own majority, the period or the neighboring sweeps refute where a counter wrapped or was reset,
    else these points are left out; a sweep whose times are beyond repair has none afterwards.

    fields : names of those that hold times, the likeliest first
    assumed : how they are taken by one of the first scans that have times, empty where that needs no note
    spans_s, periods_s : time that sweeps usually take, and from one to the next, at each of them
    """

    def __init__(self, config: LogConfig) -> None:
        self.config = config
        self.unit = config.point_times if config.point_times in UNITS_S else ""
        self.by_azimuth = config.point_times in ("clockwise", "counterclockwise")
        self.fields = () if self.by_azimuth or config.point_times == "none" else _NAMES
        self.assumed = _NONE
        if self.by_azimuth:
            turn = f"{config.revolution_start_rad:.3g} rad, {config.revolution_s:g} s a turn"
            self.assumed = f"point times by the azimuth: {config.point_times} from {turn} (log.point_times)"
        self.spans_s: list[float] = []
        self.periods_s: list[float] = []
        self._number = self._counted = 0
        self._tallies: dict[str, list[tuple[str, int]]] = {}  # of what was done: the scan and its points

    def from_field(self, name: str, stamp_ns: int, values: NDArray[np.generic]) -> Field:
        """Raw values (N,), N > 0, with the unit and the origin that most of them suggest.

        Whole numbers are nanoseconds, or the next unit, micro- or milliseconds, in which the whole scan is not
        shorter than half a millisecond. Floats are seconds where they span up to 10, else milli-, micro- or
        nanoseconds by their span. Values within a second of the stamp are absolute, others count from it; those of
        another clock, the sensor's own or one that is off by the leap seconds, count from the first point.
        """
        is_whole, kind = values.dtype.kind in "iu", values.dtype.name
        values = values.astype(np.int64 if is_whole else np.float64)
        first, last = values.min(), values.max()  # NaN where one of the values is
        sample = np.sort(values[(_SAMPLE * len(values)).astype(np.intp)])
        span = float(last) - float(first)
        if not isfinite(span):
            sample, first = sample[np.isfinite(sample)], values.min(where=np.isfinite(values), initial=np.inf)
            span = nan
        many = int(_CORE * len(sample))
        with np.errstate(over="ignore"):
            core = float((sample[many:] - sample[: len(sample) - many]).min()) / _CORE if many else 0.0
        core = span if core > span else core  # of few points
        begin = sample[(len(sample) - many) // 2] if many else first
        low = first
        if float(first) < float(begin) - core:
            low = values.min(where=values >= float(begin) - core, initial=begin)
        unit = self.unit or _likely_unit(core, is_whole=is_whole)
        low_s, origin = float(low) * UNITS_S[unit], _STAMP
        after = float(low) - float(_in_units(stamp_ns, UNITS_S[unit], is_whole=is_whole))
        if abs(after) * UNITS_S[unit] < _NEAR_S and low_s > _ABSOLUTE_S:
            origin = _EPOCH
        elif abs(low_s) > _NEAR_S:
            origin = _CLOCK
        field = Field(name, kind, values, low, span, begin, core, unit, origin)
        if core > 0.0 and self.assumed.startswith(_NO):
            self.assumed = _taken(field)
        elif self.assumed == _NONE and span == 0.0 and len(values) > 1:  # as a float32 holds absolute times
            self.assumed = f"{_NO}: field {name} ({kind}) is there and constant ({first:.10g}); {_AT_ONCE}"
        return field

    def judged(self, messages: Iterable[Decoded], topic: str) -> Iterator[Decoded]:
        """The messages in their order, the topic's scans with times that hold."""
        waiting, behind, ahead = deque[Decoded](), deque[Returns](maxlen=_BEFORE), deque[Returns]()
        for message in chain(messages, [None]):
            if message is not None:
                waiting.append(message)
                if isinstance(message.value, Returns) and message.channel.topic == topic:
                    ahead.append(message.value)
            while waiting and (
                message is None or len(ahead) > _AFTER or not ahead or waiting[0].value is not ahead[0]
            ):
                first = waiting.popleft()
                if ahead and first.value is ahead[0]:
                    frame = ahead[0].frame
                    around = [each for each in (*behind, *ahead) if len(each.points) and each.frame == frame]
                    first = first._replace(value=self._judge(ahead[0], around))
                    behind.append(ahead.popleft())
                self._number += first.channel.topic == topic
                yield first

    def faults(self, topic: str) -> list[str]:
        """Times that were repaired, ignored or left out, and how many."""
        lines, scans = [], f"{counted(self._counted, 'scan')} of {topic}"
        for done, those in self._tallies.items():
            points = sum(points for _, points in those)
            many = f"{counted(points, 'point')} in {len(those)}" if points else f"{len(those)}"
            if done != _ZERO or len(those) < self._counted:
                lines.append(f"times of {many} of {scans} {done} (the first: {those[0][0]})")
        return lines

    def warnings(self, topic: str) -> list[str]:
        """A line where the sweeps' times are of another unit by the period."""
        span_s, period_s = (median_low(each[:_SPANS] or [0.0]) for each in (self.spans_s, self.periods_s))
        if not span_s or not period_s or _SHORTEST_PART < span_s / period_s < _LONGEST_PART:
            return []
        return [
            f"by their point times scans of {topic} last {1e3 * span_s:.3g} ms, {span_s / period_s:.2g} of the "
            "period: of another unit? scanchain doctor names the flag, --preprocess.deskew false ignores them"
        ]

    def _judge(self, returns: Returns, around: Sequence[Returns]) -> Returns:
        times_s, points, done, seen = returns.times_s, returns.points, "", ""
        if not len(points):
            return returns
        if isinstance(returns.stated, Beams):
            times_s, done, seen = self._of_beams(returns.stated, times_s, around)
        elif returns.stated is not None:
            times_s, done, seen = self._of_field(returns, returns.stated, around)
        if done == _LEFT_OUT:
            kept = np.isfinite(times_s)
            times_s, points = times_s[kept], points[kept]
        if len(times_s) and not (farthest_s := largest_magnitude(times_s)) <= LONGEST_SWEEP_S:
            points, times_s, done, seen = (
                returns.points,
                NO_TIMES,
                _REFUTED,
                f"a point {farthest_s:.3g} s from the stamp",
            )
        left = len(returns.points) - len(points)
        if self._number % self.config.every == 0:
            self._counted += 1
            if done:
                self._tallies.setdefault(done, []).append((f"scan {self._number}: {seen}", left))
        return returns._replace(points=points, times_s=times_s, dropped=returns.dropped + left, stated=None)

    def _of_beams(self, beams: Beams, times_s: NDArray[np.float32], around: Sequence[Returns]) -> _Judged:
        """Times of a laser scan, whose ``time_increment``, ``scan_time`` and period should agree; two must."""
        if beams.increment_s == 0.0:
            return NO_TIMES, _ZERO, "time_increment"
        steps_s, turns = _steps_s(around), min(beams.turns, 1.0)
        period_s, longest_s = median_low(steps_s), max(steps_s)
        for unit in [self.unit] if self.unit else UNITS_S:
            unit_s, is_plain = UNITS_S[unit], unit in ("s", self.unit)
            whole_s, scan_s = unit_s * abs(beams.increment_s) * beams.beams, unit_s * beams.scan_time_s
            is_by_scan, is_by_period = _fits(whole_s, scan_s, turns), _fits(whole_s, period_s, turns)
            is_contradicted = not is_by_scan and scan_s != 0.0 and period_s > 0.0
            most_s = _MORE_THAN_TURN * (longest_s if is_by_scan else period_s) or LONGEST_SWEEP_S
            is_possible = is_plain and _FASTEST_TURN_S * turns <= whole_s <= most_s
            if (is_by_period and is_plain) or (not is_contradicted and (is_by_period or is_possible)):
                self.spans_s.append(whole_s)
                self.assumed = (
                    "" if unit == "s" else f"point times: time_increment taken as {unit} (log.point_times)"
                )
                times_s = times_s if is_plain else beams.seconds(unit_s * beams.increment_s)
                return times_s, _NO_SCAN_TIME if is_contradicted else "", f"{beams.scan_time_s:g} s"
        seen = f"time_increment {beams.increment_s:g} s of {beams.beams} beams, scan_time {beams.scan_time_s:g} s"
        seen += f", period {period_s:.3g} s"
        if not (period_s and _fits(beams.scan_time_s, period_s, 1.0)):
            return NO_TIMES, _REFUTED, seen
        self.assumed, step_s = "", turns * beams.scan_time_s / beams.beams
        return beams.seconds(-step_s if beams.increment_s < 0.0 else step_s), _BY_SCAN_TIME, seen

    def _of_field(self, returns: Returns, field: Field, around: Sequence[Returns]) -> _Judged:
        """Times of a cloud by its neighbors, its own majority and the period; NaN where they are refuted."""
        if not field.core > 0.0:
            return NO_TIMES, _ALL_SAME, f"field {field.name}"
        fields = [each.stated for each in around if isinstance(each.stated, Field) and each.stated.core > 0.0]
        unit, period_s, times_s = mode(each.unit for each in fields), median_low(_steps_s(around)), returns.times_s
        unit_s, is_running = UNITS_S[unit], field.origin == _STAMP and _is_running(around, UNITS_S[unit])
        if unit != field.unit or is_running:
            field = field._replace(unit=unit, origin=_CLOCK if is_running else field.origin)
            times_s = field.seconds(returns.stamp_ns)
        self.assumed = self.assumed if self.spans_s else _taken(field)
        usual_s = _usual_span_s(fields, unit_s, period_s)
        self.spans_s.append(usual_s)
        self.periods_s.append(period_s)
        seen = f"{field.span * unit_s:.3g} s, usually {usual_s:.3g} s, period {period_s:.3g} s"
        if usual_s > (_OVERLAP * period_s or LONGEST_SWEEP_S):
            return NO_TIMES, _REFUTED, seen
        regular = [each for each in fields if _SHORT * usual_s <= each.span * unit_s <= _LONG * usual_s]
        lows_s = [unit_s * float(each.low) for each in regular if each.origin == field.origin == _STAMP]
        low_s, wanted_s, done = median_low(lows_s or [0.0]), _wrapped_span_s(field, usual_s, period_s), ""
        if wanted_s or not _SHORT * usual_s <= field.span * unit_s <= _LONG * usual_s:
            back = regular[0].steps_back(_STEP * usual_s / unit_s) if regular else -1
            times_s, done = _point_by_point(field, times_s, back, usual_s, wanted_s)
            if done == _UNWRAPPED or (done == _LEFT_OUT and field.origin == _CLOCK):
                times_s -= np.nanmin(times_s) - np.float32(low_s) if field.origin != _EPOCH else np.float32(0.0)
        elif (
            lows_s
            and abs(off_s := unit_s * float(field.low) - low_s) > 0.5 * usual_s
            and (2 * sum(abs(each_s - low_s) < _STEP * usual_s for each_s in lows_s) > len(around))
        ):
            return NO_TIMES, _REFUTED, f"begins {off_s:+.3g} s from there"
        return times_s, done, seen


_Judged = tuple[
    NDArray[np.float32], str, str
]  # times (N,), what was done to them and why, the values that led to it


def from_azimuth(points: RawPoints, config: LogConfig) -> NDArray[np.float32]:
    """Times (N,) of points (N, d) by the lidar's turn since its start, which is at the stamp."""
    sense = -1.0 if config.point_times == "clockwise" else 1.0
    turned = sense * (np.arctan2(points[:, 1], points[:, 0]) - config.revolution_start_rad)
    return (turned % (2.0 * np.pi) * (config.revolution_s / (2.0 * np.pi))).astype(np.float32)


def _taken(field: Field) -> str:
    return f"point times: field {field.name} ({field.kind}) taken as {field.unit} {field.origin} (log.point_times)"


def _in_units(stamp_ns: int, unit_s: float, *, is_whole: bool) -> float:
    per_second = round(1.0 / unit_s)
    return stamp_ns * per_second // 1_000_000_000 if is_whole else stamp_ns * 1e-9 * per_second


def _likely_unit(span: float, *, is_whole: bool) -> str:
    if is_whole:
        return "ns" if span >= _SHORTEST_SCAN_NS else "us" if 1e3 * span >= _SHORTEST_SCAN_NS else "ms"
    if span <= 10.0:
        return "s"
    if span <= _LONGEST_SCAN:
        return "ms"
    return "us" if span <= 1e3 * _LONGEST_SCAN else "ns"


def _steps_s(around: Sequence[Returns]) -> list[float]:
    """Times from scan to scan by their stamps, 0 where one goes back or is alone."""
    return [max(1e-9 * (after.stamp_ns - before.stamp_ns), 0.0) for before, after in pairwise(around)] or [0.0]


def _fits(whole_s: float, turn_s: float, turns: float) -> bool:
    """True of the time of all beams where a lidar turns once in ``turn_s`` and they cover so much of a turn."""
    return _PART_OF_TURN * turns * turn_s <= whole_s <= _MORE_THAN_TURN * turn_s < inf


def _is_running(around: Sequence[Returns], unit_s: float) -> bool:
    """True where the first values grow from scan to scan like the stamps: of a clock, though it was just reset."""
    steps = [
        (unit_s * (float(after.begin) - float(before.begin)), 1e-9 * (scan.stamp_ns - last.stamp_ns))
        for (last, before), (scan, after) in pairwise((each, each.stated) for each in around)
        if isinstance(before, Field) and isinstance(after, Field)
    ]
    return 2 * sum(abs(by_field_s - by_stamp_s) < 0.2 * by_stamp_s for by_field_s, by_stamp_s in steps) > len(
        steps
    )


def _usual_span_s(fields: Sequence[Field], unit_s: float, period_s: float) -> float:
    """Time that sweeps take by their extremes, or by most of their points where the period refutes these."""
    span_s = unit_s * median_low([each.span if isfinite(each.span) else each.core for each in fields])
    core_s = unit_s * median_low([each.core for each in fields])
    if core_s >= _FULL * span_s:
        return span_s
    if period_s and span_s > _OVERLAPPED * period_s:
        return min(span_s, max(period_s, core_s))
    return span_s if span_s >= _LOW_RATE * period_s > 0.0 else min(span_s, _TAILS * core_s)


def _wrapped_span_s(field: Field, usual_s: float, period_s: float) -> float:
    """Time of a sweep in which a counter may have wrapped or been reset, though it spans what others do, else 0.

    Its values span all that a counter has, or they fall back once: in a sweep that ends where it began, or that is
    half as long as the period.
    """
    if any(_WRAPPED * most < field.span < most and field.low >= 0.0 for most in _COUNTERS):
        return period_s or usual_s
    first, last = (float(field.values[place]) - float(field.low) for place in (0, -1))
    is_turned = first > _EDGE * field.span and last < (1.0 - _EDGE) * field.span
    is_part = _LOW_RATE * _SHORT * period_s < usual_s < _SHORT * period_s
    is_reset = (is_turned or is_part) and field.steps_back(_STEP * usual_s / UNITS_S[field.unit]) == 1
    return 0.0 if not is_reset else usual_s if is_turned else period_s


def _point_by_point(
    field: Field, times_s: NDArray[np.float32], usual_back: int, usual_s: float, wanted_s: float
) -> tuple[NDArray[np.float32], str]:
    """Times of a sweep that lasts longer or shorter than usual, NaN where they are refuted, and what was done.

    usual_back : steps back in a regular sweep, −1 if unknown; wanted_s : time if a counter wrapped in it, else 0
    """
    is_finite = np.isfinite(times_s)
    values = times_s[is_finite].astype(np.float64)
    span_s = float(np.ptp(values))
    if is_finite.all():
        back = field.steps_back(_STEP * usual_s / UNITS_S[field.unit])
        is_reset = back > usual_back >= 0
        for total_s in (usual_s, wanted_s):
            unwrapped = _unwrapped(values, span_s, total_s) if wanted_s or is_reset or span_s > usual_s else None
            if unwrapped is not None:
                return unwrapped.astype(np.float32), _UNWRAPPED
        if span_s <= _LONG * usual_s:
            return (NO_TIMES, _REFUTED) if is_reset and 2 * back >= 3 * usual_back + 2 else (times_s, "")
        if span_s <= _LONGEST * usual_s and field.core * UNITS_S[field.unit] >= _FULL * span_s:
            return times_s, ""
    order, most_s = np.sort(values), _LONG * usual_s
    begin_s = order[np.argmax(np.searchsorted(order, order + most_s, "right") - np.arange(len(order)))]
    is_kept = (times_s >= begin_s) & (times_s <= begin_s + most_s)
    if 2 * np.count_nonzero(is_kept) <= len(is_kept):
        return NO_TIMES, _REFUTED
    return np.where(is_kept, times_s, np.float32(nan)), _LEFT_OUT


def _unwrapped(times_s: NDArray[np.float64], span_s: float, total_s: float) -> NDArray[np.float64] | None:
    """Times that go on where a counter fell back, None where they do not take about ``total_s`` then.

    Either each step back from point to point is one, or the sorted times have one gap, with the first point before
    it and the last one behind it, or the other way round.
    """
    steps, near_s = np.diff(times_s), (1.0 - _SHORT) * total_s
    is_back = steps < -_STEP * total_s
    raised = times_s - np.append(0.0, np.cumsum(np.where(is_back, steps, 0.0)))
    if is_back.any() and abs(np.ptp(raised) - total_s) <= near_s:
        return raised
    order = np.sort(times_s)
    gaps = np.diff(order)
    gap_s, is_low = gaps.max(), times_s <= order[gaps.argmax()]
    if is_low[0] == is_low[-1] or gap_s < _STEP * total_s or abs(span_s - gap_s - total_s) > near_s:
        return None
    return times_s - np.where(is_low, 0.0, gap_s) if is_low[0] else times_s + np.where(is_low, span_s, 0.0)
