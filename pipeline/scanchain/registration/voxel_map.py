"""The local map: voxels with mean, normal and shape, of which far and old ones are removed; and its upkeep."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from scanchain import checks, lie
from scanchain.config import LocalMapConfig
from scanchain.data import AnyPoints, Points, Pose
from scanchain.kernels.voxels import CELL, Voxels, insert, keep

_SLOTS_PER_VOXEL = 4  # keeps the hash table at most a quarter full
_MIN_POINTS_ALONE = {2: np.inf, 3: 10.0}  # number at which a voxel is fitted without its neighbors
_NOISE_VOXELS = {2: 2.5, 3: 3.0}  # least voxel size, in standard deviations of a range, to resolve a surface
_ALONE = 120.0  # ratio of a voxel's squared size to the noise variance in a plane: 12 (uniform) times 10
_SWEEP_EVERY = 20  # insertions between two removals of far and old voxels
_RECENT = 20  # number of last scans from which the map is rebuilt with other voxels
_SAME_NOISE = 0.1  # largest relative difference of two standard deviations that count as equal
_ENOUGH = 10  # largest number of scans inserted at a standstill


class VoxelMap:
    """A voxel map to insert points into and match scans against; it grows, and removes far and old voxels.

    Without a limit of the distance, nothing is removed.

    ``voxels`` holds the arrays for the kernels; no other code may write to them.
    """

    def __init__(self, dimension: int, config: LocalMapConfig, scale: float = 1.0, noise_m: float = 0.0) -> None:
        """Empty map with voxels of ``scale`` times ``local_map.voxel_size_m``, or larger ones for noisy ranges.

        noise_m : standard deviation of the ranges where it matters, else 0; voxels filled by noise have no shape
        """
        checks.instance(config, LocalMapConfig, "config", "load_settings(dimension).config.local_map")
        self.dimension = checks.dimension(dimension)
        self.config = config
        self.noise_m = noise_m
        self.scale = max(checks.positive(scale, "scale"), _NOISE_VOXELS[dimension] * noise_m / config.voxel_size_m)
        self.insertions = 0
        self.voxels = _empty(0, self.scale * config.voxel_size_m)
        noisy = 2.0 * (_ALONE * (noise_m / self.voxels.size_m) ** 2) ** 2
        self.alone = max(_MIN_POINTS_ALONE[dimension], noisy)  # points needed to resolve a plane despite the noise

    def __len__(self) -> int:
        return int(self.voxels.used[0])

    def insert(self, points: AnyPoints, T_map_lidar: Pose) -> None:
        """Insert points (N, d), lidar frame; every _SWEEP_EVERY insertions far and old voxels are removed.

        Raises InputError where points or pose do not fit the map.
        """
        points = checks.points(points, "points", self.dimension)
        T_map_lidar = checks.pose(T_map_lidar, "T_map_lidar", self.dimension)
        checks.within_map(points, T_map_lidar, self.voxels.size_m, "points")
        self.insertions += 1
        room = len(self) + len(points)
        if self.insertions % _SWEEP_EVERY == 0 and self.config.max_distance_m < np.inf:
            self._rebuild(room, T_map_lidar, self.config.max_distance_m)
        elif room > len(self.voxels.cells):
            self._rebuild(2 * room, T_map_lidar, np.inf)
        insert(self.voxels, points, T_map_lidar, self.insertions, self.alone, self.noise_m**2)

    def points(self) -> Points:
        """The mean of every voxel, (V, d), map frame."""
        return self.voxels.cells[: len(self), : self.dimension].copy()

    def compact(self) -> None:
        """Free the memory reserved for further points."""
        kept = _empty(len(self), self.voxels.size_m, 1 << 8)
        if len(kept.cells) < len(self.voxels.cells):
            keep(self.voxels, kept, 0.0, 0.0, 0.0, np.inf, 0)
            self.voxels = kept

    def _rebuild(self, room: int, T_map_lidar: Pose, radius_m: float) -> None:
        kept = _empty(room, self.voxels.size_m)
        x, y, z = lie.lift(T_map_lidar)[:3, 3]
        oldest = self.insertions - self.config.max_insertions
        keep(self.voxels, kept, x, y, z, radius_m, oldest)
        self.voxels = kept


class MapKeeper:
    """The voxel map ``surfaces`` and its last scans, from which it can be rebuilt."""

    def __init__(self, dimension: int, config: LocalMapConfig) -> None:
        self.config = config
        self.surfaces, self.scale = VoxelMap(dimension, config), 1.0
        self.recent: deque[tuple[Points, Pose]] = deque(maxlen=_RECENT)
        self.T_odom_inserted = lie.identity(dimension)
        self.standing_scans = 0

    def extend(self, points: Points, T_odom_lidar: Pose, *, is_standing: bool = False) -> None:
        """Insert a scan (N, d) that moved far enough from the last one inserted.

        At a standstill only the first few are inserted, whose mean is less noisy than a single scan: more would
        add nothing but moving objects.
        """
        self.standing_scans = self.standing_scans + 1 if is_standing else 0
        distance_m, angle_rad = lie.apart(self.T_odom_inserted, T_odom_lidar)
        is_far = distance_m >= self.config.insert_distance_m or angle_rad >= self.config.insert_angle_rad
        if (is_far and self.standing_scans <= _ENOUGH) or not len(self.surfaces):
            self.insert(points, T_odom_lidar)

    def insert(self, points: Points, T_odom_lidar: Pose) -> None:
        """Insert a scan (N, d), however far it has moved."""
        self.surfaces.insert(points, T_odom_lidar)
        self.recent.append((points, T_odom_lidar))
        self.T_odom_inserted = T_odom_lidar

    def resize(self, scale: float, noise_m: float = 0.0) -> None:
        """Rebuild the map from the last scans if the scale of its voxels or the range noise changes."""
        is_known = abs(noise_m - self.surfaces.noise_m) <= _SAME_NOISE * noise_m
        if scale != self.scale or not is_known:
            self.scale = scale
            self._remake(noise_m)

    def replace(self, scans: Iterable[tuple[Points, Pose]]) -> None:
        """Rebuild the map from these scans (N, d), each in its lidar frame and with its pose; none empty it."""
        self.recent.clear()
        self.recent.extend(scans)
        self._remake(self.surfaces.noise_m)

    def _remake(self, noise_m: float) -> None:
        self.surfaces = VoxelMap(self.surfaces.dimension, self.config, self.scale, noise_m)
        for points, T_odom_lidar in self.recent:
            self.surfaces.insert(points, T_odom_lidar)


def _empty(room: int, voxel_size_m: float, least: int = 1 << 12) -> Voxels:
    capacity = 1 << int(np.ceil(np.log2(max(room, least))))
    return Voxels(
        rows=np.full(_SLOTS_PER_VOXEL * capacity, -1, np.int32),
        keys=np.empty(capacity, np.int64),
        moments=np.empty((capacity, 10)),
        cells=np.empty((capacity, CELL)),
        history=np.empty((capacity, 3), np.int32),
        used=np.zeros(1, np.int64),
        size_m=voxel_size_m,
    )
