"""Correlative search: initial poses for matching, beyond the basin of attraction of ICP."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Points, Pose
from scanchain.kernels.search.branch_and_bound import draw_hits, fill_pyramid, search
from scanchain.preprocess.sweep import downsample
from scanchain.registration.voxel_map import VoxelMap

_POINTS = 120  # of the scan that are scored, one a voxel, evenly spread
_APART_M = 1.0  # least distance of two distinct poses
_RIVAL = 0.8  # share of the best score, from which on a distinct pose is returned as its rival
_TOP = 5  # levels of the pyramid above the grid itself; windows start with 2⁵ cells


@dataclass(frozen=True, slots=True)
class Window:
    """Poses that are searched.

    Attributes
    ----------
    half_width_m, half_width_rad : of the window, along x and y and in heading
    apart_m : least distance of two distinct poses
    rival : share of the best score, from which on distinct poses are returned
    answers : largest number of poses that are returned
    least : share of the highest score, below which nothing counts
    """

    half_width_m: float
    half_width_rad: float
    apart_m: float
    rival: float
    answers: int
    least: float = 0.0


@dataclass(frozen=True, slots=True)
class Seed:
    """The pose of a window that scores best.

    Attributes
    ----------
    T_target_source : (3, 3), to within a cell
    share : of the highest score that the points could have, 0 where no pose reached the least asked for
    rival : share of the best pose elsewhere, a meter or a tenth of a radian away; 0 below 0.8 of the best
    """

    T_target_source: Pose
    share: float
    rival: float


class ScoreGrid:
    """Points of the plane as a grid in which any pose of a scan is scored at once (Olson 2009).

    A point of the scan scores fully in a cell that holds one of these points and half in one beside it.
    """

    def __init__(self, points: Points, resolution_m: float, extent: Points | None = None) -> None:
        """Draw points (V, 2) into cells of that edge length.

        extent : (E, 2) what the grid reaches over; the points alone where left out
        """
        self.resolution_m = resolution_m
        reached = points if extent is None else extent
        corners = (reached.min(axis=0), reached.max(axis=0)) if len(reached) else (np.zeros(2), np.zeros(2))
        self.origin_m = corners[0] - resolution_m * (2**_TOP + 1)
        columns, rows = np.ceil((corners[1] - self.origin_m) / resolution_m).astype(int) + 2
        self.pyramid = np.zeros((_TOP + 1, rows, columns), np.uint8)
        draw_hits(points, self.origin_m, resolution_m, self.pyramid[0])
        fill_pyramid(self.pyramid)

    def search(self, points: Points, T_first: Pose, window: Window) -> NDArray[np.float64]:
        """The best poses of a window around the first one: (A, 4) of x, y, yaw and share, the best first.

        Turns are tried in steps that move a point (N, 2) at the median range by one cell.
        """
        range_m = max(float(np.median(np.hypot(points[:, 0], points[:, 1]))), self.resolution_m)
        turn_rad = self.resolution_m / range_m
        shifts = math.ceil(window.half_width_m / self.resolution_m)
        turns = math.ceil(min(window.half_width_rad, math.pi) / turn_rad)
        return search(
            self.pyramid, self.origin_m, self.resolution_m, points, T_first, shifts, turns, turn_rad,
            window.least, window.apart_m, window.rival, window.answers,
        )  # fmt: skip


class CorrelativeMap:
    """The surfaces of a planar voxel map, as a grid with cells as large as voxels."""

    def __init__(self, target: VoxelMap, center: Pose, radius_m: float = math.inf) -> None:
        """center, radius_m : the part of the map that is taken."""
        means = target.points()
        means = means[np.abs(means - center[:2, 2]).max(axis=1, initial=0.0) <= radius_m]
        self.grid = ScoreGrid(means, target.voxels.size_m)

    def best(
        self, points: Points, T_first: Pose, *, half_width_m: float, half_width_rad: float, least: float = 0.0
    ) -> Seed:
        """The best pose within a window around the first one: points (N, 2) meters, lidar frame.

        least : share of the highest score, below which nothing counts
        """
        window = Window(half_width_m, half_width_rad, _APART_M, _RIVAL, answers=2, least=least)
        found = self.search(points, T_first, window)
        if not len(found):
            return Seed(T_first, 0.0, 0.0)
        x_m, y_m, yaw_rad, share = found[0].tolist()
        return Seed(lie.pose_2d(x_m, y_m, yaw_rad), share, found[1, 3] if len(found) > 1 else 0.0)

    def search(self, points: Points, T_first: Pose, window: Window) -> NDArray[np.float64]:
        """The best poses of a window around the first one, as those of ``ScoreGrid.search``."""
        return self.grid.search(evenly(downsample(points, self.grid.resolution_m), _POINTS), T_first, window)


def evenly(points: Points, most: int) -> Points:
    """At most so many of the points (N, d), at even steps."""
    return np.ascontiguousarray(points[:: max(math.ceil(len(points) / most), 1)])
