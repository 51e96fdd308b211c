"""How near and how far a return may be to be taken from the log, and what is left of a message then."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Pose, RawPoints


class RangeLimits(NamedTuple):
    """Metres; what lies outside is dropped at the reader and counted."""

    min_m: float
    max_m: float


class Returns(NamedTuple):
    """The valid returns of one scan message.

    ``points`` (N, d) float32 metres, ``times_s`` (N,) float32 seconds after ``stamp_ns`` or (0,); ``dropped``
    counts what was left out, ``why`` says for what where nothing is left.
    """

    stamp_ns: int
    points: RawPoints
    times_s: NDArray[np.float32]
    dropped: int
    why: str


NO_TIMES = np.empty(0, np.float32)
NO_TIMES.flags.writeable = False


def moved(points: RawPoints, T_frame_cloud: Pose | None) -> RawPoints:
    """Points (N, d) in the frame in which they were told to lie; None stands for its origin."""
    if T_frame_cloud is None:
        return points
    d = points.shape[1]
    return (points @ T_frame_cloud[:d, :d].T + T_frame_cloud[:d, 3]).astype(np.float32)
