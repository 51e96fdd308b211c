"""Beams drawn into an occupancy grid up to their ends."""

import numpy as np

from scanchain.kernels.compiling import njit

_LARGEST = 1e300  # m²; keeps points at infinity out where the range has no limit


@njit(nogil=True)
def beams_in_slice(T, points, max_range_m, min_z_m, max_z_m, starts, ends):
    """Fill ``starts`` and ``ends`` (N, 2) with the part of each beam that lies in a horizontal slice.

    A beam runs straight from the lidar, which is at height 0 of the slice's own scale, to its return at height z.
    Returns outside the slice or the usable range are left out. Where the slice does not hold the lidar's height,
    a beam starts where it enters the slice: at the share limit / z of its length.

    T : (d+1, d+1) pose of the lidar; points : (N, d) meters, lidar frame; starts, ends : (N, 2) meters, world.
    In 2D every return is in the slice. Returns how many beams were kept.
    """
    d = points.shape[1]
    limit = min(max_range_m * max_range_m, _LARGEST)
    count = 0
    for i in range(points.shape[0]):
        px, py = points[i, 0], points[i, 1]
        pz = points[i, 2] if d == 3 else 0.0
        if not px * px + py * py + pz * pz <= limit:
            continue
        dx = T[0, 0] * px + T[0, 1] * py
        dy = T[1, 0] * px + T[1, 1] * py
        share = 0.0
        if d == 3:
            dx += T[0, 2] * pz
            dy += T[1, 2] * pz
            dz = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz
            if not min_z_m <= dz <= max_z_m:
                continue
            if min_z_m > 0.0:
                share = min_z_m / dz
            elif max_z_m < 0.0:
                share = max_z_m / dz
        starts[count, 0] = T[0, d] + share * dx
        starts[count, 1] = T[1, d] + share * dy
        ends[count, 0] = T[0, d] + dx
        ends[count, 1] = T[1, d] + dy
        count += 1
    return count


@njit(nogil=True)
def bounds(points, out):
    """Widen ``out`` (4,), min x, min y, max x, max y, to hold the points (N, 2)."""
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        out[0], out[1] = min(out[0], x), min(out[1], y)
        out[2], out[3] = max(out[2], x), max(out[3], y)


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
            _carve(
                (starts[i, 0] - origin[0]) * scale,
                (starts[i, 1] - origin[1]) * scale,
                (ends[i, 0] - origin[0]) * scale,
                (ends[i, 1] - origin[1]) * scale,
                number, miss, low, log_odds, drawn,
            )  # fmt: skip


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
