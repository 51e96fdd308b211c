"""Maps of points: running means per voxel, and beams drawn into an occupancy grid."""

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.voxels import REACH, find, key_of

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


@njit(nogil=True)
def draw_beams(starts, ends, offsets, origin, resolution_m, first_scan, hit, miss, low, high, log_odds, drawn):
    """Add the evidence of several scans: the cells that beams cross are free, the cells they end in occupied.

    A scan counts once in a cell, and an end outweighs any crossing: without that, beams that pass a wall at a
    grazing angle erase it. Bayes' rule in log-odds (Moravec & Elfes 1985; Thrun, Burgard & Fox 2005, table 9.1)
    with clamping (Hornung et al. 2013, eq. 5).

    starts, ends : (N, 2) meters, world; beams of scan k are ``offsets[k]`` to ``offsets[k + 1]``
    origin : (2,) meters, outer corner of cell (0, 0); every start and end lies within the grid
    first_scan : number of the first of these scans; numbers start at 1 and never repeat
    hit, miss : log-odds added; low, high : limits of a cell
    log_odds : (rows, columns) float32, row along y, changed in place
    drawn : (rows, columns) int32, number of the last scan that counted in a cell, 0 for none, changed in place
    """
    scale = 1.0 / resolution_m
    for k in range(offsets.size - 1):
        number = first_scan + k
        for i in range(offsets[k], offsets[k + 1]):
            column = int((ends[i, 0] - origin[0]) * scale)
            row = int((ends[i, 1] - origin[1]) * scale)
            if drawn[row, column] != number:
                drawn[row, column] = number
                log_odds[row, column] = min(log_odds[row, column] + hit, high)
        for i in range(offsets[k], offsets[k + 1]):
            x, y = (starts[i, 0] - origin[0]) * scale, (starts[i, 1] - origin[1]) * scale
            end_x, end_y = (ends[i, 0] - origin[0]) * scale, (ends[i, 1] - origin[1]) * scale
            _carve(x, y, end_x, end_y, number, miss, low, log_odds, drawn)


@njit(inline="always")
def _carve(x, y, end_x, end_y, number, miss, low, log_odds, drawn):
    """Free every cell from (x, y) up to, not including, that of the end (Amanatides & Woo 1987); unit: cells."""
    column, row = int(x), int(y)
    dx, dy = end_x - x, end_y - y
    step_x, step_y = 1 if dx > 0.0 else -1, 1 if dy > 0.0 else -1
    grow_x = abs(1.0 / dx) if dx != 0.0 else np.inf
    grow_y = abs(1.0 / dy) if dy != 0.0 else np.inf
    next_x = (column + 1 - x if dx > 0.0 else x - column) * grow_x if dx != 0.0 else np.inf
    next_y = (row + 1 - y if dy > 0.0 else y - row) * grow_y if dy != 0.0 else np.inf
    for _ in range(abs(int(end_x) - column) + abs(int(end_y) - row)):
        if drawn[row, column] != number:
            drawn[row, column] = number
            log_odds[row, column] = max(log_odds[row, column] + miss, low)
        if next_x < next_y:
            next_x += grow_x
            column += step_x
        else:
            next_y += grow_y
            row += step_y
