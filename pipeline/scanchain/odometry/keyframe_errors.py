"""Errors that poses share with the map they are aligned to: what the residuals of a scan alone do not show."""

from __future__ import annotations

import numpy as np

from scanchain import lie
from scanchain.data import LEAST_FIT, KeyframeErrors, Pose, State
from scanchain.odometry.tracked import Tracked

_LATEST = 0.1  # weight of the last scan in the mean of the systematic errors


class KeyframeErrorTracker:
    """Mean systematic error of the scans, and what the map was renewed by since the last keyframe."""

    def __init__(self, freedom: int) -> None:
        self.systematic = np.zeros((freedom, freedom))
        self.scans = 0  # that the mean is of
        self.is_open = False  # since the last keyframe: poses that no correspondences determined

    def take(self, tracked: Tracked) -> None:
        """Take a scan. Of those whose pose is open or contradicted the sectors say nothing."""
        match = tracked.match
        if match.observability < 1.0 or tracked.state is State.LOST:
            self.is_open = True
        elif match.fit >= LEAST_FIT and match.systematic.size:
            self.scans += 1
            self.systematic = self.systematic + max(_LATEST, 1.0 / self.scans) * (
                match.systematic - self.systematic
            )

    def at_keyframe(self, tracked: Tracked, T_odom_keyframe: Pose) -> KeyframeErrors:
        """Errors at a new keyframe after that of another pose.

        A map as wide as the scans is renewed by the distance over their root mean square range, and, where they do
        not look around, by turning.
        """
        distance_m, angle_rad = lie.apart(T_odom_keyframe, tracked.T_odom_lidar)
        points = tracked.matched
        range_m = float(np.sqrt(np.einsum("ij,ij->", points, points) / max(len(points), 1)))
        renewal = distance_m / max(range_m, 1e-6) + angle_rad / np.pi
        renewal = 1.0 if self.is_open else min(renewal, 1.0)
        self.is_open = False
        factor = 1.0 if tracked.state is State.LOST else tracked.match.variance_factor
        return KeyframeErrors(factor, self.systematic, renewal)
