"""Per-point times, whatever a driver calls them and counts them in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "timeOffset", "time_stamp")

_LONGEST_SCAN_S = 10.0


def seconds_after(stamp_ns: int, values: NDArray[np.generic]) -> NDArray[np.float32]:
    """Seconds (N,) float32 after the scan's stamp of raw time values (N,).

    Whole numbers are nanoseconds (microseconds, where that makes the scan shorter than 0.1 ms). Floats are seconds,
    or nanoseconds where they span more than ten. Values near the stamp itself are absolute, others count from it.
    """
    if not len(values):
        return np.empty(0, np.float32)
    whole = values.dtype.kind in "iu"
    raw = values.astype(np.int64) if whole else values.astype(np.float64)
    span = float(raw.max() - raw.min())
    if whole:
        unit_s = 1e-6 if 0.0 < span * 1e-9 < 1e-4 else 1e-9
    else:
        unit_s = 1e-9 if span > _LONGEST_SCAN_S else 1.0
    per_second = round(1.0 / unit_s)
    offset = stamp_ns * per_second // 1_000_000_000 if whole else stamp_ns * 1e-9 / unit_s
    absolute = abs(float(raw[0]) - float(offset)) * unit_s < 3600.0 and float(raw[0]) * unit_s > 3600.0 * 24
    return ((raw - offset if absolute else raw) * unit_s).astype(np.float32)
