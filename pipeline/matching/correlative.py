"""A seed for matching in the plane that no basin of attraction limits."""

from __future__ import annotations

import math

import numpy as np

from pipeline import lie
from pipeline.data import Points, Pose
from pipeline.kernels.correlative import best_of_grid
from pipeline.matching.voxel_map import VoxelMap

_POINTS = 90  # of the scan that are scored, evenly spread over its beams


def correlative_seed(
    points: Points, target: VoxelMap, T_predicted: Pose, *, half_width_m: float, half_width_rad: float
) -> Pose:
    """The pose of a grid around the prediction that puts most points into seen voxels (Olson 2009).

    points : (N, 2) metres, lidar frame; the grid's steps are a voxel, and the turn that moves a point at the
    scan's median range by one voxel.
    """
    some = np.ascontiguousarray(points[:: max(len(points) // _POINTS, 1)])
    voxel_m = target.config.voxel_size_m
    range_m = max(float(np.median(np.hypot(some[:, 0], some[:, 1]))), voxel_m)
    turn_rad = voxel_m / range_m
    shifts, turns = math.ceil(half_width_m / voxel_m), math.ceil(half_width_rad / turn_rad)
    x_m, y_m, yaw_rad, _ = best_of_grid(target.voxels, some, T_predicted, shifts, turns, turn_rad)
    return lie.pose_2d(x_m, y_m, yaw_rad)
