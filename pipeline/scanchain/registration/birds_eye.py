"""Seeds for matching in space: upright structure of scan and map, correlated as seen from above."""

from __future__ import annotations

import math

import numpy as np

from scanchain import lie
from scanchain.data import Matrix, Points, Pose
from scanchain.registration.correlative import ScoreGrid, Window, evenly
from scanchain.registration.voxel_map import VoxelMap

_TALL = 0.75  # voxels between the lowest and the highest point of a column, from which on it is upright structure
_POINTS = 300  # columns of the scan that are scored, evenly spread
_APART = 3.0  # least distance of two distinct poses, voxels
_RIVAL = 0.6  # share of the best score, from which on distinct poses are returned


class BirdsEye:
    """Upright structure around a pose of a voxel map in space, as a grid in the lidar's xy plane at that pose.

    A column of the grid, a voxel wide, holds upright structure where its points differ in height: walls, trunks,
    cars. The ground does not, and so it attracts no pose.
    """

    def __init__(self, target: VoxelMap, T_map_lidar: Pose, radius_m: float) -> None:
        """Draw the part of the map around the lidar, seen along its z axis."""
        self.T_map_lidar = T_map_lidar
        self.size_m = target.voxels.size_m
        means = lie.transform(lie.inverse(T_map_lidar), target.points())
        near = means[np.abs(means[:, :2]).max(axis=1, initial=0.0) <= radius_m]
        self.grid = ScoreGrid(upright_columns(near, self.size_m), self.size_m)

    def seeds(
        self, points: Points, *, half_width_m: float, half_width_rad: float, answers: int
    ) -> tuple[Matrix, ...]:
        """Poses (4, 4) in a window around that of the map, the best first: points (N, 3) meters, lidar frame."""
        columns = evenly(upright_columns(points, self.size_m), _POINTS)
        if not len(columns):
            return ()
        window = Window(half_width_m, half_width_rad, _APART * self.size_m, _RIVAL, answers)
        found = self.grid.search(columns, lie.identity(2), window)
        return tuple(
            self.T_map_lidar @ lie.lift(lie.pose_2d(x_m, y_m, yaw)) for x_m, y_m, yaw, _ in found.tolist()
        )


def upright_columns(points: Points, size_m: float) -> Points:
    """Mean (x, y) of every column (M, 2) whose points (N, 3) span more than _TALL of its width in height."""
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
