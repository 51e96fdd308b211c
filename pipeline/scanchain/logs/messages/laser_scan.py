"""sensor_msgs/LaserScan to points in the plane."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Pose
from scanchain.logs.messages.returns import NEAREST_M, NO_TIMES, RangeLimits, Returns, moved, why_none
from scanchain.logs.messages.ros import MalformedMessageError, stamp_ns

_MOST_GEOMETRIES = 16
_MOST_TURNS = 2.0  # largest number of turns that the beams of a scan cover; in degrees they seem to cover more
_FARTHEST_M = float(np.finfo(np.float32).max)


class LaserScanMessage(NamedTuple):
    """A sensor_msgs/LaserScan as it is: radians, seconds, meters; intensities are passed over.

    ``T_frame_scan`` (4, 4) is where the scan lies in its frame, None where that is its origin.
    """

    stamp_ns: int
    frame: str
    first_rad: float
    step_rad: float
    beam_s: float
    range_min_m: float
    range_max_m: float
    ranges_m: NDArray[np.float32]
    T_frame_scan: Pose | None = None


def read_laser_scan(message: Any) -> LaserScanMessage:
    """A sensor_msgs/LaserScan."""
    return LaserScanMessage(
        stamp_ns=stamp_ns(message),
        frame=message.header.frame_id,
        first_rad=message.angle_min,
        step_rad=message.angle_increment,
        beam_s=message.time_increment,
        range_min_m=message.range_min,
        range_max_m=message.range_max,
        ranges_m=message.ranges,
    )


def read_multi_echo_scan(message: Any) -> LaserScanMessage:
    """A sensor_msgs/MultiEchoLaserScan as the scan of each beam's first echo, inf where there is none."""
    firsts_m = [beam.echoes[0] if len(beam.echoes) else np.inf for beam in message.ranges]
    return read_laser_scan(message)._replace(ranges_m=np.array(firsts_m, np.float32))


ReadLaserScan = Callable[[memoryview], LaserScanMessage]


class Geometry(NamedTuple):
    """Directions (N, 2) of the beams and their times (N,) after the stamp, (0,) where they are simultaneous."""

    directions: NDArray[np.float32]
    times_s: NDArray[np.float32]


class LaserScanDecoder:
    """Decodes scans; directions are computed once for each geometry."""

    def __init__(self, limits: RangeLimits, read: ReadLaserScan) -> None:
        self.limits = limits
        self.read = read

    def decode(self, data: memoryview) -> Returns:
        """Points of the beams that came back: finite, at least range_min, below range_max.

        Scanners write range_max, or more, for a beam without return, and zero for an invalid one; limits that are
        not positive are taken as unknown. Negative angle increments are as good as positive ones.
        """
        message = self.read(data)
        ranges_m = message.ranges_m
        low_m = max(message.range_min_m if message.range_min_m > 0.0 else 0.0, self.limits.min_m, NEAREST_M)
        high_m = min(
            message.range_max_m if message.range_max_m > 0.0 else _FARTHEST_M, self.limits.max_m, _FARTHEST_M
        )
        geometry = _geometry(message.first_rad, message.step_rad, message.beam_s, len(ranges_m))
        valid = ((ranges_m >= low_m) & (ranges_m < high_m)).nonzero()[0]
        if len(valid) == len(ranges_m):
            points = geometry.directions * ranges_m[:, None]
            times_s = geometry.times_s
        else:
            points = geometry.directions[valid] * ranges_m[valid, None]
            times_s = geometry.times_s[valid] if len(geometry.times_s) else NO_TIMES
        points = moved(points, message.T_frame_scan).astype(np.float32, copy=False)
        why = "" if len(valid) else why_none(ranges_m, low_m, high_m)
        return Returns(message.stamp_ns, points, times_s, len(ranges_m) - len(valid), why)


@lru_cache(_MOST_GEOMETRIES)
def _geometry(first_rad: float, step_rad: float, beam_s: float, count: int) -> Geometry:
    if not (isfinite(first_rad + step_rad * count) and abs(beam_s) * count < _FARTHEST_M):
        raise MalformedMessageError(
            f"its beams lie {step_rad:g} rad and {beam_s:g} s apart from {first_rad:g} rad on, which cannot be"
        )
    turns = abs(step_rad) * count / (2.0 * np.pi)
    if turns > _MOST_TURNS:
        raise MalformedMessageError(
            f"its {count} beams, {step_rad:g} rad apart, cover {turns:.3g} turns: degrees? wanted radians"
        )
    angles_rad = first_rad + step_rad * np.arange(count)
    directions = np.column_stack([np.cos(angles_rad), np.sin(angles_rad)]).astype(np.float32)
    times_s = (beam_s * np.arange(count)).astype(np.float32) if beam_s else NO_TIMES
    times_s.flags.writeable = False
    return Geometry(directions, times_s)
