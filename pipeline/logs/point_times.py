"""Per-point times, whatever a driver calls them and counts them in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.logs.limits import NO_TIMES

NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "timeOffset", "time_stamp")

_SHORTEST_SCAN_NS = 500_000  # whole numbers that span less are microseconds
_LONGEST_SCAN = 1e4  # in milliseconds; floats that span more are micro- or nanoseconds
_NEAR_S = 1.0  # no scan begins further from its stamp than this
_ABSOLUTE_S = 3600.0  # absolute times are beyond


def seconds_after(stamp_ns: int, values: NDArray[np.generic]) -> NDArray[np.float32]:
    """Seconds (N,) float32 after the scan's stamp of raw values (N,); (0,) where not finite or all the same.

    Whole numbers are nanoseconds, or microseconds where that would make the whole scan shorter than half a
    millisecond. Floats are seconds where they span up to 10, else milli-, micro- or nanoseconds by their span.
    Values within a second of the stamp are absolute, others count from it; those of another clock, the sensor's
    own or one that is off by the leap seconds, count from the first point.
    """
    if not len(values):
        return NO_TIMES
    is_whole = values.dtype.kind in "iu"
    raw = values.astype(np.int64) if is_whole else values.astype(np.float64)
    if not np.isfinite(raw).all():
        return NO_TIMES
    first = raw.min()
    span = float(raw.max() - first)
    if span == 0.0:  # as where a float32 holds an absolute time
        return NO_TIMES
    unit_s = _unit_s(span, is_whole=is_whole)
    per_second = round(1.0 / unit_s)
    stamp = stamp_ns * per_second // 1_000_000_000 if is_whole else stamp_ns * 1e-9 * per_second
    if abs(float(first) - float(stamp)) * unit_s < _NEAR_S and float(first) * unit_s > _ABSOLUTE_S:
        raw = raw - stamp
    elif abs(float(first)) * unit_s > _NEAR_S:
        raw = raw - first
    return (raw * unit_s).astype(np.float32)


def _unit_s(span: float, *, is_whole: bool) -> float:
    if is_whole:
        return 1e-6 if span < _SHORTEST_SCAN_NS else 1e-9
    if span <= 10.0:
        return 1.0
    if span <= _LONGEST_SCAN:
        return 1e-3
    return 1e-6 if span <= 1e3 * _LONGEST_SCAN else 1e-9
