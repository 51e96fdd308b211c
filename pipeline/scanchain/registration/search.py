"""Correlative scan matching: poses of planar points in a grid, within a window or anywhere (Olson 2009)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from scanchain import lie
from scanchain.data import Points, Pose
from scanchain.kernels.search import TURNS, Score, climb, score_windows, split_best
from scanchain.preprocess import downsample
from scanchain.registration.voxel_map import VoxelMap

_TOP = 2  # levels of the pyramid above the grid itself; windows start with 2² cells: larger ones prune little
_SIZE = 2**_TOP
_MIN_RANGE = 10.0  # least median range, in cells, for the step of the headings
_ADDITIONS = 250_000_000  # of scores per slice of a search, 20 to 40 ms
_STEPS = 150_000  # windows that are split per slice
POINTS = 120  # largest number of points of planar scans that are scored, one per cell
_TALL = 0.75  # cells between lowest and highest point of a column, above which it is upright structure


@dataclass(frozen=True, slots=True)
class Window:
    """Poses around a center (3, 3): largest offset along x and y, and in heading."""

    T_target_source: Pose
    half_width_m: float
    half_width_rad: float = math.pi


class Wanted(NamedTuple):
    """Poses that a search is to find.

    apart_m : least distance between two distinct poses; or they differ by 0.1 rad
    rival : share of the best score that further ones reach at least
    answers : largest number of poses
    least : share of the maximum score that any pose reaches at least
    """

    apart_m: float
    rival: float
    answers: int
    least: float = 0.0


@dataclass(frozen=True, slots=True)
class Found:
    """A pose (3, 3), to within a cell, and its score as a share of the maximum for these points."""

    T_target_source: Pose
    share: float


class SearchGrid:
    """Scores of a point in each cell of a grid: 2 on a surface, 1 next to one, 0 elsewhere, −2 in free space."""

    def __init__(
        self, cells: NDArray[np.int8], origin_m: Points, resolution_m: float, room: NDArray[np.bool_] | None = None
    ) -> None:
        """Pad the scores and build their pyramid.

        cells : (rows, columns), row along y
        origin_m : (2,) corner of cell (0, 0)
        room : cells that may contain the lidar, for a search without a window
        """
        self.resolution_m = resolution_m
        self.origin_m = origin_m - _SIZE * resolution_m
        layer = np.pad(cells, _SIZE)  # windows may start before the first cell
        self.room = np.zeros(layer.shape, np.bool_)
        if room is not None:
            self.room[_SIZE:-_SIZE, _SIZE:-_SIZE] = room
        self.pyramid = np.empty((_TOP + 1, *layer.shape), np.int8)
        self.pyramid[0] = layer
        for level in range(_TOP):
            self.pyramid[level + 1] = _best_of_four(self.pyramid[level], 1 << level)
        wider = np.roll(_best_of_four(self.pyramid[_TOP], _SIZE // 2), 1, axis=(0, 1))  # by a cell on each side
        self.blocks = np.ascontiguousarray(_in_blocks(wider).transpose(1, 3, 0, 2))

    @classmethod
    def of_points(
        cls, points: Points, resolution_m: float, near: Points | None = None, reach_m: float = 0.0
    ) -> SearchGrid:
        """Grid of the surfaces at points (V, 2), meters; ``room`` is all within reach of positions (K, 2)."""
        positions = np.empty((0, 2)) if near is None else near
        extent = np.vstack([points, positions - reach_m, positions + reach_m])
        origin_m = extent.min(axis=0) - 2.0 * resolution_m if len(extent) else np.zeros(2)
        shape = _cells(extent, origin_m, resolution_m).max(axis=0, initial=0)[::-1] + 2
        cells, away = np.zeros(shape, np.int8), np.ones(shape, np.bool_)
        columns, rows = _cells(points, origin_m, resolution_m).T
        draw_surfaces(cells, rows, columns)
        columns, rows = _cells(positions, origin_m, resolution_m).T
        away[rows, columns] = False
        room = np.asarray(distance_transform_edt(away)) * resolution_m <= reach_m if len(positions) else None
        return cls(cells, origin_m, resolution_m, room)

    @classmethod
    def of_voxels(cls, target: VoxelMap, center: Pose, radius_m: float = math.inf) -> SearchGrid:
        """Grid of the surfaces of a planar voxel map in a square around a pose, one cell per voxel."""
        means = target.points()
        means = means[np.abs(means - center[:2, 2]).max(axis=1, initial=0.0) <= radius_m]
        return cls.of_points(means, target.voxels.size_m)

    def climbed(self, points: Points, T: Pose, step_rad: float) -> Found:
        """Local maximum of the score of points (N, 2), in steps of half a cell and ``step_rad``, then finer."""
        pose = np.array([*T[:2, 2], lie.yaw(T)])
        score = climb(self.pyramid[0], points, self.origin_m, self.resolution_m, pose, step_rad)
        return Found(lie.pose_2d(*pose.tolist()), float(score) / Score.SURFACE)


class Search:
    """Search for points in a grid, in slices of equal work, so that it does not delay scans of a live stream."""

    def __init__(self, points: Points, grid: SearchGrid, region: Window | None, wanted: Wanted) -> None:
        """Start a search for points (N, 2), meters, lidar frame; within the region or in all cells with ``room``.

        Headings are in steps that move a point at the median range by one cell.
        """
        size_m = grid.resolution_m
        ranges_m = np.hypot(points[:, 0], points[:, 1])
        range_m = max(float(np.median(ranges_m)) if len(points) else 0.0, _MIN_RANGE * size_m)
        if region is None:
            self.room = grid.room
            self.begin = np.append(grid.origin_m + 0.5 * size_m, 0.0)
            turns = math.ceil(2.0 * math.pi * range_m / size_m)
            self.turn_rad = 2.0 * math.pi / turns
        else:
            shifts = math.ceil(region.half_width_m / size_m)
            self.room = np.ones((2 * shifts + 1, 2 * shifts + 1), np.bool_)
            self.turn_rad = size_m / range_m
            half = math.ceil(min(region.half_width_rad, math.pi) / self.turn_rad)
            turns = 2 * half + 1
            T = region.T_target_source
            self.begin = np.append(T[:2, 2] - shifts * size_m, lie.yaw(T) - half * self.turn_rad)
        self.grid, self.wanted = grid, wanted
        mixed = np.random.default_rng(0).permutation(points)  # so that poor poses are rejected after a few points
        self.cells = self._turned(mixed, turns)
        blocks = _in_blocks(self.room)
        self.has_room = np.asarray(blocks.any(axis=(1, 3)))
        past_last = self.has_room.shape[1] - self.has_room[:, ::-1].argmax(axis=1)  # per row, if any has room
        self.spans = np.column_stack([self.has_room.argmax(axis=1), past_last * self.has_room.any(axis=1)])
        self.full = Score.SURFACE * len(points)
        self.least = max(wanted.least * self.full, 1.0)
        additions = int(np.diff(self.spans).sum()) * len(points)
        self.headings = TURNS * max(_ADDITIONS // max(additions, 1), 1)
        self.turn = 0 if len(points) else turns
        self.reached = np.zeros(1)
        self.scored: list[NDArray[np.int64]] = [np.empty((0, 5), np.int64)]
        self.windows = np.empty((0, 5), np.int64)
        self.split = np.zeros(2, np.int64)
        self.found = np.empty((wanted.answers, 4))

    @property
    def is_done(self) -> bool:
        """True once no remaining window could score better."""
        return self.turn >= len(self.cells) and not len(self.windows) and self.split[0] == len(self.scored[0])

    def advance(self) -> None:
        """Score the next headings or, once all are, split the next windows."""
        grid, wanted = self.grid, self.wanted
        if self.turn < len(self.cells):
            cells = self.cells[self.turn : self.turn + self.headings]
            self.scored.append(
                score_windows(
                    grid.blocks, grid.pyramid, self.room, self.has_room, self.spans, cells, self.turn, self.least,
                    wanted.rival, self.reached,
                )
            )  # fmt: skip
            self.turn += len(cells)
            if self.turn == len(self.cells):
                scored = np.vstack(self.scored)
                scored = scored[-scored[:, 0] >= max(self.least, wanted.rival * self.reached[0])]
                self.scored = [scored[np.argsort(scored[:, 0], kind="stable")]]
            return
        apart = wanted.apart_m / grid.resolution_m
        self.windows = split_best(
            grid.pyramid, self.room, self.cells, self.scored[0], self.split, self.windows, self.found,
            self.turn_rad, self.least, wanted.rival, apart, _STEPS,
        )  # fmt: skip

    def poses(self) -> Sequence[Found]:
        """The poses found so far, the best first."""
        found = self.found[: self.split[1]]
        poses = self.begin + found[:, :3] * (self.grid.resolution_m, self.grid.resolution_m, self.turn_rad)
        shares = (found[:, 3] / self.full).tolist()
        return [Found(lie.pose_2d(*pose), share) for pose, share in zip(poses.tolist(), shares, strict=True)]

    def _turned(self, points: Points, turns: int) -> NDArray[np.int32]:
        """Column and row (turns, N, 2) of the points under every heading."""
        yaws = self.begin[2] + np.arange(turns)[:, None] * self.turn_rad
        c, s = np.cos(yaws), np.sin(yaws)
        turned = np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=2)
        return _cells(turned + self.begin[:2], self.grid.origin_m, self.grid.resolution_m).astype(np.int32)


def find(points: Points, grid: SearchGrid, region: Window | None, wanted: Wanted) -> Sequence[Found]:
    """The best poses of points (N, 2), meters, lidar frame, in a region or wherever the grid has ``room``."""
    search = Search(points, grid, region, wanted)
    while not search.is_done:
        search.advance()
    return search.poses()


def draw_surfaces(cells: NDArray[np.int8], rows: NDArray[np.int64], columns: NDArray[np.int64]) -> None:
    """Set the scores of cells with surfaces, and of their neighbors; none may lie on the border."""
    for row in (rows - 1, rows, rows + 1):
        for column in (columns - 1, columns, columns + 1):
            cells[row, column] = np.maximum(cells[row, column], Score.NEAR)
    cells[rows, columns] = Score.SURFACE


def evenly(points: Points, most: int) -> Points:
    """At most ``most`` of the points (N, d), at even steps."""
    return np.ascontiguousarray(points[:: max(math.ceil(len(points) / most), 1)])


def thinned(points: Points, size_m: float) -> Points:
    """Points (N, 2) of a scan, downsampled to one per cell and at most POINTS, evenly spread."""
    return evenly(downsample(points, size_m), POINTS)


def upright_columns(points: Points, size_m: float) -> Points:
    """Mean (x, y) of every column (M, 2) whose points (N, 3) span more than _TALL of its width in height.

    Walls, trunks and cars are upright structure. The ground is not, and so does not affect the score.
    """
    if not len(points):
        return np.empty((0, 2))
    cells = np.floor(points[:, :2] / size_m).astype(np.int64)
    cells -= cells.min(axis=0)
    _, column = np.unique(cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1], return_inverse=True)
    count = np.bincount(column)
    low, high = np.full(len(count), math.inf), np.full(len(count), -math.inf)
    np.minimum.at(low, column, points[:, 2])
    np.maximum.at(high, column, points[:, 2])
    means = np.column_stack([np.bincount(column, points[:, axis]) / count for axis in range(2)])
    return means[high - low > _TALL * size_m]


def _cells(points: Points, origin_m: Points, size_m: float) -> NDArray[np.int64]:
    """Column and row (N, 2) of points."""
    return np.floor((points - origin_m) / size_m).astype(np.int64)


def _best_of_four(layer: NDArray[np.int8], half: int) -> NDArray[np.int8]:
    """Best score of each cell and those ``half`` cells further along x, y and both."""
    best = layer.copy()
    np.maximum(best[:, :-half], layer[:, half:], out=best[:, :-half])
    np.maximum(best[:-half], best[half:], out=best[:-half])
    return best


def _in_blocks(cells: NDArray[Any]) -> NDArray[Any]:
    """Cells in blocks (rows, 2², columns, 2²), padded with zeros."""
    rows, columns = -(-np.array(cells.shape) // _SIZE)
    padded = np.zeros((rows * _SIZE, columns * _SIZE), cells.dtype)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    return padded.reshape(rows, _SIZE, columns, _SIZE)
