"""Correlative scan matching in the plane: every pose of a grid is scored by the points it puts on the map."""

import math

import numpy as np
from numba import njit

from pipeline.kernels.hashing import find, pack


@njit(cache=True, nogil=True)
def best_of_grid(voxels, points, T, shifts: int, turns: int, turn_rad: float):
    """The pose around T, (2·shifts + 1)² shifts by (2·turns + 1) turns, with the most points in seen voxels.

    points : (N, 2) metres; T : (3, 3); a shift is one voxel, a turn ``turn_rad`` about the lidar
    Each turn is made once and its points counted on all shifts (Olson 2009). A tie goes to the pose nearest T,
    turns first. Returns x, y (m), yaw (rad) and the share of points on the map.
    """
    scale = 1.0 / voxels.size_m
    width = 2 * shifts + 1
    hits = np.empty((width, width), np.int32)
    yaw = math.atan2(T[1, 0], T[0, 0])
    best, best_distance = -1, 0.0
    best_x, best_y, best_yaw = T[0, 2], T[1, 2], yaw
    for turn in range(-turns, turns + 1):
        c, s = math.cos(yaw + turn * turn_rad), math.sin(yaw + turn * turn_rad)
        hits[:, :] = 0
        for i in range(points.shape[0]):
            ix = int(np.floor((c * points[i, 0] - s * points[i, 1] + T[0, 2]) * scale))
            iy = int(np.floor((s * points[i, 0] + c * points[i, 1] + T[1, 2]) * scale))
            for dx in range(-shifts, shifts + 1):
                for dy in range(-shifts, shifts + 1):
                    hits[dx + shifts, dy + shifts] += find(voxels.keys, pack(ix + dx, iy + dy, 0)) >= 0
        for dx in range(-shifts, shifts + 1):
            for dy in range(-shifts, shifts + 1):
                score = hits[dx + shifts, dy + shifts]
                distance = turn * turn + 1e-3 * (dx * dx + dy * dy)
                if score > best or (score == best and distance < best_distance):
                    best, best_distance = score, distance
                    best_x, best_y = T[0, 2] + dx * voxels.size_m, T[1, 2] + dy * voxels.size_m
                    best_yaw = yaw + turn * turn_rad
    return best_x, best_y, best_yaw, best / points.shape[0]
