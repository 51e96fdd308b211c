"""The protocol of a baseline, and adapters to it: finite points, poses at the stamp, scans in the plane."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Pose, RawPoints


class Baseline(Protocol):
    """An odometry by others, run on the same scans as ours.

    Any class with ``track`` can be compared; without a ``description`` it goes by its name.
    """

    @property
    def description(self) -> str:
        """Method and parameters, for the footnote of a table."""
        ...

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """T_odom_lidar (4, 4) at the scan's stamp; the first is the identity.

        points : (N, 3) meters, lidar frame; times_s : (N,) seconds relative to the stamp, (0,) where unknown
        """
        ...


def finite(points: RawPoints, times_s: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points without NaN and inf as float64, and the times of those that stay.

    Times that are all equal are dropped: KISS-ICP divides by their span.
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


class AtStamp:
    """Moves each pose back to its scan's stamp, at the velocity since the pose before.

    A baseline calls the pose of its first scan the identity, at whatever instant that holds; here it is the
    first stamp's. Where that lies is known from the second scan on, when there is a velocity.
    """

    def __init__(self) -> None:
        self.T_odom_theirs: Pose | None = None
        self.T_theirs_last: Pose | None = None
        self.last_stamp_ns, self.last_held_s = 0, 0.0

    def move(self, T_theirs_held: Pose, stamp_ns: int, held_s: float) -> Pose:
        """T_odom_lidar at the stamp, of a pose in the baseline's own frame that is valid ``held_s`` after it."""
        T_theirs_last, self.T_theirs_last = self.T_theirs_last, T_theirs_held
        interval_s = (stamp_ns - self.last_stamp_ns) * 1e-9 + held_s - self.last_held_s
        last_held_s = self.last_held_s
        self.last_stamp_ns, self.last_held_s = stamp_ns, held_s
        if T_theirs_last is None:
            return np.eye(4)
        motion = lie.log(lie.between(T_theirs_last, T_theirs_held))
        velocity = motion / interval_s if interval_s > 0.0 else np.zeros(6)
        if self.T_odom_theirs is None:
            self.T_odom_theirs = lie.inverse(T_theirs_last @ lie.exp(-last_held_s * velocity))
        return self.T_odom_theirs @ T_theirs_held @ lie.exp(-held_s * velocity)


_LEVELS, _STEP_M = 5, 0.1  # of a scan that is given height


class InPlane:
    """Feeds a 3D baseline with planar scans and brings its poses back into the plane.

    Points lie at z = 0 or, where the method looks for surfaces, stand on top of each other: walls, whose normals
    are horizontal. All levels are alike, so that the height is unobservable.
    """

    def __init__(self, baseline: Baseline, *, is_raised: bool) -> None:
        self.baseline = baseline
        self.heights_m = _STEP_M * (np.arange(_LEVELS) - _LEVELS // 2) if is_raised else np.zeros(1)
        how = f"{_LEVELS} copies {_STEP_M:g} m above each other" if is_raised else "at z = 0"
        self.description = f"{baseline.description}; 2D scans {how}"

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """T_odom_lidar (3, 3) of points (N, 2)."""
        levels = len(self.heights_m)
        raised = np.empty((levels * len(points), 3), np.float32)
        raised[:, :2] = np.tile(points, (levels, 1))
        raised[:, 2] = np.repeat(self.heights_m, len(points))
        return lie.flatten(self.baseline.track(raised, np.tile(times_s, levels), stamp_ns))
