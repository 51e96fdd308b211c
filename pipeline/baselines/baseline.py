"""What every baseline is: scans in, poses out."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Pose, RawPoints


class Baseline(Protocol):
    """An odometry made by others, fed with the scans that ours is fed with."""

    @property
    def description(self) -> str:
        """What it does and with which parameters, for a table's footnote."""
        ...

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """T_odom_lidar (4, 4) at the scan's stamp; the first is the identity.

        points : (N, 3) meters, lidar frame; times_s : (N,) seconds relative to the stamp, (0,) where unknown
        """
        ...


def finite(points: RawPoints, times_s: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points without NaN and inf as float64, and the times of those that stay.

    Times that say nothing, because all are equal, are left out: KISS-ICP divides by their span.
    """
    times = times_s.astype(np.float64) if len(times_s) == len(points) else np.empty(0)
    if not (np.isfinite(points).all() and np.isfinite(times).all()):
        good = np.isfinite(points).all(axis=1)
        if len(times):
            good &= np.isfinite(times)
            times = times[good]
        points = points[good]
    unequal = len(times) > 0 and times.min() < times.max()
    return np.ascontiguousarray(points, dtype=np.float64), times if unequal else np.empty(0)


def middle(times_s: NDArray[np.float64]) -> float:
    """Seconds from the stamp to the middle of the sweep, where a distorted scan's pose holds; 0 if unknown."""
    return 0.5 * float(times_s.min() + times_s.max()) if len(times_s) else 0.0
