"""Valid returns of a scan message, and the range limits within which a return is valid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Pose, RawPoints


class RangeLimits(NamedTuple):
    """Meters; what lies outside is dropped at the reader and counted."""

    min_m: float
    max_m: float


class Returns(NamedTuple):
    """The valid returns of one scan message.

    ``points`` (N, d) float32 meters, ``times_s`` (N,) float32 seconds after ``stamp_ns`` or (0,); ``dropped``
    counts what was left out, ``why`` is the reason where nothing is left.
    """

    stamp_ns: int
    points: RawPoints
    times_s: NDArray[np.float32]
    dropped: int
    why: str


NO_TIMES = np.empty(0, np.float32)
NO_TIMES.flags.writeable = False


def moved(points: RawPoints, T_frame_cloud: Pose | None) -> RawPoints:
    """Points (N, d) moved by the pose of their frame; None stands for its origin."""
    if T_frame_cloud is None:
        return points
    d = points.shape[1]
    return (points @ T_frame_cloud[:d, :d].T + T_frame_cloud[:d, 3]).astype(np.float32)
