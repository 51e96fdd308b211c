"""Search for a scan in a large map of the plane, near the places where a lidar was, in steps of bounded work."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Points
from scanchain.kernels.search.branch_and_bound import HIT, fill_pyramid, turned_cells
from scanchain.kernels.search.branch_and_bound_steps import FOUND, LIVE, mark_places, queue_of_all, split_best
from scanchain.registration.correlative import ScoreGrid, Window


class PlaceGrid:
    """Points of the plane as in ``ScoreGrid``, and the cells within reach of given positions."""

    def __init__(
        self, points: Points, positions: Points, resolution_m: float, *, reach_m: float, range_m: float
    ) -> None:
        """Draw points (V, 2) and positions (K, 2), meters.

        range_m : of the farthest point that is sought from a cell in reach
        """
        around_m = reach_m + range_m + resolution_m
        extent = np.vstack([points, positions - around_m, positions + around_m])
        self.surfaces = ScoreGrid(points, resolution_m, extent)
        self.places = np.zeros_like(self.surfaces.pyramid)
        mark_places(positions, self.surfaces.origin_m, resolution_m, reach_m, self.places[0])
        fill_pyramid(self.places)


class PlaceSearch:
    """The best poses of a scan with the lidar within reach of a position, each apart from the others."""

    def __init__(self, grid: PlaceGrid, points: Points, window: Window) -> None:
        """Begin with points (N, 2), meters, lidar frame; of the window neither its center nor its size counts."""
        self.grid, self.window = grid, window
        size_m = grid.surfaces.resolution_m
        range_m = max(float(np.median(np.hypot(points[:, 0], points[:, 1]))), size_m)
        turns = math.ceil(math.pi * range_m / size_m)
        self.turn_rad = size_m / range_m
        middle = np.full(2, 0.5 * size_m)  # the lidar stands in the middle of its cell
        mixed = np.random.default_rng(0).permutation(points)  # so that poor poses are given up after a few points
        cells = turned_cells(mixed, lie.identity(2), -middle, size_m, turns, self.turn_rad)
        columns = grid.places.shape[2]
        self.offsets = np.ascontiguousarray(cells[..., 0] + cells[..., 1] * np.int64(columns))
        low, high = cells.min(axis=1), cells.max(axis=1)
        width = np.full(len(cells), columns)
        self.boxes = np.column_stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1], width]).astype(np.int64)
        self.layers = grid.surfaces.pyramid.reshape(len(grid.places), -1)
        self.most = HIT * len(points)
        self.least = math.ceil(window.least * self.most)
        self.windows, self.heads, self.held = queue_of_all(
            self.layers, grid.places, self.offsets, self.boxes, self.least, self.most
        )
        self.found = np.zeros((window.answers, 4), np.int64)

    @property
    def is_done(self) -> bool:
        """True once nothing is left that could score better."""
        return not self.held[LIVE]

    def go_on(self, steps: int) -> int:
        """Split so many windows at most; the number that were split."""
        window, size_m = self.window, self.grid.surfaces.resolution_m
        self.windows, taken = split_best(
            self.layers, self.grid.places, self.offsets, self.boxes, self.windows, self.heads, self.held,
            self.found, steps, size_m, self.turn_rad, self.least, window.apart_m, window.rival,
        )  # fmt: skip
        return taken

    def poses(self) -> NDArray[np.float64]:
        """(A, 4) of x, y, yaw and share found so far, the best first."""
        found = self.found[: self.held[FOUND]]
        xy = self.grid.surfaces.origin_m + self.grid.surfaces.resolution_m * (found[:, 2:] + 0.5)
        yaw = (found[:, 1] - len(self.offsets) // 2) * self.turn_rad
        return np.column_stack([xy, yaw, found[:, 0] / self.most]).astype(np.float64)
