"""Per-point times, whatever a driver calls them and counts them in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.logs.limits import NO_TIMES

NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "timeOffset", "time_stamp")

_SHORTEST_SCAN_NS = 500_000  # whole numbers that span less are microseconds
_LONGEST_SCAN = 1e4  # in milliseconds; floats that span more are micro- or nanoseconds
_NEAR_S = 3600.0  # absolute times differ from the stamp by less
_FIRST_AFTER_S = 1.0  # no scan begins later after its stamp than this


def seconds_after(stamp_ns: int, values: NDArray[np.generic]) -> NDArray[np.float32]:
    """Seconds (N,) float32 after the scan's stamp of raw time values (N,); (0,) where they are not finite.

    Whole numbers are nanoseconds, or microseconds where that would make the whole scan shorter than half a
    millisecond. Floats are seconds where they span up to 10, else milli-, micro- or nanoseconds by their span.
    Values near the stamp are absolute, others count from it; those of a clock of the sensor's own, far from
    either, count from the first point.
    """
    if not len(values):
        return NO_TIMES
    is_whole = values.dtype.kind in "iu"
    raw = values.astype(np.int64) if is_whole else values.astype(np.float64)
    if not np.isfinite(raw).all():
        return NO_TIMES
    first = raw.min()
    unit_s = _unit_s(float(raw.max() - first), is_whole=is_whole)
    per_second = round(1.0 / unit_s)
    stamp = stamp_ns * per_second // 1_000_000_000 if is_whole else stamp_ns * 1e-9 * per_second
    if abs(float(first) - float(stamp)) * unit_s < _NEAR_S < float(first) * unit_s:
        raw = raw - stamp
    elif abs(float(first)) * unit_s > _FIRST_AFTER_S:
        raw = raw - first
    return (raw * unit_s).astype(np.float32)


def _unit_s(span: float, *, is_whole: bool) -> float:
    if is_whole:
        return 1e-6 if 0.0 < span < _SHORTEST_SCAN_NS else 1e-9
    if span <= 10.0:
        return 1.0
    if span <= _LONGEST_SCAN:
        return 1e-3
    return 1e-6 if span <= 1e3 * _LONGEST_SCAN else 1e-9
