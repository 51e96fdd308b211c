"""Times of the points of scans: their field, unit and origin, and the correction of wrong ones."""

from __future__ import annotations

import re
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
from scanchain.data import OtherPoints, RawPoints
from scanchain.errors import counted
from scanchain.kernels.geometry import largest_magnitude
from scanchain.logs.index import Decoded

NO_TIMES = np.empty(0, np.float32)
NO_TIMES.flags.writeable = False
_NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "timeOffset", "time_stamp")  # the most likely
_NAME = re.compile(r"ts?|t_?(ms|us|ns|offset)|.*(time|stamp).*", re.IGNORECASE)  # of a field with times

UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NO, _AT_ONCE = "no point times", "every scan counts as measured at once"
UNTIMED = f"{_NO}: {_AT_ONCE}"
_STAMP, _EPOCH, _CLOCK = "after the stamp", "since the epoch", "of another clock, counted from the first point"
# unit and origin of the times of one message
_SHORTEST_SCAN_NS = 500_000  # shortest span of a scan: integers with a smaller one are micro- or milliseconds
_LONGEST_SCAN = 1e4  # longest span in milliseconds: floats with a larger one are micro- or nanoseconds
_NEAR_S = 1.0  # longest time between the stamp of a scan and its beginning
_ABSOLUTE_S = 3600.0  # smallest time that can be absolute, as it may also count from the stamp
_CORE = 0.7  # share of correct times assumed in a scan: the span of its densest part is not affected by the others
_SAMPLE = np.sort(np.random.default_rng(0).random(512))  # positions, 0 to 1, of the times that are sampled

# comparison with the neighboring scans and the period; chosen with the drivers of tests/logs/test_point_times.py
_NEIGHBORS = (12, 3)  # number of them before and after a scan
_SHORT, _LONG = 0.9, 1.2  # limits of a span as a share of the usual span or of the period
_DENSE = 0.85  # smallest share of the core in the span of a sweep without outliers
_LONGEST, _MOST_PERIODS = 2.5, 10.0  # longest sweep without outliers in usual spans, and any sweep in periods
_STEP = 0.25  # share of the usual span above which a step back starts a row, or is a reset of the counter
_PART_OF_TURN = 0.6  # smallest share of the time of a turn that its beams take
_COARSE = 0.02  # spacing of times, as a share of the usual span, above which float32 does not resolve them
_PARTS = (0.005, 2.0)  # limits of a span as a share of the period: outside, the unit is wrong

_LEFT_OUT = "contradict the others: these points are left out"
_UNWRAPPED = "step back where a counter wrapped or was reset: repaired"
_ALL_SAME = "are constant: matched without them"
_ZERO = "are zero: matched without them"
_REFUTED = "contradict the period or the neighboring scans: matched without them"
_NO_SCAN_TIME = "agree with the period, but not with scan_time, which is ignored"

_Judged = tuple[NDArray[np.float32], str, str]  # times (N,), their treatment, and the values that were the reason


