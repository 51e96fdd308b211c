"""Point times of the sweeps of a log, judged by a sweep's own majority, the period and the neighboring sweeps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from math import inf, isfinite
from statistics import median_low, mode
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.checks import LONGEST_SWEEP_S
from scanchain.config import LogConfig
from scanchain.errors import counted
from scanchain.kernels.geometry import largest_magnitude
from scanchain.logs.mcap.records import Decoded
from scanchain.logs.messages.lidar import Returns
from scanchain.logs.messages.point_times import (
    CLOCK,
    EPOCH,
    NO_TIMES,
    NONE_ASSUMED,
    STAMP,
    UNITS_S,
    Beams,
    Field,
    PointTimes,
)

_BEFORE, _AFTER = 12, 3  # scans before and after a scan that are its neighbors
_SHORT, _LONG = 0.9, 1.2  # shares of the usual span outside which the times of a sweep are looked at one by one
_LOW_RATE, _OVERLAPPED = 0.5, 1.25  # shares of the period outside which it does not confirm the usual span
_TAILS = 3.0  # spans of its core that a sweep is not longer than where the period says nothing
_FULL = 0.85  # share of a sweep's span from which on its core fills it: it lasted that long
_LONGEST = 2.5  # usual spans that such a sweep is not longer than, as of two revolutions in one message
_OVERLAP = 10.0  # periods that no sweep is longer than, not one of a sliding window either
_STEP = 0.25  # of the usual span: a larger step back from point to point begins a row, or a counter anew
_COUNTERS, _WRAPPED = (1 << 16, 1 << 32), 0.98  # numbers at which counters wrap; share that the values then span
_EDGE = 0.1  # share of the span after which a sweep does not begin, and as much before which it does not end
_FEW = 0.01  # share of the points that are left out rather than joined to the others
_PART_OF_TURN, _MORE_THAN_TURN = 0.6, 1.2  # shares of a turn's time outside which the beams of one do not take it
_FASTEST_TURN_S = 0.009  # no lidar turns faster
_SPANS = 100  # number of first scans whose point times are compared with the period
_SHORTEST_PART, _LONGEST_PART = 0.005, 2.0  # shares of the period outside which point times are of another unit

_LEFT_OUT = "contradict the others: these points are left out"
_UNWRAPPED = "fall back where a counter wrapped or was reset: repaired"
_MOVED = "begin elsewhere or run backward, unlike those of the scans around: repaired"
_ALL_SAME = "are all the same: matched without them"
_ZERO = "are zero: matched without them"
_REFUTED = "contradict the period or the scans around: matched without them"
_BY_SCAN_TIME = "contradict scan_time and the period: taken from scan_time instead"
_NO_SCAN_TIME = "agree with the period, but not with scan_time, which is ignored"


class _Sweep(NamedTuple):
    """A scan, the ``number``-th of its topic."""

    number: int
    message: Decoded
    returns: Returns


class _Judgement(NamedTuple):
    """Times of a scan's points (N,), (0,) for none; ``kept`` marks the points (N,) that remain, None for all.

    done : what was done and why, empty where nothing; seen : the values that led to it
    """

    times_s: NDArray[np.float32]
    done: str = ""
    seen: str = ""
    kept: NDArray[np.bool_] | None = None


@dataclass
class _Tally:
    """Number of scans, and of their points, to which one thing was done; the first of them."""

    scans: int = 0
    points: int = 0
    first: str = ""


class SweepTimes:
    """Judges the times of a log's scans, which ``PointTimes`` made seconds by each message alone.

    What a sweep's own majority, the period or the neighboring sweeps refute is repaired where a counter wrapped or
    was reset, or where sign, unit or origin differ; else these points are left out. A sweep whose times are beyond
    repair has none.

    assumed : how the times are taken, empty where that needs no note
    spans_s, periods_s : time that a sweep usually takes, and from sweep to sweep, at each of them
    """

    def __init__(self, config: LogConfig, topic: str) -> None:
        self.topic, self.every = topic, config.every
        self.unit = config.point_times if config.point_times in UNITS_S else ""
        self.assumed = PointTimes(config).assumed
        self.spans_s: list[float] = []
        self.periods_s: list[float] = []
        self.scans = 0
        self._tallies: dict[str, _Tally] = {}

    def judged(self, messages: Iterable[Decoded]) -> Iterator[Decoded]:
        """The messages in their order, but scans with times that hold."""
        waiting, behind, ahead = deque[Decoded](), deque[_Sweep](maxlen=_BEFORE), deque[_Sweep]()
        number = 0
        for message in chain(messages, [None]):
            if message is not None:
                waiting.append(message)
                if message.channel.topic == self.topic:
                    if isinstance(message.value, Returns) and len(message.value.points):
                        ahead.append(_Sweep(number, message, message.value))
                    number += 1
            while waiting:
                if not ahead or waiting[0] is not ahead[0].message:
                    yield waiting.popleft()
                elif message is None or len(ahead) > _AFTER:
                    returns = self._judge([*behind, *ahead], len(behind))
                    behind.append(ahead.popleft())
                    yield waiting.popleft()._replace(value=returns)
                else:
                    break

    def _judge(self, around: Sequence[_Sweep], place: int) -> Returns:
        number, _, returns = around[place]
        is_counted = not number % self.every
        self.scans += is_counted
        found = _Judgement(returns.times_s)
        if isinstance(returns.stated, Beams):
            found = self._of_beams(returns.stated, returns, around, place)
        elif returns.stated is not None:
            found = self._of_field(returns.stated, returns, around)
        if len(found.times_s) and not (farthest_s := largest_magnitude(found.times_s)) <= LONGEST_SWEEP_S:
            found = _Judgement(NO_TIMES, _REFUTED, f"a point {farthest_s:.3g} s from the stamp")
        kept, points, dropped = found.kept, returns.points, 0
        if kept is not None:
            points, dropped = points[kept], len(kept) - int(np.count_nonzero(kept))
        if found.done and is_counted:
            tally = self._tallies.setdefault(found.done, _Tally(first=f"scan {number}: {found.seen}"))
            tally.scans += 1
            tally.points += dropped
        return Returns(returns.stamp_ns, points, found.times_s, returns.dropped + dropped, returns.why)

    def notes(self) -> list[str]:
        """How the times are taken, and what was done to those that do not hold."""
        return [*filter(None, [self.assumed]), *self.faults()]

    def faults(self) -> list[str]:
        """Times that were repaired, ignored or left out, and how many."""
        lines = []
        for done, tally in self._tallies.items():
            if done == _ZERO and tally.scans == self.scans:
                continue  # which is no fault
            points = f"{counted(tally.points, 'point')} in " if tally.points else ""
            scans = f"{tally.scans} of {counted(self.scans, 'scan')} of {self.topic}"
            lines.append(f"times of {points}{scans} {done} (the first: {tally.first})")
        return lines

    def warnings(self) -> list[str]:
        """A line where the sweeps' times are of another unit by the period."""
        span_s, period_s = (median_low(each[:_SPANS] or [0.0]) for each in (self.spans_s, self.periods_s))
        if not span_s or not period_s or _SHORTEST_PART < span_s / period_s < _LONGEST_PART:
            return []
        return [
            f"by their point times scans of {self.topic} last {1e3 * span_s:.3g} ms, {span_s / period_s:.2g} "
            "of the period: of another unit? scanchain doctor names the flag, --preprocess.deskew false "
            "ignores them"
        ]

    def _of_beams(self, beams: Beams, returns: Returns, around: Sequence[_Sweep], place: int) -> _Judgement:
        """Judgement of a laser scan, whose ``time_increment``, ``scan_time`` and period should agree; two must."""
        if beams.increment_s == 0.0:
            return _Judgement(NO_TIMES, _ZERO, "time_increment")
        period_s, turns = _period_s(around), min(beams.turns, 1.0)
        longest_s = max([period_s, *(_step_s(*each) for each in pairwise(around[max(place - 1, 0) : place + 2]))])
        for unit in [self.unit] if self.unit else UNITS_S:
            unit_s, is_plain = UNITS_S[unit], unit in ("s", self.unit)
            whole_s, scan_s = unit_s * abs(beams.increment_s) * beams.count, unit_s * beams.scan_time_s
            is_by_scan, is_by_period = _fits(whole_s, scan_s, turns), _fits(whole_s, period_s, turns)
            is_contradicted = not is_by_scan and scan_s != 0.0 and period_s > 0.0
            most_s = _MORE_THAN_TURN * (longest_s if is_by_scan else period_s) or LONGEST_SWEEP_S
            is_possible = is_plain and _FASTEST_TURN_S * turns <= whole_s <= most_s
            if (is_by_period and is_plain) or (not is_contradicted and (is_by_period or is_possible)):
                self.spans_s.append(whole_s)
                if unit_s != 1.0 or beams.increment_s < 0.0:
                    sense = "" if beams.increment_s > 0.0 else ", negative: the last beam is the first"
                    self.assumed = f"point times: time_increment taken as {unit}{sense} (log.point_times)"
                elif self.assumed == NONE_ASSUMED:
                    self.assumed = ""
                times_s = returns.times_s if is_plain else beams.seconds(unit_s * beams.increment_s)
                return _Judgement(times_s, _NO_SCAN_TIME if is_contradicted else "", f"{beams.scan_time_s:g} s")
        seen = f"time_increment {beams.increment_s:g} s of {beams.count} beams, scan_time {beams.scan_time_s:g} s"
        seen += f", period {period_s:.3g} s"
        if period_s and _fits(beams.scan_time_s, period_s, 1.0):
            self.assumed = ""
            step_s = turns * beams.scan_time_s / beams.count
            return _Judgement(beams.seconds(-step_s if beams.increment_s < 0.0 else step_s), _BY_SCAN_TIME, seen)
        return _Judgement(NO_TIMES, _REFUTED, seen)

    def _of_field(self, field: Field, returns: Returns, around: Sequence[_Sweep]) -> _Judgement:
        """Judgement of a cloud by its neighbors, its own majority and the period."""
        if not field.core > 0.0:
            return _Judgement(NO_TIMES, _ALL_SAME, f"field {field.name}")
        period_s = _period_s(around)
        stated = [each.returns.stated for each in around]
        fields = [each for each in stated if isinstance(each, Field) and each.core > 0.0]
        unit = mode(each.unit for each in fields)
        unit_s = UNITS_S[unit]
        origin, times_s = field.origin, returns.times_s
        usually = mode(each.origin for each in fields)
        is_running = (origin == STAMP or origin != usually) and _is_running(around, unit_s)
        if unit != field.unit or (origin == STAMP and is_running):
            origin = CLOCK if is_running else origin
            field = field._replace(unit=unit, origin=origin)
            times_s = field.seconds(returns.stamp_ns)
        self.assumed = str(field) if self.assumed == NONE_ASSUMED else self.assumed
        usual_s, span_s = _usual_span_s(fields, unit_s, period_s), field.span * unit_s
        self.spans_s.append(usual_s)
        self.periods_s.append(period_s)
        if usual_s > (_OVERLAP * period_s or LONGEST_SWEEP_S):
            return _Judgement(NO_TIMES, _REFUTED, f"{span_s:.3g} s, period {period_s:.3g} s")
        regular = [each for each in fields if _SHORT * usual_s <= each.span * unit_s <= _LONG * usual_s]
        begun = [each for each in regular if each.origin == origin == STAMP]
        lows_s = [unit_s * float(each.low) for each in begun]
        low_s = median_low(lows_s or [0.0])
        is_wrapped = _may_be_wrapped(field, usual_s, period_s)
        if is_wrapped or not _SHORT * usual_s <= span_s <= _LONG * usual_s:
            found = _point_by_point(times_s, field, regular, usual_s, period_s if is_wrapped else usual_s)
            if found.done == _UNWRAPPED or (found.kept is not None and origin == CLOCK):
                begin_s = np.float32(low_s) if origin != EPOCH else found.times_s[0]
                found = found._replace(times_s=found.times_s - found.times_s.min() + begin_s)
            return found
        off_s = unit_s * float(field.low) - low_s if origin == STAMP else 0.0
        agreeing = sum(abs(each_s - low_s) < _STEP * usual_s for each_s in lows_s)
        if abs(off_s) > 0.5 * usual_s and 2 * agreeing > len(around):
            is_backward = _rises(field) != _rises(begun[lows_s.index(low_s)])
            times_s = -times_s if is_backward else times_s
            seen = f"{off_s:+.3g} s{' and backward' if is_backward else ''}"
            return _Judgement(times_s - times_s.min() + np.float32(low_s), _MOVED, seen)
        is_moved = origin == CLOCK and usually == STAMP and not is_running
        return _Judgement(times_s, _MOVED if is_moved else "", f"{unit_s * float(field.low):+.3g} s")


