"""Maps of points: running means per voxel, and beams rasterized into an occupancy grid."""

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.voxels import REACH, find, key_of


@njit(nogil=True)
def add_points(points, sums_of, counts_of, voxel_m, center, slots, cells, sums, counts, used):
    """Add points, or means of several, to the sums of their voxels until the table is full.

    points : (N, d) meters, finite; sums_of (N, d) and counts_of (N,) of the points that each is the mean of
    center : (3,) meters, of the region in which voxel keys are unique; a point beyond counts as a full table
    slots : (S,) int64 keys and cells : (S,) int32 row of each key; sums : (C, d) meters and counts :
        (C,) int64, of which the first ``used`` rows are in use
    Returns the new number of rows in use and of points added: fewer than N where rows or keys did not suffice.
    """
    d, scale = points.shape[1], 1.0 / voxel_m
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2] if d == 3 else 0.0
        if not max(abs(x - center[0]), abs(y - center[1]), abs(z - center[2])) < REACH * voxel_m:
            return used, i
        key = key_of(x, y, z, scale)
        slot = find(slots, key)
        if slot < 0:
            if used == counts.size:
                return used, i
            slot = ~slot
            slots[slot], cells[slot] = key, used
            used += 1
        for axis in range(d):
            sums[cells[slot], axis] += sums_of[i, axis]
        counts[cells[slot]] += counts_of[i]
    return used, points.shape[0]


@njit(nogil=True)
def draw_beams(starts, ends, offsets, origin, resolution_m, first_scan, hit, miss, low, high, log_odds, drawn):
    """Add the evidence of several scans: the cells that beams cross are free, the cells they end in occupied.

    A scan counts once per cell, and an end outweighs any crossing: without that, beams that pass a wall at a
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
    """Lower every cell from (x, y) up to, not including, that of the end (Amanatides & Woo 1987); unit: cells."""
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
