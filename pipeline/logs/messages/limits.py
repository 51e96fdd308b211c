"""How near and how far a return may be to be taken from the log, and what is left of a message then."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.config import PreprocessConfig
from scanchain.data import Pose, RawPoints
from scanchain.words import counted


class RangeLimits(NamedTuple):
    """Meters; what lies outside is dropped at the reader and counted."""

    min_m: float
    max_m: float


class Returns(NamedTuple):
    """The valid returns of one scan message.

    ``points`` (N, d) float32 meters, ``times_s`` (N,) float32 seconds after ``stamp_ns`` or (0,); ``dropped``
    counts what was left out, ``why`` says for what where nothing is left.
    """

    stamp_ns: int
    points: RawPoints
    times_s: NDArray[np.float32]
    dropped: int
    why: str


_SAMPLE = 64  # every so-many-th point is looked at first: as a rule one of them is in range
NO_TIMES = np.empty(0, np.float32)
NO_TIMES.flags.writeable = False


def moved(points: RawPoints, T_frame_cloud: Pose | None) -> RawPoints:
    """Points (N, d) in the frame in which they were told to lie; None stands for its origin."""
    if T_frame_cloud is None:
        return points
    d = points.shape[1]
    return (points @ T_frame_cloud[:d, :d].T + T_frame_cloud[:d, 3]).astype(np.float32)


def none_retained(points: RawPoints, config: PreprocessConfig) -> str:
    """What is wrong with points (N, d) of which preprocessing retains none; empty where it retains one."""
    low_m, high_m = config.min_range_m, config.max_range_m
    squares = np.empty(0)
    for part in (points[::_SAMPLE], points):
        squares = np.einsum("ij,ij->i", part, part, dtype=np.float64)
        if ((low_m * low_m <= squares) & (squares <= high_m * high_m)).any():
            return ""
    near_m, far_m = np.sqrt([squares.min(), squares.max()])
    limits = f"preprocess.min_range_m ({low_m:g}) and preprocess.max_range_m ({high_m:g})"
    seen = f"its {counted(len(points), 'point')} lie at {near_m:.3g} to {far_m:.3g} m"
    return f"no point between {limits} ({seen}: widen these limits)"
