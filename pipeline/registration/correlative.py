"""A seed for matching in the plane that no basin of attraction limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scanchain import lie
from scanchain.data import Points, Pose
from scanchain.kernels.search.branch_and_bound import draw_hits, fill_pyramid, search
from scanchain.preprocess.sweep import downsample
from scanchain.registration.voxel_map import VoxelMap

_POINTS = 120  # of the scan that are scored, one a voxel, evenly spread
_TOP = 5  # levels of the pyramid above the grid itself; windows start with 2⁵ cells


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


class CorrelativeMap:
    """The surfaces of a planar voxel map, as a grid in which any pose of a scan is scored at once (Olson 2009).

    A point scores fully in a cell with a surface and half in one beside it; cells are as large as voxels.
    """

    def __init__(self, target: VoxelMap, center: Pose, radius_m: float = math.inf) -> None:
        """center, radius_m : the part of the map that is taken."""
        means = target.points()
        means = means[np.abs(means - center[:2, 2]).max(axis=1, initial=0.0) <= radius_m]
        self.resolution_m = target.voxels.size_m
        corners = (means.min(axis=0), means.max(axis=0)) if len(means) else (np.zeros(2), np.zeros(2))
        self.origin_m = corners[0] - self.resolution_m * (2**_TOP + 1)
        columns, rows = np.ceil((corners[1] - self.origin_m) / self.resolution_m).astype(int) + 2
        self.pyramid = np.zeros((_TOP + 1, rows, columns), np.uint8)
        draw_hits(means, self.origin_m, self.resolution_m, self.pyramid[0])
        fill_pyramid(self.pyramid)

    def best(
        self, points: Points, T_first: Pose, *, half_width_m: float, half_width_rad: float, least: float = 0.0
    ) -> Seed:
        """The best pose within a window around the first one: points (N, 2) meters, lidar frame.

        Turns are tried in steps that move a point at the scan's median range by one cell.
        least : share of the highest score, below which nothing counts
        """
        some = downsample(points, self.resolution_m)
        some = np.ascontiguousarray(some[:: max(math.ceil(len(some) / _POINTS), 1)])
        range_m = max(float(np.median(np.hypot(some[:, 0], some[:, 1]))), self.resolution_m)
        turn_rad = self.resolution_m / range_m
        shifts = math.ceil(half_width_m / self.resolution_m)
        turns = math.ceil(min(half_width_rad, math.pi) / turn_rad)
        x_m, y_m, yaw_rad, share, rival = search(
            self.pyramid, self.origin_m, self.resolution_m, some, T_first, shifts, turns, turn_rad, least
        )
        return Seed(lie.pose_2d(x_m, y_m, yaw_rad) if share >= 0.0 else T_first, max(share, 0.0), rival)
