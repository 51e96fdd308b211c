"""The local map: voxels that remember mean, normal and shape, and forget what is far or old; and its upkeep."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from scanchain import checks, lie
from scanchain.config import LocalMapConfig
from scanchain.data import AnyPoints, Points, Pose
from scanchain.kernels.voxels import CELL, Voxels, insert, keep

_SLOTS_PER_VOXEL = 4  # keeps the hash table at most a quarter full
_MIN_POINTS_ALONE = {2: np.inf, 3: 10.0}  # from which on a voxel is fitted without its neighbors
_NOISE_VOXELS = {2: 2.5, 3: 3.0}  # least size of a voxel in standard deviations of a range, to show a surface
_ALONE = 120.0  # variances of a plane across it, over those of a voxel that shows it: 12 of the extent, 10 times
_LEAST, _LEAST_COMPACT = 1 << 12, 1 << 8  # least number of voxels that there is room for
_SWEEP_EVERY = 20  # insertions between two rounds of forgetting
_RECENT = 20  # number of last scans from which a map with other voxels is built
_SAME_NOISE = 0.1  # share of a standard deviation up to which two are one
_ENOUGH = 10  # number of scans inserted of a lidar that stands


class VoxelMap:
    """A map that points are inserted into and scans are matched against; grows and forgets by itself.

    A map without a limit of the distance forgets nothing.

    ``voxels`` holds the arrays for the kernels; nobody else writes into them.
    """

    def __init__(self, dimension: int, config: LocalMapConfig, scale: float = 1.0, noise_m: float = 0.0) -> None:
        """Make an empty map with voxels of ``scale`` times ``local_map.voxel_size_m``, or larger ones.

        noise_m : standard deviation of the ranges where it counts, else 0; voxels that it fills have no shape
        """
        checks.instance(config, LocalMapConfig, "config", "load_settings(dimension).config.local_map")
        self.dimension = checks.dimension(dimension)
        self.config = config
        self.noise_m = noise_m
        self.scale = max(checks.positive(scale, "scale"), _NOISE_VOXELS[dimension] * noise_m / config.voxel_size_m)
        self.insertions = 0
        self.voxels = _empty(_LEAST, self.scale * config.voxel_size_m)
        noisy = 2.0 * (_ALONE * (noise_m / self.voxels.size_m) ** 2) ** 2
        self.alone = max(_MIN_POINTS_ALONE[dimension], noisy)  # points that show a plane in spite of the noise

    def __len__(self) -> int:
        return int(self.voxels.used[0])

    def insert(self, points: AnyPoints, T_map_lidar: Pose) -> None:
        """Add points (N, d) of the lidar frame; every so often forget what is far or old.

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
        """Free the memory that is there for further points."""
        kept = _empty(len(self), self.voxels.size_m, _LEAST_COMPACT)
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
    """The voxel map ``surfaces``, and the last scans in it, from which it can be rebuilt."""

    def __init__(self, dimension: int, config: LocalMapConfig) -> None:
        self.config = config
        self.surfaces, self.scale = VoxelMap(dimension, config), 1.0
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

    def resize(self, scale: float, noise_m: float = 0.0) -> None:
        """Rebuild the map from the last scans where the scale of its voxels changes, or the noise of ranges."""
        is_known = abs(noise_m - self.surfaces.noise_m) <= _SAME_NOISE * noise_m
        if scale != self.scale or not is_known:
            self.scale = scale
            self._remake(noise_m)

    def replace(self, scans: Iterable[tuple[Points, Pose]]) -> None:
        """Rebuild the map from these scans (N, d), each in its own lidar frame, with its pose; none empty it."""
        self.recent.clear()
        self.recent.extend(scans)
        self._remake(self.surfaces.noise_m)

    def _remake(self, noise_m: float) -> None:
        self.surfaces = VoxelMap(self.surfaces.dimension, self.config, self.scale, noise_m)
        for points, T_odom_lidar in self.recent:
            self.surfaces.insert(points, T_odom_lidar)


def _empty(room: int, voxel_size_m: float, least: int = _LEAST) -> Voxels:
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