def _step_s(before: _Sweep, after: _Sweep) -> float:
    """Seconds from one scan to the next by their stamps."""
    return 1e-9 * (after.returns.stamp_ns - before.returns.stamp_ns)


def _period_s(around: Sequence[_Sweep]) -> float:
    """Median time from scan to scan, by their stamps or, where those do not move, by log time; 0 if alone."""
    by_stamp_s = median_low([_step_s(*each) for each in pairwise(around)] or [0.0])
    if by_stamp_s > 0.0 or len(around) < 2:
        return max(by_stamp_s, 0.0)
    log_times_ns = [each.message.log_time_ns for each in around]
    return 1e-9 * median_low([after - before for before, after in pairwise(log_times_ns)])


def _fits(whole_s: float, turn_s: float, turns: float) -> bool:
    """True of the time of all beams where a lidar turns once in ``turn_s`` and they cover so much of a turn."""
    return _PART_OF_TURN * turns * turn_s <= whole_s <= _MORE_THAN_TURN * turn_s < inf


def _is_running(around: Sequence[_Sweep], unit_s: float) -> bool:
    """True where the first values grow from scan to scan like the stamps: of a clock, though it was just reset."""
    steps = [
        (unit_s * (float(after.begin) - float(before.begin)), 1e-9 * (scan.stamp_ns - last.stamp_ns))
        for (last, before), (scan, after) in pairwise((each.returns, each.returns.stated) for each in around)
        if isinstance(before, Field) and isinstance(after, Field)
    ]
    return 2 * sum(abs(by_field_s - by_stamp_s) < 0.2 * by_stamp_s for by_field_s, by_stamp_s in steps) > len(
        steps
    )


