"""Correlative scan matching in the plane, exact over a wide window, by branch and bound (Hess et al. 2016)."""

import heapq
import math

import numpy as np

from scanchain.kernels.compiling import njit

HIT, NEAR = 2, 1  # score of a point in a cell with a surface, and in one beside it
APART_RAD = 0.1  # least angle between two distinct poses


@njit(nogil=True)
def draw_hits(means, origin, resolution_m: float, grid):
    """Score HIT where a surface point lies, NEAR in the eight cells around it.

    means : (V, ≥ 2) meters; origin : (2,) corner of cell (0, 0); grid : (rows, columns) uint8, row along y
    Every mean lies within the grid, a cell or more from its border.
    """
    for v in range(means.shape[0]):
        column = int((means[v, 0] - origin[0]) / resolution_m)
        row = int((means[v, 1] - origin[1]) / resolution_m)
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                grid[row + dr, column + dc] = max(grid[row + dr, column + dc], NEAR)
        grid[row, column] = HIT


@njit(nogil=True)
def fill_pyramid(pyramid):
    """Fill level h of (levels, rows, columns) with the best score in the 2ʰ × 2ʰ cells that start at each cell."""
    levels, rows, columns = pyramid.shape
    for h in range(1, levels):
        half = 1 << (h - 1)
        for row in range(rows):
            far_row = row + half
            for column in range(columns):
                best = pyramid[h - 1, row, column]
                far_column = column + half
                if far_column < columns:
                    best = max(best, pyramid[h - 1, row, far_column])
                if far_row < rows:
                    best = max(best, pyramid[h - 1, far_row, column])
                    if far_column < columns:
                        best = max(best, pyramid[h - 1, far_row, far_column])
                pyramid[h, row, column] = best


@njit(nogil=True)
def search(
    pyramid, origin, resolution_m: float, points, T, shifts: int, turns: int, turn_rad: float, least: float,
    apart_m: float, rival: float, answers: int,
):  # fmt: skip
    """The best-scoring poses around T, within so many shifts of a cell and turns, each apart from the others.

    A window of 2ʰ × 2ʰ shifts scores at most what its points find in level h, so the window with the highest
    bound is split until one of a single shift comes first: nothing that is left can beat it. The search goes on
    to the best pose elsewhere, ``apart_m`` or APART_RAD away from those found, with at least the share ``rival``
    of the best score.

    pyramid : of ``fill_pyramid``; its first 2ᵗᵒᵖ − 1 rows and columns are empty
    points : (N, 2) meters, lidar frame; T : (3, 3)
    least : share of the highest score possible, below which nothing counts
    Returns (A ≤ answers, 4), the best first: x, y (m), yaw, share of the highest score possible.
    """
    full = HIT * points.shape[0]
    cells = turned_cells(points, T, origin, resolution_m, turns, turn_rad)
    heap = _roots(pyramid, cells, shifts, least * full)
    found, count = np.empty((answers, 4)), 0
    taken = np.empty((answers, 3), np.int64)
    best = 0
    while len(heap) and count < answers:
        negative, level, turn, dx, dy = heapq.heappop(heap)
        if -negative < rival * best:
            break
        if is_taken(taken[:count], level, turn, dx, dy, resolution_m, turn_rad, apart_m):
            continue
        if level > 0:
            _split(heap, pyramid[level - 1], cells[turn], level - 1, turn, dx, dy, shifts, least * full)
            continue
        best = max(best, -negative)
        taken[count, 0], taken[count, 1], taken[count, 2] = turn, dx, dy
        found[count, 0], found[count, 1] = T[0, 2] + dx * resolution_m, T[1, 2] + dy * resolution_m
        found[count, 2] = math.atan2(T[1, 0], T[0, 0]) + (turn - turns) * turn_rad
        found[count, 3] = -negative / full
        count += 1
    return found[:count]


@njit(inline="always")
def is_taken(
    taken, level: int, turn: int, dx: int, dy: int, resolution_m: float, turn_rad: float, apart_m: float
) -> bool:
    """True if a window lies near one of the (A, 3) turns and shifts that were found."""
    size = (1 << level) - 1
    for a in range(taken.shape[0]):
        x, y = taken[a, 1], taken[a, 2]
        away = max(abs(dx - x), abs(dx + size - x), abs(dy - y), abs(dy + size - y))
        if abs(turn - taken[a, 0]) * turn_rad < APART_RAD and away * resolution_m < apart_m:
            return True
    return False


@njit(nogil=True)
def turned_cells(points, T, origin, resolution_m: float, turns: int, turn_rad: float):
    """Column and row (2·turns + 1, N, 2) of every point under every turn of T."""
    yaw = math.atan2(T[1, 0], T[0, 0])
    cells = np.empty((2 * turns + 1, points.shape[0], 2), np.int32)
    for turn in range(2 * turns + 1):
        angle = yaw + (turn - turns) * turn_rad
        c, s = math.cos(angle), math.sin(angle)
        for i in range(points.shape[0]):
            x = c * points[i, 0] - s * points[i, 1] + T[0, 2] - origin[0]
            y = s * points[i, 0] + c * points[i, 1] + T[1, 2] - origin[1]
            cells[turn, i, 0] = math.floor(x / resolution_m)
            cells[turn, i, 1] = math.floor(y / resolution_m)
    return cells


@njit(nogil=True)
def _roots(pyramid, cells, shifts: int, least: float):
    """Heap of the largest windows: (−bound, level, turn, first shift along x, along y)."""
    top = pyramid.shape[0] - 1
    heap = [(0, 0, 0, 0, 0) for _ in range(0)]
    for turn in range(cells.shape[0]):
        for dx in range(-shifts, shifts + 1, 1 << top):
            for dy in range(-shifts, shifts + 1, 1 << top):
                bound = score(pyramid[top], cells[turn], dx, dy)
                if bound >= least:
                    heap.append((-bound, top, turn, dx, dy))
    heapq.heapify(heap)
    return heap


@njit(nogil=True)
def _split(heap, layer, cells, level: int, turn: int, dx: int, dy: int, shifts: int, least: float):
    """Push the four windows of the next level that make up one."""
    half = 1 << level
    for x in (dx, dx + half):
        for y in (dy, dy + half):
            if x > shifts or y > shifts:
                continue
            bound = score(layer, cells, x, y)
            if bound >= least:
                heapq.heappush(heap, (-bound, level, turn, x, y))


@njit(inline="always")
def score(layer, cells, dx: int, dy: int) -> int:
    """Score of the points, shifted by so many cells, in a layer; 0 for cells outside."""
    total = 0
    for i in range(cells.shape[0]):
        column, row = cells[i, 0] + dx, cells[i, 1] + dy
        if 0 <= row < layer.shape[0] and 0 <= column < layer.shape[1]:
            total += layer[row, column]
    return total
