"""An occupancy grid into which scans are inserted one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from scanchain.config import MapsConfig
from scanchain.data import Matrix, Pose
from scanchain.errors import InputError
from scanchain.kernels import maps as kernels

OCCUPIED_PROBABILITY = 0.65  # above it a cell counts as occupied
FREE_PROBABILITY = 1.0 - OCCUPIED_PROBABILITY  # below it as free; between them, and where unseen, as unknown
MAX_CELLS = 64_000_000  # largest number of cells: half a gigabyte

# log-odds of a hit (0.7) and a miss (0.4), and their limits (0.12 and 0.97): Hornung et al. 2013, sec. 5.1
_LOG_ODDS = (0.85, -0.4, -2.0, 3.5)
_MARGIN = 2  # cells around all beams; rounding may shift a beam by one cell


class OccupancyGrid:
    """Log-odds of occupancy over the xy plane of the world; grows as scans come in.

    2D scans are inserted as they are; of 3D scans, only the returns between ``slice_min_z_m`` and
    ``slice_max_z_m`` above the lidar, along the world's z. Returns beyond ``grid_max_range_m`` are ignored.

    resolution_m : edge of a cell
    origin_m : (2,) outer corner of cell (0, 0), the one of least x and y
    log_odds : (rows, columns) float32, row along y; 0 where nothing was seen
    drawn : (rows, columns) number of the last scan that observed a cell, from 1; 0 for none
    """

    def __init__(self, config: MapsConfig) -> None:
        self.config = config
        self.resolution_m = config.grid_resolution_m
        self.origin_m = np.zeros(2)
        self.log_odds = np.zeros((0, 0), np.float32)
        self.drawn = np.zeros((0, 0), np.int32)
        self.scans = 0

    def insert(self, T_world_lidar: Pose, points: NDArray[np.floating]) -> None:
        """Insert one scan: points (N, d), meters, lidar frame."""
        self.insert_batch(T_world_lidar[None], points, np.array([0, len(points)]))

    def insert_batch(self, poses: Matrix, points: NDArray[np.floating], offsets: NDArray[np.int64]) -> None:
        """Insert K scans: poses (K, d+1, d+1), points (N, d) of all of them, scan k from offsets[k] to [k + 1]."""
        if not len(poses):
            return
        beams = [
            self._beams_in_slice(T, points[slice(*part)]) for T, part in zip(poses, pairwise(offsets), strict=True)
        ]
        kept = np.cumsum([0, *(len(ends) for _, ends in beams)])
        starts, ends = (np.concatenate(each) for each in zip(*beams, strict=True))
        if len(starts):
            corners = [(each.min(axis=0), each.max(axis=0)) for each in (starts, ends)]
            self._cover(np.concatenate([np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))]))
            kernels.draw_beams(
                starts, ends, kept, self.origin_m, self.resolution_m, self.scans + 1, *map(np.float32, _LOG_ODDS),
                self.log_odds, self.drawn,
            )  # fmt: skip
        self.scans += len(poses)

    def _beams_in_slice(self, T: Pose, points: NDArray[np.floating]) -> tuple[Matrix, Matrix]:
        """Start and end (M, 2), world, of the part of each beam of a scan that lies in the slice.

        A beam runs straight from the lidar to its return, at a height z above it. Where the slice does not contain
        the lidar's height, it starts where it enters the slice: at the share limit / z of its length.
        """
        squares = sum(column * column for column in points.T)
        points = points[squares <= min(self.config.grid_max_range_m**2, 1e300)]
        moved = np.asarray(sum(T[:-1, axis] * points[:, axis, None] for axis in range(points.shape[1])))
        share = 0.0
        if points.shape[1] == 3:
            low_m, high_m = self.config.slice_min_z_m, self.config.slice_max_z_m
            moved = moved[(low_m <= moved[:, 2]) & (moved[:, 2] <= high_m)]
            limit_m = low_m if low_m > 0.0 else min(high_m, 0.0)
            share = limit_m / moved[:, 2:] if limit_m else 0.0
        return T[:2, -1] + share * moved[:, :2], T[:2, -1] + moved[:, :2]

    def probability(self) -> NDArray[np.float32]:
        """(rows, columns) probability that a cell is occupied; ½ where nothing was seen."""
        return (1.0 / (1.0 + np.exp(-self.log_odds))).astype(np.float32)

    def trimmed(self) -> OccupancyGrid:
        """The same grid without the unseen rows and columns around what was seen."""
        seen = self.drawn > 0
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        result = OccupancyGrid(self.config)
        result.scans = self.scans
        if len(rows):
            box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            result.origin_m = self.origin_m + self.resolution_m * np.array([columns[0], rows[0]])
            result.log_odds, result.drawn = self.log_odds[box].copy(), self.drawn[box].copy()
        return result

    def _cover(self, extent: NDArray[np.float64]) -> None:
        """Grow the grid, by whole cells, so that it holds the extent (min x, min y, max x, max y) and a margin."""
        if not np.isfinite(extent).all():
            raise InputError("a scan inserted into the grid has a pose or a point that is not finite")
        size = np.array(self.log_odds.shape[::-1])
        if not size.size or not size.all():
            self.origin_m = np.floor(extent[:2] / self.resolution_m) * self.resolution_m
            size = np.zeros(2, np.int64)
        lower = np.floor((extent[:2] - self.origin_m) / self.resolution_m) - _MARGIN
        upper = np.floor((extent[2:] - self.origin_m) / self.resolution_m) + _MARGIN + 1
        columns, rows = (np.maximum(upper, size) - np.minimum(lower, 0)).tolist()
        if not columns * rows <= MAX_CELLS:
            raise InputError(
                f"the occupancy grid needs {columns:.15g} x {rows:.15g} cells of {self.resolution_m:g} m, more "
                f"than {MAX_CELLS}; raise maps.grid_resolution_m"
            )
        lower, upper = lower.astype(np.int64), upper.astype(np.int64)
        if (lower >= 0).all() and (upper <= size).all():
            return
        spare = (0.25 * np.maximum(size, upper - lower)).astype(np.int64)
        before = np.where(lower < 0, -lower + spare, 0)
        after = np.where(upper > size, upper - size + spare, 0)
        if np.prod(before + size + after) > MAX_CELLS:
            before, after = np.maximum(-lower, 0), np.maximum(upper - size, 0)
        self.origin_m = self.origin_m - before * self.resolution_m
        margins = [(int(near), int(far)) for near, far in zip(before[::-1], after[::-1], strict=True)]
        self.log_odds, self.drawn = np.pad(self.log_odds, margins), np.pad(self.drawn, margins)


def draw_grid(scans: Iterable[tuple[Pose, NDArray[np.floating]]], config: MapsConfig) -> OccupancyGrid:
    """The grid of (T_world_lidar, points) pairs; only one scan is in memory at a time."""
    grid = OccupancyGrid(config)
    for T_world_lidar, points in scans:
        grid.insert(T_world_lidar, points)
    return grid.trimmed()


def fitting_resolution(
    poses: Matrix | Sequence[Pose], *, resolution_m: float, max_range_m: float, max_cells: int = MAX_CELLS
) -> float:
    """The resolution, doubled until a grid that reaches ``max_range_m`` beyond every pose is small enough."""
    stacked = np.asarray(poses)
    extent_m = np.ptp(stacked[:, :2, -1], axis=0) + 2.0 * max_range_m
    while np.prod(extent_m / resolution_m + 2 * _MARGIN + 2) > max_cells:
        resolution_m *= 2.0
    return resolution_m