def _usual_span_s(fields: Sequence[Field], unit_s: float, period_s: float) -> float:
    """Time that sweeps take by their extremes, or by most of their points where the period refutes these."""
    span_s = unit_s * median_low([each.span if isfinite(each.span) else each.core for each in fields])
    core_s = unit_s * median_low([each.core for each in fields])
    if period_s and span_s > _OVERLAPPED * period_s:
        return min(span_s, max(period_s, core_s))
    return span_s if span_s >= _LOW_RATE * period_s > 0.0 else min(span_s, _TAILS * core_s)


def _may_be_wrapped(field: Field, usual_s: float, period_s: float) -> bool:
    """True where a counter may have wrapped or been reset within the sweep, though it spans what others do.

    Its values span all that a counter has, or they fall back once: in a sweep that ends where it began, or that is
    half as long as the period.
    """
    if any(_WRAPPED * most < field.span < most and field.low >= 0.0 for most in _COUNTERS):
        return True
    ends = [float(field.values[place] - field.low) for place in (0, -1)]
    is_turned = ends[0] > _EDGE * field.span and ends[1] < (1.0 - _EDGE) * field.span
    is_part = _LOW_RATE * _SHORT * period_s < usual_s < _SHORT * period_s
    return (is_turned or is_part) and _steps_back(field, usual_s) == 1


