"""A 2D scan for a method that is made for 3D clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.baselines.baseline import Baseline
from scanchain.data import Pose, RawPoints

_LEVELS, _STEP_M = 5, 0.1  # of a scan that is given height


class InPlane:
    """Feeds a 3D baseline with planar scans and brings its poses back into the plane.

    Points lie at z = 0 or, where the method looks for surfaces, stand on top of each other: walls, whose normals
    are horizontal. All levels are alike, so that nothing is said about the height.
    """

    def __init__(self, baseline: Baseline, *, is_raised: bool) -> None:
        self.baseline = baseline
        self.heights_m = _STEP_M * (np.arange(_LEVELS) - _LEVELS // 2) if is_raised else np.zeros(1)

    @property
    def description(self) -> str:
        """What it does, and how the scans were made fit for it."""
        levels = len(self.heights_m)
        how = f"{levels} copies {_STEP_M:g} m above each other" if levels > 1 else "at z = 0"
        return f"{self.baseline.description}; 2D scans {how}"

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """T_odom_lidar (3, 3) of points (N, 2)."""
        levels = len(self.heights_m)
        raised = np.empty((levels * len(points), 3), np.float32)
        raised[:, :2] = np.tile(points, (levels, 1))
        raised[:, 2] = np.repeat(self.heights_m, len(points))
        return lie.flatten(self.baseline.track(raised, np.tile(times_s, levels), stamp_ns))
