"""A point cloud of the world with one point per voxel, and moving points in it: those that scans saw through."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.checks import LARGEST
from scanchain.data import Points, Pose
from scanchain.errors import InputError
from scanchain.kernels import maps as kernels
from scanchain.kernels.free_space import nearest_ranges, weigh_points
from scanchain.kernels.voxels import EMPTY
from scanchain.threads import threads

MAX_VOXELS = 16_000_000  # largest number of voxels: a gigabyte

_COLUMNS = 720  # bins of azimuth, 0.5°; as fine in elevation
_REACH_BINS = 1.5  # width of a bin in voxels at the farthest range that a scan is used to
_WINDOW = 0.6  # share of a scan's spacing, within which a surface has a point
_RANGE_MARGIN_SHARE = 0.03  # share of a range by which two may differ, plus one voxel
_LEVEL = (0.5, 0.005)  # assumed flatness of the ground in voxels, and error of an elevation
_LEAST_THROUGH = 2  # least number of scans that saw through what moved
_MAJORITY = 1.5  # least ratio of scans that saw through to scans that saw a surface there
_ENOUGH = 12  # number of scans that saw a surface for which it is retained
_EVERY = np.iinfo(np.int32).max  # a limit that no number of scans reaches


class PointMap:
    """Scans accumulated in the world frame; each voxel keeps the mean of its points.

    voxel_size_m : edge of a voxel; doubled each time that ``max_voxels`` of them do not suffice, or that a point
        is a million of them away from the first scan
    dimension : 2 or 3, of the points
    """

    def __init__(self, dimension: int, voxel_size_m: float, *, max_voxels: int = MAX_VOXELS) -> None:
        self.dimension = dimension
        self.voxel_size_m = voxel_size_m
        self.max_voxels = max_voxels
        self.center_m = np.zeros(3)
        self._allocate(min(1 << 14, max_voxels))

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
        """Double the rows or, if that is too many or the keys do not suffice, the size of the voxels."""
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


@dataclass(frozen=True, slots=True)
class View:
    """A scan whose free space is compared with a map.

    T_world_lidar : (d+1, d+1)
    points : (M, d) meters, lidar frame
    spacing_m : edge of the voxels that the scan was downsampled with; a surface has a point in each
    """

    T_world_lidar: Pose
    points: Points
    spacing_m: float


def moved(voxels: Points, voxel_size_m: float, views: Iterable[View]) -> NDArray[np.bool_]:
    """True for points (N, d) of a map, one per voxel, that clearly more scans saw through than saw a surface.

    A surface that many scans saw is retained in any case: what stood there for long is part of the map.
    """
    seen, seen_through = sightings(voxels, voxel_size_m, views, enough=_ENOUGH)
    return clearly_through(seen, seen_through) & (seen < _ENOUGH)


def clearly_through(seen: NDArray[np.int32], seen_through: NDArray[np.int32]) -> NDArray[np.bool_]:
    """True for points that clearly more scans saw through than saw a surface there."""
    return (seen_through >= _LEAST_THROUGH) & (seen_through > _MAJORITY * seen)


def reach_of(voxel_size_m: float) -> float:
    """Range up to which scans are compared with the points of a map of such voxels, meters."""
    return _REACH_BINS * voxel_size_m * _COLUMNS / (2.0 * np.pi)


def sightings(
    voxels: Points, voxel_size_m: float, views: Iterable[View], *, enough: int = _EVERY
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Numbers of scans that saw a surface at each point (N, d) of a map, one per voxel, and that saw through it.

    enough : a point that this many scans saw is not tested again
    """
    index = _Cells(lie.lift_points(voxels), reach_of(voxel_size_m))
    seen, seen_through = np.zeros((2, len(voxels)), np.int32)
    ranges_m = np.empty((1 if voxels.shape[1] == 2 else _COLUMNS // 2, _COLUMNS))
    count = threads()
    with ThreadPoolExecutor(count) as pool:  # points are independent, and kernels release the GIL
        for view in views:
            nearest_ranges(lie.lift_points(view.points), ranges_m)
            T_world_lidar = lie.lift(view.T_world_lidar)
            T_lidar_world, spans = lie.inverse(T_world_lidar), index.within_reach(T_world_lidar[:3, 3])
            limits = np.array([
                index.reach_m, max(_WINDOW * view.spacing_m, voxel_size_m), voxel_size_m, _RANGE_MARGIN_SHARE,
                _LEVEL[0] * voxel_size_m, _LEVEL[1],
            ])  # fmt: skip
            parts = [
                pool.submit(
                    weigh_points, index.points, np.ascontiguousarray(spans[k::count]), T_lidar_world, ranges_m,
                    limits, enough, seen, seen_through,
                )
                for k in range(count)
            ]  # fmt: skip
            for part in parts:
                part.result()
    order = np.argsort(index.order)
    return seen[order], seen_through[order]


class _Cells:
    """Points sorted by cubes, so that a scan tests only those within reach, and neighbors in sequence."""

    def __init__(self, points: Points, reach_m: float) -> None:
        self.reach_m = reach_m
        self.edge_m = reach_m / 8.0  # of cubes, by which points are sorted
        cubes = np.floor(points / self.edge_m)
        self.order = np.lexsort(cubes.T)
        self.points, cubes = points[self.order], cubes[self.order]
        is_first = np.append(True, (cubes[1:] != cubes[:-1]).any(axis=1))[: len(points)]
        first = np.flatnonzero(is_first)
        self.middles_m = (cubes[first] + 0.5) * self.edge_m
        self.spans = np.column_stack([first, np.append(first, len(points))[1:]])

    def within_reach(self, position_m: NDArray[np.float64]) -> NDArray[np.int64]:
        """(S, 2) spans of the points in cubes that are, in part, within reach of a position."""
        outside_m = np.maximum(np.abs(self.middles_m - position_m) - 0.5 * self.edge_m, 0.0)
        return self.spans[np.einsum("ij,ij->i", outside_m, outside_m) <= self.reach_m**2]