def _point_by_point(
    times_s: NDArray[np.float32], field: Field, regular: Sequence[Field], usual_s: float, wanted_s: float
) -> _Judgement:
    """Judgement of a sweep that lasts longer or shorter than usual by each of its times.

    regular : the sweeps around that do not; wanted_s : time that it takes where a counter wrapped in it
    """
    is_finite = np.isfinite(times_s)
    values = times_s[is_finite].astype(np.float64)
    span_s = float(np.ptp(values))
    seen = f"{span_s:.3g} s, usually {usual_s:.3g} s"
    if is_finite.all():
        back = _steps_back(field, usual_s)
        usual_back = _steps_back(regular[0], usual_s) if regular else back
        if span_s > _LONG * usual_s or wanted_s != usual_s or back > usual_back:
            for total_s in (usual_s, wanted_s):
                unwrapped = _unwrapped(values, span_s, total_s)
                if unwrapped is not None:
                    return _Judgement(unwrapped.astype(np.float32), _UNWRAPPED, seen)
        if span_s <= _LONG * usual_s:
            is_reset = 2 * back >= 3 * usual_back + 2
            return _Judgement(NO_TIMES, _REFUTED, seen) if is_reset else _Judgement(times_s)
        if span_s <= _LONGEST * usual_s and field.core * UNITS_S[field.unit] >= _FULL * span_s:
            return _Judgement(times_s)
    order, most_s = np.sort(values), _LONG * usual_s
    begin_s = order[np.argmax(np.searchsorted(order, order + most_s, "right") - np.arange(len(order)))]
    kept = (times_s >= begin_s) & (times_s <= begin_s + most_s)
    if 2 * np.count_nonzero(kept) <= len(kept):
        return _Judgement(NO_TIMES, _REFUTED, seen)
    return _Judgement(times_s[kept], _LEFT_OUT, seen, kept)


