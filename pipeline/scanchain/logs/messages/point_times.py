"""Times of the points of a scan, whatever a driver's name and unit for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.config import LogConfig
from scanchain.data import RawPoints

NO_TIMES = np.empty(0, np.float32)
NO_TIMES.flags.writeable = False
_NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "timeOffset", "time_stamp")

UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NO, _AT_ONCE = "no point times", "every scan counts as measured at once"
_SHORTEST_SCAN_NS = 500_000  # span of a scan's whole numbers, below which they are micro- or milliseconds
_LONGEST_SCAN = 1e4  # span in milliseconds, above which floats are micro- or nanoseconds
_NEAR_S = 1.0  # largest time between the stamp of a scan and its beginning
_ABSOLUTE_S = 3600.0  # least absolute time in seconds


class PointTimes:
    """Seconds after the stamp for the points of scans, in any order and from any thread.

    The unit is that of ``log.point_times`` or, where that is ``auto``, the one that a scan's values suggest.
    ``fields`` names those that hold times, the likeliest first; ``assumed`` describes the interpretation of one of
    the first scans that have times.
    """

    def __init__(self, config: LogConfig) -> None:
        self.config = config
        self.unit = config.point_times if config.point_times in UNITS_S else ""
        self.by_azimuth = config.point_times in ("clockwise", "counterclockwise")
        self.fields = () if self.by_azimuth or config.point_times == "none" else _NAMES
        self.assumed = f"{_NO}: {_AT_ONCE}"

    def from_azimuth(self, points: RawPoints) -> NDArray[np.float32]:
        """Times (N,) of points (N, 3) by the lidar's turn since its start, which is at the stamp."""
        config = self.config
        sense = -1.0 if config.point_times == "clockwise" else 1.0
        turned = sense * (np.arctan2(points[:, 1], points[:, 0]) - config.revolution_start_rad)
        direction = (
            f"{config.point_times} from {config.revolution_start_rad:.3g} rad, {config.revolution_s:g} s a turn"
        )
        self.assumed = f"point times by the azimuth: {direction} (log.point_times)"
        return (turned % (2.0 * np.pi) * (config.revolution_s / (2.0 * np.pi))).astype(np.float32)

    def from_field(self, name: str, stamp_ns: int, values: NDArray[np.generic]) -> NDArray[np.float32]:
        """Times (N,) of raw values (N,); (0,) where not finite or all the same.

        Whole numbers are nanoseconds, or the next unit, micro- or milliseconds, in which the whole scan is not
        shorter than half a millisecond. Floats are seconds where they span up to 10, else milli-, micro- or
        nanoseconds by their span. Values within a second of the stamp are absolute, others count from it; those of
        another clock, the sensor's own or one that is off by the leap seconds, count from the first point.
        """
        if not len(values):
            return NO_TIMES
        is_whole, kind = values.dtype.kind in "iu", values.dtype.name
        values = values.astype(np.int64 if is_whole else np.float64)
        first, last = values.min(), values.max()  # NaN where one of the values is
        if not np.isfinite([first, last]).all():
            return NO_TIMES
        span = float(last - first)
        if span == 0.0:  # as where a float32 holds an absolute time
            if len(values) > 1 and self.assumed.startswith(_NO):
                self.assumed = f"{_NO}: field {name} ({kind}) is there and constant ({first:.10g}); {_AT_ONCE}"
            return NO_TIMES
        unit = self.unit or _likely_unit(span, is_whole=is_whole)
        unit_s = UNITS_S[unit]
        per_second = round(1.0 / unit_s)
        stamp = stamp_ns * per_second // 1_000_000_000 if is_whole else stamp_ns * 1e-9 * per_second
        origin = "after the stamp"
        if abs(float(first) - float(stamp)) * unit_s < _NEAR_S and float(first) * unit_s > _ABSOLUTE_S:
            values -= stamp
            origin = "since the epoch"
        elif abs(float(first)) * unit_s > _NEAR_S:
            values -= first
            origin = "of another clock, counted from the first point"
        if self.assumed.startswith(_NO):
            taken = f"field {name} ({kind}) taken as {unit} {origin}"
            self.assumed = f"point times: {taken} (log.point_times)"
        times_s = np.empty(len(values), np.float32)
        return np.multiply(values, unit_s, out=times_s, dtype=np.float64, casting="unsafe")


def _likely_unit(span: float, *, is_whole: bool) -> str:
    if is_whole:
        return "ns" if span >= _SHORTEST_SCAN_NS else "us" if 1e3 * span >= _SHORTEST_SCAN_NS else "ms"
    if span <= 10.0:
        return "s"
    if span <= _LONGEST_SCAN:
        return "ms"
    return "us" if span <= 1e3 * _LONGEST_SCAN else "ns"
