"""Times of the points of a scan as its message states them, whatever a driver's name and unit for them."""

from __future__ import annotations

from math import isfinite, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.config import LogConfig
from scanchain.data import RawPoints

NO_TIMES = np.empty(0, np.float32)
NO_TIMES.flags.writeable = False
_NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "timeOffset", "time_stamp")

UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
NONE_ASSUMED = "no point times: every scan counts as measured at once"
STAMP, EPOCH, CLOCK = "after the stamp", "since the epoch", "of another clock, counted from the first point"
_SHORTEST_SCAN_NS = 500_000  # span of a scan's whole numbers, below which they are micro- or milliseconds
_LONGEST_SCAN = 1e4  # span in milliseconds, above which floats are micro- or nanoseconds
_NEAR_S = 1.0  # largest time between the stamp of a scan and its beginning
_ABSOLUTE_S = 3600.0  # least absolute time in seconds
_TAIL = 0.15  # share of a scan's times at either end that do not count for its core
_SAMPLE = np.sort(np.random.default_rng(0).random(512))  # places, 0 to 1, of the times whose quantiles are taken


class Field(NamedTuple):
    """Times of the points of a cloud.

    values : (N,) int64 or float64, as in the message; kind : their type there
    low : the least, but for what lies farther below the others than these spread
    span : from the least to the greatest, NaN where one is not finite
    begin : the least after a tail; core : the span without both tails, as if they were as dense
    unit, origin : as the message alone suggests them
    """

    name: str
    kind: str
    values: NDArray[np.int64 | np.float64]
    low: float
    span: float
    begin: float
    core: float
    unit: str = ""
    origin: str = ""

    def seconds(self, stamp_ns: int) -> NDArray[np.float32]:
        """Times (N,) after the stamp by unit and origin."""
        unit_s, zero = UNITS_S[self.unit], self.low if self.origin == CLOCK else 0
        if self.origin == EPOCH:
            zero = _in_units(stamp_ns, unit_s, is_whole=self.values.dtype.kind == "i")
        values = self.values - zero if zero else self.values
        times_s = np.empty(len(values), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.multiply(values, unit_s, out=times_s, dtype=np.float64, casting="unsafe")

    def __str__(self) -> str:
        return f"point times: field {self.name} ({self.kind}) taken as {self.unit} {self.origin} (log.point_times)"


class Beams(NamedTuple):
    """Times of a laser scan: of its beams ``numbers`` (N,) came back, of so many, which cover so many turns."""

    numbers: NDArray[np.intp]
    count: int
    turns: float
    increment_s: float
    scan_time_s: float

    def seconds(self, increment_s: float) -> NDArray[np.float32]:
        """Times (N,) after the stamp; (0,) where the beams are simultaneous."""
        with np.errstate(over="ignore", invalid="ignore"):
            return (increment_s * self.numbers).astype(np.float32) if increment_s else NO_TIMES


class PointTimes:
    """Seconds after the stamp for the points of scans, in any order and from any thread, by each message alone.

    The unit is that of ``log.point_times`` or, where that is ``auto``, the one that a scan's values suggest.
    ``fields`` names those that hold times, the likeliest first; ``assumed`` describes the interpretation of one of
    the first scans that have times.
    """

    def __init__(self, config: LogConfig) -> None:
        self.config = config
        self.unit = config.point_times if config.point_times in UNITS_S else ""
        self.by_azimuth = config.point_times in ("clockwise", "counterclockwise")
        self.fields = () if self.by_azimuth or config.point_times == "none" else _NAMES
        self.assumed = NONE_ASSUMED
        if self.by_azimuth:
            turn = f"{config.revolution_start_rad:.3g} rad, {config.revolution_s:g} s a turn"
            self.assumed = f"point times by the azimuth: {config.point_times} from {turn} (log.point_times)"

    def from_field(self, name: str, stamp_ns: int, values: NDArray[np.generic]) -> Field:
        """Raw values (N,), N > 0, with the unit and the origin that they suggest; most of them decide.

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
            span = nan
            sample, first = sample[np.isfinite(sample)], values.min(where=np.isfinite(values), initial=np.inf)
        tail = round(_TAIL * len(sample))
        begin, end = (sample[tail], sample[-1 - tail]) if len(sample) else (first, first)
        core = (float(end) - float(begin)) / (1.0 - 2.0 * _TAIL)
        core = span if core > span else core  # of few points
        low = first if first >= begin - core else values[values >= begin - core].min()
        unit = self.unit or _likely_unit(core, is_whole=is_whole)
        unit_s, origin, begin_s = UNITS_S[unit], STAMP, float(begin) * UNITS_S[unit]
        after_s = (float(begin) - float(_in_units(stamp_ns, unit_s, is_whole=is_whole))) * unit_s
        if abs(after_s) < _NEAR_S and begin_s > _ABSOLUTE_S:
            origin = EPOCH
        elif abs(begin_s) > _NEAR_S:
            origin = CLOCK
        field = Field(name, kind, values, low, span, begin, core, unit, origin)
        if self.assumed == NONE_ASSUMED and core > 0.0:
            self.assumed = str(field)
        return field


def from_azimuth(points: RawPoints, config: LogConfig) -> NDArray[np.float32]:
    """Times (N,) of points (N, d) by the lidar's turn since its start, which is at the stamp."""
    sense = -1.0 if config.point_times == "clockwise" else 1.0
    turned = sense * (np.arctan2(points[:, 1], points[:, 0]) - config.revolution_start_rad)
    return (turned % (2.0 * np.pi) * (config.revolution_s / (2.0 * np.pi))).astype(np.float32)


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