def _steps_back(field: Field, usual_s: float) -> int:
    """Number of points whose times fall far behind those of the points before them."""
    return int(np.count_nonzero(np.diff(field.values) < -_STEP * usual_s / UNITS_S[field.unit]))


def _rises(field: Field) -> bool:
    """True if most points follow those before them in time."""
    return float(np.sign(np.diff(field.values)).sum()) > 0.0


def _unwrapped(times_s: NDArray[np.float64], span_s: float, total_s: float) -> NDArray[np.float64] | None:
    """Times that go on where a counter fell back, None where they do not take about ``total_s`` then.

    Either each step back from point to point is one, or the sorted times have one gap, with the first point before
    it and the last one behind it, or the other way round.
    """
    steps = np.diff(times_s)
    is_back = steps < -_STEP * total_s
    raised = times_s.copy()
    raised[1:] -= np.cumsum(np.where(is_back, steps, 0.0))
    if is_back.any() and abs(np.ptp(raised) - total_s) <= (1.0 - _SHORT) * total_s:
        return raised
    if span_s <= _LONG * total_s:
        return None
    order = np.sort(times_s)
    gaps = np.diff(order)
    last = int(np.argmax(gaps))
    is_low, gap_s = times_s <= order[last], gaps[last]
    is_split = is_low[0] != is_low[-1] and min(last + 1, len(order) - last - 1) > _FEW * len(order)
    if not is_split or abs(span_s - gap_s - total_s) > (1.0 - _SHORT) * total_s:
        return None
    return times_s - np.where(is_low, 0.0, gap_s) if is_low[0] else times_s + np.where(is_low, span_s, 0.0)
