"""Scans of a log along its path: poses by odometry, and the points that are kept of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.data import Points, Trajectory
from scanchain.graph.growing_array import GrowingArray
from scanchain.odometry import Located
from scanchain.point_store import PointStore, StoredPoints


class Trail:
    """Odometry pose of every scan, and the points of keyframes or of all scans, in a file.

    ``traveled_m`` is the length of the path.
    """

    def __init__(self, dimension: int, points_file: Path | None, start_m: float, *, keeps_scans: bool) -> None:
        """Begin before the first scan.

        start_m : path length there
        keeps_scans : whether points of all scans are kept, not only of keyframes
        """
        self.keeps_scans = keeps_scans
        self.points = PointStore(dimension, points_file)
        self.spans = GrowingArray((2,), np.int64)
        self.stamps_ns = GrowingArray((), np.int64)
        self.odometry_poses = GrowingArray((dimension + 1,) * 2, np.float64)
        self.traveled_m = start_m

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def add(self, located: Located) -> StoredPoints | None:
        """Add a scan; its points, or None if they are not kept."""
        tracked = located.tracked
        if len(self.odometry_poses):
            self.traveled_m += lie.apart(self.odometry_poses.rows[-1], tracked.T_odom_lidar)[0]
        self.stamps_ns.append(tracked.scan.stamp_ns)
        self.odometry_poses.append(tracked.T_odom_lidar)
        if not located.is_keyframe and not self.keeps_scans:
            return None
        return self._stored(tracked.points)

    def replace_first(self, points: Points) -> StoredPoints:
        """The stored points of the first scan, (M, d), which were deskewed anew."""
        self.spans.replace(np.empty((0, 2)))
        return self._stored(points)

    def points_of(self, scan: int) -> Points:
        """(M, d) points of a scan, if all scans are kept."""
        return StoredPoints(self.points, *self.spans.rows[scan].tolist()).read()

    @property
    def odometry(self) -> Trajectory:
        """Odometry poses of all scans."""
        return Trajectory(self.stamps_ns.rows.copy(), self.odometry_poses.rows.copy())

    def _stored(self, points: Points) -> StoredPoints:
        stored = self.points.add(points)
        self.spans.append((stored.first, stored.count))
        return stored