class Field(NamedTuple):
    """Times of a cloud's points.

    values : (N,) as in the message, of the type ``kind`` there
    low : the smallest without outliers
    span : of all values, infinite if one is not finite; core : by the densest part of them
    unit, origin : inferred from the message alone
    """

    name: str
    kind: str
    values: NDArray[np.int64 | np.float64]
    low: float
    span: float
    core: float
    unit: str = ""
    origin: str = ""

    def seconds(self, stamp_ns: int) -> NDArray[np.float32]:
        """Times (N,) after the stamp, by unit and origin."""
        unit_s, zero = UNITS_S[self.unit], self.low if self.origin == _CLOCK else 0
        if self.origin == _EPOCH:
            zero = _in_units(stamp_ns, unit_s, is_whole=self.values.dtype.kind == "i")
        times_s = np.empty(len(self.values), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            values = self.values - zero if zero else self.values
            return np.multiply(values, unit_s, out=times_s, dtype=np.float64, casting="unsafe")

    def in_unit(self, unit: str, stamp_ns: int) -> Field:
        """The field with another unit, and the origin that its values then suggest."""
        unit_s, origin = UNITS_S[unit], _STAMP
        after = float(self.low) - float(_in_units(stamp_ns, unit_s, is_whole=self.values.dtype.kind == "i"))
        if abs(after) * unit_s < _NEAR_S and self.low * unit_s > _ABSOLUTE_S:
            origin = _EPOCH
        elif abs(self.low * unit_s) > _NEAR_S:
            origin = _CLOCK
        return self._replace(unit=unit, origin=origin)

    def steps_back(self, least_s: float) -> NDArray[np.int64 | np.float64]:
        """Steps (N - 1,) from point to point that go back by more than ``least_s``; 0 for all others."""
        with np.errstate(over="ignore", invalid="ignore"):
            steps = np.diff(self.values)
        return np.where(steps < -least_s / UNITS_S[self.unit], steps, 0)


class Beams(NamedTuple):
    """Times of a laser scan's beams; ``numbers`` (N,) are those of the valid returns."""

    numbers: NDArray[np.intp]
    beams: int
    turns: float
    increment_s: float
    scan_time_s: float

    def seconds(self, increment_s: float) -> NDArray[np.float32]:
        """Times (N,) after the stamp; (0,) if the beams are simultaneous."""
        with np.errstate(over="ignore", invalid="ignore"):
            return (increment_s * self.numbers).astype(np.float32) if increment_s else NO_TIMES


class Returns(NamedTuple):
    """The valid returns of one message.

    points : (N, d) float32 meters, in ``frame``
    times_s : (N,) float32 seconds after ``stamp_ns``, or (0,); inferred from the message alone
    dropped : number of invalid returns; why : reason if no return is valid
    stated : times as in the message
    others : sweeps of other lidars, in the frame of the first publisher of the topic
    odd : contradiction in the angles of a laser scan, or the size of a cloud, as text
    """

    stamp_ns: int
    points: RawPoints
    times_s: NDArray[np.float32]
    dropped: int
    why: str
    frame: str = ""
    stated: Field | Beams | None = None
    others: tuple[OtherPoints, ...] = ()
    odd: str = ""

    @property
    def middle_ns(self) -> int:
        """Time in the middle of the points."""
        ends_s = (float(self.times_s.min()), float(self.times_s.max())) if len(self.times_s) else (0.0, 0.0)
        return self.stamp_ns + round(0.5e9 * sum(ends_s))

    @property
    def end_ns(self) -> int:
        """Stamp of its last point."""
        return self.stamp_ns + (round(1e9 * float(self.times_s.max())) if len(self.times_s) else 0)

    def seconds(self, unit: str) -> NDArray[np.float32]:
        """Stated times (N,) after the stamp in this unit; (0,) if there are none or they are constant."""
        if isinstance(self.stated, Beams):
            return self.stated.seconds(UNITS_S[unit] * self.stated.increment_s)
        if self.stated is None or not self.stated.span:
            return NO_TIMES
        return self.stated.in_unit(unit, self.stamp_ns).seconds(self.stamp_ns)


class PointTimes:
    """Reader of point times, as seconds after the stamp.

    ``from_field`` reads the times of each message alone, in any order and from any thread, in the unit of
    ``log.point_times`` or, if that is ``auto``, in the one suggested by the values. ``checked`` compares them with
    the majority in the sweep, the period and the neighboring sweeps: times after a wrap or reset of a counter are
    repaired, points with other wrong times removed, and all times of a sweep with mostly wrong ones ignored.

    assumed : note on the assumed unit and origin, from one of the first scans with times; empty if needless
    spans_s, periods_s : usual duration of sweeps and time between them, at each sweep
    """

    def __init__(self, config: LogConfig) -> None:
        self.config = config
        self.unit = config.point_times if config.point_times in UNITS_S else ""
        self.by_azimuth = config.point_times in ("clockwise", "counterclockwise")
        self.reads_fields = bool(self.unit) or config.point_times == "auto"
        self.assumed = UNTIMED
        if self.by_azimuth:
            turn = f"{config.revolution_start_rad:.3g} rad, {config.revolution_s:g} s per turn"
            self.assumed = f"point times by the azimuth: {config.point_times} from {turn} (log.point_times)"
        self.spans_s: list[float] = []
        self.periods_s: list[float] = []
        self._number = self._counted = 0
        self.coarse_s = 0.0  # spacing of times that float32 does not resolve
        self._tallies: dict[str, list[tuple[str, int]]] = {}  # by treatment: the scans and numbers of points

    def fields(self, names: Iterable[str]) -> list[str]:
        """Those of the names that are of fields with times, the most likely first; none if times are not read."""
        found = [name for name in names if self.reads_fields and _NAME.fullmatch(name)]
        return sorted(found, key=lambda name: _NAMES.index(name) if name in _NAMES else len(_NAMES))

    def from_field(self, name: str, stamp_ns: int, values: NDArray[np.generic]) -> Field:
        """Values (N,), N > 0, of a field, with the unit and the origin that most of them suggest.

        Integers are in the smallest unit, nano-, micro- or milliseconds, in which the scan lasts at least half a
        millisecond. Floats with a span up to 10 are seconds, others milli-, micro- or nanoseconds by their span.
        Values within a second of the stamp are absolute, others count from it; those of another clock (that of the
        sensor, or one that is off by leap seconds) count from the first point.
        """
        is_whole, kind = values.dtype.kind in "iu", values.dtype.name
        values = values.astype(np.int64 if is_whole else np.float64)
        first, last = values.min(), values.max()  # NaN where one of the values is
        sample = np.sort(values[(_SAMPLE * len(values)).astype(np.intp)])
        span = float(last) - float(first)
        if not isfinite(span):
            sample, first = sample[np.isfinite(sample)], values.min(where=np.isfinite(values), initial=np.inf)
            span = inf
        low, core, many = first, 0.0, int(_CORE * len(sample))
        if many:
            with np.errstate(over="ignore"):
                windows = (sample[many:] - sample[: len(sample) - many]).astype(np.float64)
            begin, core = float(sample[windows.argmin()]), float(windows.min()) / _CORE
            core = span if core > span else core  # of few points
            if float(first) < begin - core:
                low = values.min(where=values >= begin - core, initial=values.max())
        unit = self.unit or _likely_unit(core, is_whole=is_whole)
        field = Field(name, kind, values, low, span, core).in_unit(unit, stamp_ns)
        if core > 0.0 and self.assumed.startswith(_NO):
            self.assumed = _assumed(field)
        elif self.assumed == UNTIMED and span == 0.0 and len(values) > 1:  # as a float32 holds absolute times
            self.assumed = f"{_NO}: field {name} ({kind}) is constant ({first:.10g}); {_AT_ONCE}"
        return field

    def checked(self, messages: Iterable[Decoded], topic: str, *, most_ns: float = inf) -> Iterator[Decoded]:
        """Messages in their order, the scans of the topic with checked times, held back by ``most_ns`` at most."""
        waiting, before, ahead = deque[Decoded](), deque[Returns](maxlen=_NEIGHBORS[0]), deque[Returns]()
        for message in chain(messages, [None]):
            if message is not None:
                waiting.append(message)
                if isinstance(message.value, Returns) and message.channel.topic == topic:
                    ahead.append(message.value)
            while waiting and (
                message is None
                or len(ahead) > _NEIGHBORS[1]
                or not ahead
                or waiting[0].value is not ahead[0]
                or message.log_time_ns - waiting[0].log_time_ns > most_ns
            ):
                first = waiting.popleft()
                if ahead and first.value is ahead[0]:
                    frame = ahead[0].frame
                    around = [each for each in (*before, *ahead) if len(each.points) and each.frame == frame]
                    first = first._replace(value=self._check(ahead[0], around))
                    before.append(ahead.popleft())
                self._number += first.channel.topic == topic
                yield first

    def faults(self, topic: str) -> list[str]:
        """Lines on the numbers of times repaired, ignored or left out."""
        lines, scans = [], f"{counted(self._counted, 'scan')} of {topic}"
        for done, scans_done in self._tallies.items():
            points = sum(points for _, points in scans_done)
            many = f"{counted(points, 'point')} in {len(scans_done)}" if points else f"{len(scans_done)}"
            if done not in (_ZERO, _ALL_SAME) or len(scans_done) < self._counted:  # all are in the note
                lines.append(f"times of {many} of {scans} {done} (the first: {scans_done[0][0]})")
        return lines

    def warnings(self, topic: str) -> list[str]:
        """Warning if float32 does not resolve the times, or if by the period they are in another unit."""
        if self.coarse_s:
            step = f"point times of {topic} are {1e3 * self.coarse_s:.2g} ms apart, as float32 is at their size"
            return [f"{step}: publish them relative to the stamp; --log.point_times azimuth may do better"]
        # of the first scans
        span_s, period_s = (median_low(each[:100] or [0.0]) for each in (self.spans_s, self.periods_s))
        if not span_s or not period_s or _PARTS[0] < span_s / period_s < _PARTS[1]:
            return []
        return [
            f"by their point times scans of {topic} last {1e3 * span_s:.3g} ms, {span_s / period_s:.2g} of the "
            "period: is the unit wrong? scanchain doctor names the flag, --preprocess.deskew false ignores them"
        ]

    def _check(self, returns: Returns, around: Sequence[Returns]) -> Returns:
        times_s, points, done, seen = returns.times_s, returns.points, "", ""
        if not len(points):
            return returns
        if isinstance(returns.stated, Beams):
            times_s, done, seen = self._of_beams(returns.stated, around)
        elif returns.stated is not None:
            times_s, done, seen = self._of_field(returns, returns.stated, around)
        if done == _LEFT_OUT:
            is_valid = np.isfinite(times_s)
            times_s, points = times_s[is_valid], points[is_valid]
        if len(times_s) and not (farthest_s := largest_magnitude(times_s)) <= LONGEST_SWEEP_S:
            points, times_s, done = returns.points, NO_TIMES, _REFUTED
            seen = f"a point {farthest_s:.3g} s from the stamp"
        left = len(returns.points) - len(points)
        if self._number % self.config.every == 0:
            self._counted += 1
            if done:
                self._tallies.setdefault(done, []).append((f"scan {self._number}: {seen}", left))
        return returns._replace(points=points, times_s=times_s, dropped=returns.dropped + left, stated=None)

    def _of_beams(self, beams: Beams, around: Sequence[Returns]) -> _Judged:
        """Times of a laser scan if ``time_increment`` agrees with the period or ``scan_time``, or has neither."""
        if beams.increment_s == 0.0:
            return NO_TIMES, _ZERO, "time_increment"
        steps_s, turns = _steps_s(around), min(beams.turns, 1.0)
        period_s, longest_s = median_low(steps_s), max(steps_s) or LONGEST_SWEEP_S
        all_s = abs(beams.increment_s) * beams.beams
        for unit in [self.unit] if self.unit else UNITS_S:
            whole_s, scan_s = (UNITS_S[unit] * each for each in (all_s, beams.scan_time_s))
            is_by_scan, is_by_period = _fits(whole_s, scan_s, turns), _fits(whole_s, period_s, turns)
            most_s = min(_LONG * longest_s, _MOST_PERIODS * period_s or inf)
            if is_by_period or (whole_s <= most_s and (is_by_scan or not period_s)):
                self.spans_s.append(whole_s)
                note = f"point times: time_increment taken as {unit} (log.point_times)"
                self.assumed = "" if unit == "s" else note
                done = _NO_SCAN_TIME if period_s and scan_s and not is_by_scan else ""
                return beams.seconds(UNITS_S[unit] * beams.increment_s), done, f"{beams.scan_time_s:g} s"
        seen = f"time_increment {beams.increment_s:g} s of {beams.beams} beams, scan_time {beams.scan_time_s:g} s"
        return NO_TIMES, _REFUTED, f"{seen}, period {period_s:.3g} s"

    def _of_field(self, returns: Returns, field: Field, around: Sequence[Returns]) -> _Judged:
        """Times of a cloud checked by its neighbors, its majority and the period; NaN for wrong ones."""
        if not field.core > 0.0:
            return NO_TIMES, _ALL_SAME, f"field {field.name}"
        fields = [each.stated for each in around if isinstance(each.stated, Field) and each.stated.core > 0.0]
        unit, period_s = mode(each.unit for each in fields), median_low(_steps_s(around))
        unit_s, times_s = UNITS_S[unit], returns.times_s
        usual_s = _usual_span_s(fields, unit_s, period_s)
        steps_s = [unit_s * abs(float(b.low) - float(a.low)) for a, b in pairwise(fields)] or [0.0]
        is_running = field.origin == _STAMP and median_low(steps_s) > 0.5 * usual_s  # a clock that was just reset
        if is_running or unit != field.unit:
            field = field._replace(unit=unit, origin=_CLOCK if is_running else field.origin)
            times_s = field.seconds(returns.stamp_ns)
        self.assumed = self.assumed if self.spans_s else _assumed(field)
        self.spans_s.append(usual_s)
        self.periods_s.append(period_s)
        step_s = unit_s * float(np.spacing(np.float32(field.low)))
        self.coarse_s = step_s if field.kind == "float32" and step_s > _COARSE * usual_s else self.coarse_s
        seen = f"{field.span * unit_s:.3g} s, usually {usual_s:.3g} s, period {period_s:.3g} s"
        if usual_s > (_MOST_PERIODS * period_s or LONGEST_SWEEP_S):
            return NO_TIMES, _REFUTED, seen
        regular = [each for each in fields if _SHORT * usual_s <= each.span * unit_s <= _LONG * usual_s]
        lows_s = [unit_s * float(each.low) for each in regular if each.origin == field.origin == _STAMP]
        low_s = median_low(lows_s or [0.0])
        if not _SHORT * usual_s <= field.span * unit_s <= _LONG * usual_s:
            usual_back = int(np.count_nonzero(regular[0].steps_back(_STEP * usual_s))) if regular else 0
            return *_repaired(field, times_s, usual_s, low_s, usual_back), seen
        if lows_s and abs(off_s := unit_s * float(field.low) - low_s) > 0.5 * usual_s:
            return NO_TIMES, _REFUTED, f"begins {off_s:+.3g} s from there"
        return times_s, "", seen


def from_azimuth(points: RawPoints, config: LogConfig) -> NDArray[np.float32]:
    """Times (N,) of points (N, d) by the azimuth from that of the lidar at the stamp."""
    sense = -1.0 if config.point_times == "clockwise" else 1.0
    turned = sense * (np.arctan2(points[:, 1], points[:, 0]) - config.revolution_start_rad) % (2.0 * np.pi)
    turned[turned > 2.0 * np.pi - 1e-6] = 0.0  # else the first ray may be the last one
    return (turned * (config.revolution_s / (2.0 * np.pi))).astype(np.float32)


def _assumed(field: Field) -> str:
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
    """Times from scan to scan by their stamps, 0 for a step back or a single scan."""
    return [max(1e-9 * (after.stamp_ns - before.stamp_ns), 0.0) for before, after in pairwise(around)] or [0.0]


def _fits(whole_s: float, turn_s: float, turns: float) -> bool:
    """True if beams that cover ``turns`` turns of ``turn_s`` each can take ``whole_s``."""
    return _PART_OF_TURN * turns * turn_s <= whole_s <= _LONG * turn_s < inf


def _usual_span_s(fields: Sequence[Field], unit_s: float, period_s: float) -> float:
    """Usual duration of sweeps: their span, or that of most points if the period contradicts the span."""
    span_s = unit_s * median_low([each.span for each in fields])
    core_s = unit_s * median_low([each.core for each in fields])
    is_confirmed = core_s >= _DENSE * span_s or span_s <= (_LONG * period_s or 3.0 * core_s)
    return span_s if is_confirmed else max(period_s, core_s)


def _repaired(
    field: Field, times_s: NDArray[np.float32], usual_s: float, low_s: float, usual_back: int
) -> tuple[NDArray[np.float32], str]:
    """Times of a sweep that is longer or shorter than usual, NaN for wrong ones, and their treatment.

    low_s : usual time of the first point; usual_back : usual number of steps back, 0 in the order of firing
    """
    unit_s, span_s = UNITS_S[field.unit], field.span * UNITS_S[field.unit]
    steps = field.steps_back(_STEP * usual_s)
    if isfinite(span_s) and steps.any() and not usual_back:
        values = field.values - np.append(0, np.cumsum(steps))
        whole_s = unit_s * float(np.ptp(values))
        if _SHORT * usual_s <= whole_s <= _LONG * usual_s:
            return (low_s + unit_s * (values - values.min())).astype(np.float32), _UNWRAPPED
    if span_s < usual_s and np.count_nonzero(steps) > 1.5 * usual_back:  # reset, in each row or once
        return NO_TIMES, _REFUTED
    if span_s < usual_s or (span_s <= _LONGEST * usual_s and field.core * unit_s >= _DENSE * span_s):
        return times_s, ""
    order, most_s = np.sort(times_s[np.isfinite(times_s)]).astype(np.float64), _LONG * usual_s
    begin_s = order[np.argmax(np.searchsorted(order, order + most_s, "right") - np.arange(len(order)))]
    is_right = (times_s >= begin_s) & (times_s <= begin_s + most_s)
    if 2 * np.count_nonzero(is_right) <= len(is_right):
        return NO_TIMES, _REFUTED
    right_s = np.where(is_right, times_s, np.float32(nan))
    return (right_s - np.nanmin(right_s) if field.origin == _CLOCK else right_s), _LEFT_OUT
