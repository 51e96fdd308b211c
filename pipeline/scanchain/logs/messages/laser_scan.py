"""sensor_msgs/LaserScan to points in the plane."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanchain.config import LogConfig
from scanchain.logs.messages.returns import NEAREST_M, NO_TIMES, Returns, Sensed, moved, why_none
from scanchain.logs.messages.ros import MalformedMessageError, stamp_ns

_MOST_GEOMETRIES = 16
_MOST_TURNS = 2.0  # largest number of turns that the beams of a scan cover; in degrees they seem to cover more
_FARTHEST_M = float(np.finfo(np.float32).max)


def read_multi_echo_scan(message: Any) -> Sensed:
    """A sensor_msgs/MultiEchoLaserScan as the scan of each beam's first echo, inf where there is none."""
    firsts_m = [beam.echoes[0] if len(beam.echoes) else np.inf for beam in message.ranges]
    message.ranges = np.array(firsts_m, np.float32)
    return Sensed(message)


def decode_laser_scan(data: memoryview, read: Callable[[memoryview], Sensed], config: LogConfig) -> Returns:
    """Points of the beams that came back: finite, at least range_min, below range_max.

    Scanners write range_max, or more, for a beam without return, and zero for an invalid one; limits that are
    not positive are taken as unknown. Negative angle increments are as good as positive ones.
    """
    message, T_frame_points = read(data)
    ranges_m = message.ranges
    low_m = max(message.range_min if message.range_min > 0.0 else 0.0, config.min_range_m, NEAREST_M)
    high_m = min(message.range_max if message.range_max > 0.0 else _FARTHEST_M, config.max_range_m, _FARTHEST_M)
    angles_rad = message.angle_min, message.angle_increment
    directions, times_s = _beams(*angles_rad, message.time_increment, len(ranges_m))
    valid = ((ranges_m >= low_m) & (ranges_m < high_m)).nonzero()[0]
    if len(valid) == len(ranges_m):
        points = directions * ranges_m[:, None]
    else:
        points = directions[valid] * ranges_m[valid, None]
        times_s = times_s[valid] if len(times_s) else NO_TIMES
    points = moved(points, T_frame_points).astype(np.float32, copy=False)
    why = "" if len(valid) else why_none(ranges_m, low_m, high_m)
    return Returns(stamp_ns(message), points, times_s, len(ranges_m) - len(valid), why)


@lru_cache(_MOST_GEOMETRIES)
def _beams(
    first_rad: float, step_rad: float, beam_s: float, count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Directions (N, 2) of the beams and their times (N,) after the stamp, (0,) where they are simultaneous."""
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
    return directions, times_s
