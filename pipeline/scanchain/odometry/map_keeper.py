"""The local map of odometry: extended where scans add something new, rebuilt, cleared."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.data import Points, Pose
from scanchain.registration import VoxelMap

_RECENT = 20  # number of last scans from which a map with other voxels is built
_ENOUGH = 10  # number of scans inserted of a lidar that stands


class MapKeeper:
    """The voxel map ``surfaces``, and the last scans in it, from which it can be rebuilt."""

    def __init__(self, dimension: int, config: LocalMapConfig) -> None:
        self.config = config
        self.surfaces = VoxelMap(dimension, config)
        self.recent: deque[tuple[Points, Pose]] = deque(maxlen=_RECENT)
        self.T_odom_inserted = lie.identity(dimension)
        self.standing_scans = 0

    def extend(self, points: Points, T_odom_lidar: Pose, *, is_standing: bool = False) -> None:
        """Insert a scan (N, d) that moved far enough from the last one inserted.

        Of a lidar that stands only the first few, whose mean is less noisy than one of them: more would bring
        nothing new but what moves past it.
        """
        self.standing_scans = self.standing_scans + 1 if is_standing else 0
        distance_m, angle_rad = lie.apart(self.T_odom_inserted, T_odom_lidar)
        is_far = distance_m >= self.config.insert_distance_m or angle_rad >= self.config.insert_angle_rad
        if (is_far and self.standing_scans <= _ENOUGH) or not len(self.surfaces):
            self.insert(points, T_odom_lidar)

    def insert(self, points: Points, T_odom_lidar: Pose) -> None:
        """Insert a scan (N, d) wherever it is."""
        self.surfaces.insert(points, T_odom_lidar)
        self.recent.append((points, T_odom_lidar))
        self.T_odom_inserted = T_odom_lidar

    def resize(self, scale: float) -> None:
        """Rebuild the map from the last scans where the scale of its voxels changes."""
        if scale != self.surfaces.scale:
            self._remake(scale)

    def replace(self, scans: Iterable[tuple[Points, Pose]]) -> None:
        """Rebuild the map from these scans (N, d), each in its own lidar frame, with its pose."""
        self.recent.clear()
        self.recent.extend(scans)
        self._remake(self.surfaces.scale)

    def restart(self, points: Points) -> None:
        """Rebuild the map from a single scan (N, d), odom frame."""
        self.replace([(points, lie.identity(self.surfaces.dimension))])

    def forget(self) -> None:
        """Empty the map."""
        self.replace([])

    def _remake(self, scale: float) -> None:
        self.surfaces = VoxelMap(self.surfaces.dimension, self.config, scale)
        for points, T_odom_lidar in self.recent:
            self.surfaces.insert(points, T_odom_lidar)
