"""A point cloud of the world with one point a voxel."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from scanchain.checks import LARGEST
from scanchain.data import Points, Pose
from scanchain.errors import InputError
from scanchain.kernels import maps as kernels
from scanchain.kernels.voxels import EMPTY

MAX_VOXELS = 16_000_000  # largest number of voxels: a gigabyte
_FIRST_VOXELS = 1 << 14


class PointMap:
    """Scans added up in the world frame; each voxel keeps the mean of its points.

    Attributes
    ----------
    voxel_size_m : edge of a voxel; doubled each time that ``max_voxels`` of them do not suffice, or that a point
        lies a million of them from the first scan
    dimension : 2 or 3, of the points
    """

    def __init__(self, dimension: int, voxel_size_m: float, *, max_voxels: int = MAX_VOXELS) -> None:
        self.dimension = dimension
        self.voxel_size_m = voxel_size_m
        self.max_voxels = max_voxels
        self.center_m = np.zeros(3)
        self._allocate(min(_FIRST_VOXELS, max_voxels))

    def __len__(self) -> int:
        return self.used

    def insert(self, T_world_lidar: Pose, points: NDArray[np.floating]) -> None:
        """Add one scan: points (N, d), meters, lidar frame."""
        if not np.abs(T_world_lidar).max() < LARGEST:
            raise InputError("a scan added to the map has a pose that is not finite")
        if not self.used:
            self.center_m[: self.dimension] = T_world_lidar[:-1, -1]
        R, t = T_world_lidar[:-1, :-1], T_world_lidar[:-1, -1]
        finite = points[np.isfinite(points).all(axis=1)]
        moved = sum((R[:, axis] * finite[:, axis, None] for axis in range(self.dimension)), start=t[None])
        while len(moved):
            moved = moved[self._add(moved, moved, np.ones(len(moved), np.int64)) :]
            if len(moved):
                self._make_room()

    def _add(self, points: Points, sums: Points, counts: NDArray[np.int64]) -> int:
        """Number of points that were added: fewer than all where there was no room."""
        self.used, done = kernels.add_points(
            points, sums, counts, self.voxel_size_m, self.center_m,
            self.slots, self.cells, self.sums, self.counts, self.used,
        )  # fmt: skip
        return done

    def points(self) -> Points:
        """(M, d) mean of every voxel, in the order in which they were first seen."""
        return self.sums[: self.used] / self.counts[: self.used, None]

    def _make_room(self) -> None:
        """Double the rows or, where that is too many or the keys do not reach, the size of the voxels."""
        sums, counts = self.sums[: self.used], self.counts[: self.used]
        if self.used == len(self.counts) < self.max_voxels:
            self._allocate(min(2 * len(self.counts), self.max_voxels))
        else:
            self.voxel_size_m *= 2.0
            self._allocate(len(self.counts))
        self._add(sums / counts[:, None], sums, counts)

    def _allocate(self, rows: int) -> None:
        slots = 1 << int(2 * rows - 1).bit_length()
        self.slots = np.full(slots, EMPTY)
        self.cells = np.zeros(slots, np.int32)
        self.sums = np.zeros((rows, self.dimension))
        self.counts = np.zeros(rows, np.int64)
        self.used = 0


def build_point_map(
    scans: Iterable[tuple[Pose, NDArray[np.floating]]], *, dimension: int, voxel_size_m: float
) -> PointMap:
    """The map of (T_world_lidar, points) pairs; only one scan is in memory at a time."""
    result = PointMap(dimension, voxel_size_m)
    for T_world_lidar, points in scans:
        result.insert(T_world_lidar, points)
    return result
