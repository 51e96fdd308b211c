"""sensor_msgs/LaserScan to points in the plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data import RawPoints
from pipeline.logs.cdr import CdrReader
from pipeline.logs.limits import RangeLimits


@dataclass(frozen=True, slots=True)
class Returns:
    """The valid returns of one scan message.

    ``points`` (N, d) float32 metres, ``times_s`` (N,) float32 seconds after ``stamp_ns`` or (0,); ``dropped``
    counts what was left out, ``why`` says for what.
    """

    stamp_ns: int
    frame: str
    points: RawPoints
    times_s: NDArray[np.float32]
    dropped: int
    why: str


class LaserScanDecoder:
    """Decodes the scans of one channel; directions are computed once for each geometry."""

    dimension = 2

    def __init__(self, limits: RangeLimits) -> None:
        self.limits = limits
        self.geometry: tuple[float, float, int] = (0.0, 0.0, -1)
        self.directions = np.empty((0, 2), np.float32)

    def decode(self, data: memoryview) -> Returns:
        """Points of the beams that came back: finite, above range_min, below range_max.

        Scanners write range_max, or more, for a beam without return, and zero for an invalid one; a range_max of
        zero is taken as unknown. Negative angle increments are as good as positive ones.
        """
        reader = CdrReader(data)
        stamp_ns, frame = reader.header()
        first_rad, _, step_rad, beam_s, _, range_min_m, range_max_m = reader.numbers("f", 7)
        ranges_m = reader.array("f4")
        count = len(ranges_m)
        if self.geometry != (first_rad, step_rad, count):
            angles = first_rad + step_rad * np.arange(count)
            self.directions = np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
            self.geometry = (first_rad, step_rad, count)
        low_m = max(range_min_m, self.limits.min_m)
        high_m = min(range_max_m if range_max_m > 0.0 else np.inf, self.limits.max_m)
        valid = np.flatnonzero((ranges_m > low_m) & (ranges_m < high_m))
        points = self.directions[valid] * ranges_m[valid, None].astype(np.float32)
        times_s = (valid * beam_s).astype(np.float32) if beam_s else np.empty(0, np.float32)
        why = f"{count} beams, none between {low_m:g} and {high_m:g} m" if not len(valid) else ""
        return Returns(stamp_ns, frame, points, times_s, count - len(valid), why)
