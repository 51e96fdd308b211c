"""A running mean of points per voxel, in an open-addressing table."""

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.voxels.hashing import REACH, find, key_of

_LARGEST = 1e300  # m²; keeps points at infinity out where the range has no limit


@njit(nogil=True)
def add_points(T, points, max_range_m, voxel_m, center, slots, cells, sums, counts, used):
    """Move points by a pose and add each to the sum of its voxel, until the table is full.

    center : (3,) meters, of the space in which each voxel has a key of its own; it counts as full beyond

    T : (d+1, d+1); points : (N, d) meters. slots : (S,) int64 keys and cells : (S,) int32 the row that each key
    has; sums : (C, d) meters and counts : (C,) int64, of which the first ``used`` rows are taken.
    Returns the rows taken now and the number of points done: fewer than N where rows or keys did not suffice.
    """
    d = points.shape[1]
    scale = 1.0 / voxel_m
    limit = min(max_range_m * max_range_m, _LARGEST)
    moved = np.zeros(3)
    for i in range(points.shape[0]):
        square = 0.0
        for axis in range(d):
            square += points[i, axis] * points[i, axis]
        if not square <= limit:
            continue
        for row in range(d):
            value = T[row, d]
            for axis in range(d):
                value += T[row, axis] * points[i, axis]
            moved[row] = value
        row = np.int64(-1)
        if max(abs(moved[0] - center[0]), abs(moved[1] - center[1]), abs(moved[2] - center[2])) < REACH * voxel_m:
            used, row = _row_of(moved, scale, slots, cells, counts, used)
        if row < 0:
            return used, i
        for axis in range(d):
            sums[row, axis] += moved[axis]
        counts[row] += 1
    return used, points.shape[0]


@njit(nogil=True)
def merge_voxels(old_sums, old_counts, voxel_m, slots, cells, sums, counts):
    """Put the voxels (M, d) of one table into another, empty one of the same or larger voxels; the rows taken."""
    d = old_sums.shape[1]
    scale = 1.0 / voxel_m
    mean = np.zeros(3)
    used = 0
    for i in range(old_sums.shape[0]):
        for axis in range(d):
            mean[axis] = old_sums[i, axis] / old_counts[i]
        used, row = _row_of(mean, scale, slots, cells, counts, used)
        for axis in range(d):
            sums[row, axis] += old_sums[i, axis]
        counts[row] += old_counts[i]
    return used


@njit(inline="always")
def _row_of(point, scale, slots, cells, counts, used):
    """Rows taken, and the row of the point's voxel; −1 where it is new and there is no room."""
    key = key_of(point[0], point[1], point[2], scale)
    slot = find(slots, key)
    if slot >= 0:
        return used, np.int64(cells[slot])
    if used == counts.size:
        return used, np.int64(-1)
    slots[~slot] = key
    cells[~slot] = used
    return used + 1, np.int64(used)
