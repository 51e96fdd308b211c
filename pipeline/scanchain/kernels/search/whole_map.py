"""Pose of planar points in a whole map of surfaces and free space, by branch and bound (Hess et al. 2016)."""

import heapq
import math

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.search.branch_and_bound import APART_RAD

SURFACE, NEAR, UNKNOWN, FREE = 2, 1, 0, -2  # score of a point in a cell
_EARLY = 32  # points between two tests whether the rest can still reach the least score


@njit(nogil=True)
def score_cells(log_odds, limit: float, cells):
    """Score of a point in each cell: a surface, beside one, free, or unknown.

    log_odds : (rows, columns) of occupancy; limit : from which on, and below minus which, a cell is certain
    cells : (rows, columns) int8, filled; the outermost cells are not near any surface
    """
    rows, columns = log_odds.shape
    for row in range(rows):
        for column in range(columns):
            cells[row, column] = FREE if log_odds[row, column] < -limit else UNKNOWN
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            if log_odds[row, column] > limit:
                for r in range(row - 1, row + 2):
                    for c in range(column - 1, column + 2):
                        cells[r, c] = max(cells[r, c], NEAR)
                cells[row, column] = SURFACE


@njit(nogil=True)
def interleave(layer, level: int):
    """Cells (2ˡ, 2ˡ, rows, columns) of a layer at level l, by their place in its 2ˡ × 2ˡ blocks.

    Points of one scan in neighboring windows then lie side by side, and many windows are scored at once.
    """
    size = 1 << level
    rows, columns = (layer.shape[0] + size - 1) // size, (layer.shape[1] + size - 1) // size
    blocks = np.zeros((size, size, rows, columns), layer.dtype)
    for row in range(layer.shape[0]):
        for column in range(layer.shape[1]):
            blocks[row % size, column % size, row // size, column // size] = layer[row, column]
    return blocks


@njit(nogil=True)
def find_room(cells, level: int, spans):
    """Windows (rows, columns) of 2ˡ × 2ˡ cells with room for the lidar; spans (rows, 2): first, past the last."""
    size = 1 << level
    rows, columns = spans.shape[0], (cells.shape[1] + size - 1) // size
    has_room = np.zeros((rows, columns), np.bool_)
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            if _is_room(cells[row, column]):
                has_room[row // size, column // size] = True
    for row in range(rows):
        spans[row, 0], spans[row, 1] = columns, 0
        for column in range(columns):
            if has_room[row, column]:
                spans[row, 0], spans[row, 1] = min(spans[row, 0], column), column + 1
    return has_room


@njit(nogil=True)
def score_windows(blocks, level: int, has_room, spans, cells, first: int, least: float):
    """Windows with room that score at least so much under some headings: (K, 5) −bound, level, turn, column, row.

    blocks : of ``interleave``; has_room, spans : of ``find_room``
    cells : (turns, N, 2) of ``turned``, the headings from ``first`` on
    """
    size, rows = 1 << level, blocks.shape[2]
    scores = np.empty(blocks.shape[2:], np.int16)
    windows = [(0, 0, 0, 0, 0) for _ in range(0)]
    for turn in range(cells.shape[0]):
        _score_heading(blocks, level, spans, cells[turn], scores)
        for row in range(rows):
            for column in range(spans[row, 0], spans[row, 1]):
                if has_room[row, column] and scores[row, column] >= least:
                    bound = int(scores[row, column])
                    windows.append((-bound, level, first + turn, column * size, row * size))
    result = np.empty((len(windows), 5), np.int64)
    for k, window in enumerate(windows):
        for part, value in enumerate(window):
            result[k, part] = value
    return result


@njit(nogil=True)
def _score_heading(blocks, level: int, spans, cells, scores):
    """Score of the points in every window, under one heading: cells (N, 2). The innermost loop is vectorized."""
    size, rows, columns = 1 << level, blocks.shape[2], blocks.shape[3]
    scores[:] = 0
    for i in range(cells.shape[0]):
        x, y = cells[i, 0] >> level, cells[i, 1] >> level
        layer = blocks[cells[i, 1] & (size - 1), cells[i, 0] & (size - 1)]
        for row in range(max(0, -y), min(rows, rows - y)):
            left = max(spans[row, 0], -x)
            count = min(spans[row, 1], columns - x) - left
            of_row, added = scores[row, left : left + count], layer[row + y, left + x : left + x + count]
            for column in range(count):
                of_row[column] += added[column]


@njit(nogil=True)
def best_poses(
    pyramid, cells, windows, resolution_m: float, least: float, rival: float, apart_m: float, answers: int
):
    """The best-scoring poses with the lidar in a free cell, each apart from the others, the best first.

    As ``branch_and_bound.search``, from windows (K, 5) of ``score_windows``. A window of 2ʰ × 2ʰ cells scores at
    most what its points find in level h.

    pyramid : of ``fill_pyramid`` over ``score_cells``, whose border is unknown
    cells : (turns, N, 2) of ``turned``, points in random order: poor windows are given up after the first of them
    least : score below which nothing counts; rival : share of the best score, likewise
    Returns (A ≤ answers, 4): column, row, turn, score.
    """
    heap = [(w[0], w[1], w[2], w[3], w[4]) for w in windows]
    heapq.heapify(heap)
    found, count, best = np.empty((answers, 4)), 0, 0
    while len(heap) and count < answers:
        negative, level, turn, x, y = heapq.heappop(heap)
        if -negative < rival * best:
            break
        if _is_taken(found[:count], level, turn, x, y, resolution_m, cells.shape[0], apart_m):
            continue
        if level == 0:
            best = max(best, -negative)
            found[count, 0], found[count, 1], found[count, 2], found[count, 3] = x, y, turn, -negative
            count += 1
        else:
            _split(heap, pyramid, cells[turn], level - 1, turn, x, y, max(least, rival * best))
    return found[:count]


@njit(nogil=True)
def _split(heap, pyramid, cells, level: int, turn: int, x: int, y: int, least: float):
    """Push those of the four windows of the next level that make up one which reach the least score."""
    half = 1 << level
    for far_y in (y, y + half):
        for far_x in (x, x + half):
            if far_y >= pyramid.shape[1] or far_x >= pyramid.shape[2]:
                continue
            if level == 0 and not _is_room(pyramid[0, far_y, far_x]):
                continue
            bound = _score(pyramid[level], cells, far_x, far_y, least)
            if bound >= least:
                heapq.heappush(heap, (-bound, level, turn, far_x, far_y))


@njit(nogil=True)
def climb(cells, points, origin, resolution_m: float, pose, step_rad: float):
    """Move a pose (x, y, yaw), in place, uphill on the score of its points; returns their mean score.

    Steps are half a cell and ``step_rad``, then half as large.
    """
    best = _mean_score(cells, points, origin, resolution_m, pose[0], pose[1], pose[2])
    for halving in range(2):
        step_m, turn_rad = 0.5 * resolution_m / (1 << halving), step_rad / (1 << halving)
        for _ in range(8):
            x, y, yaw, before = pose[0], pose[1], pose[2], best
            for a in range(-1, 2):
                for b in range(-1, 2):
                    for c in range(-1, 2):
                        moved = x + a * step_m, y + b * step_m, yaw + c * turn_rad
                        score = _mean_score(cells, points, origin, resolution_m, moved[0], moved[1], moved[2])
                        if score > best:
                            best, pose[0], pose[1], pose[2] = score, moved[0], moved[1], moved[2]
            if best <= before:
                break
    return best


@njit(nogil=True)
def _mean_score(cells, points, origin, resolution_m: float, x: float, y: float, yaw: float) -> float:
    c, s = math.cos(yaw) / resolution_m, math.sin(yaw) / resolution_m
    left, low = (x - origin[0]) / resolution_m, (y - origin[1]) / resolution_m
    total = 0
    for i in range(points.shape[0]):
        column = math.floor(c * points[i, 0] - s * points[i, 1] + left)
        row = math.floor(s * points[i, 0] + c * points[i, 1] + low)
        if 0 <= row < cells.shape[0] and 0 <= column < cells.shape[1]:
            total += cells[row, column]
    return total / points.shape[0]


@njit(nogil=True)
def turned(points, resolution_m: float, turns: int):
    """Column and row (turns, N, 2) of points (N, 2), m, from the lidar's cell under headings 2π / turns apart."""
    cells = np.empty((turns, points.shape[0], 2), np.int32)
    for turn in range(turns):
        angle = 2.0 * math.pi * turn / turns
        c, s = math.cos(angle) / resolution_m, math.sin(angle) / resolution_m
        for i in range(points.shape[0]):
            cells[turn, i, 0] = math.floor(c * points[i, 0] - s * points[i, 1] + 0.5)
            cells[turn, i, 1] = math.floor(s * points[i, 0] + c * points[i, 1] + 0.5)
    return cells


@njit(inline="always")
def _is_room(cell: int) -> bool:
    """True for a cell that the lidar can be in."""
    return cell in (FREE, NEAR)


@njit(inline="always")
def _is_taken(
    found, level: int, turn: int, x: int, y: int, resolution_m: float, turns: int, apart_m: float
) -> bool:
    """True if a window lies near one of the (A, 4) poses that were found."""
    size = (1 << level) - 1
    for a in range(found.shape[0]):
        fx, fy = found[a, 0], found[a, 1]
        away = max(abs(x - fx), abs(x + size - fx), abs(y - fy), abs(y + size - fy))
        apart = abs(turn - found[a, 2])
        apart_rad = min(apart, turns - apart) * 2.0 * math.pi / turns
        if apart_rad < APART_RAD and away * resolution_m < apart_m:
            return True
    return False


@njit(inline="always")
def _score(layer, cells, x: int, y: int, least: float) -> int:
    """Score of the points around a cell in a layer; given up once the rest cannot reach the least."""
    count = cells.shape[0]
    total = 0
    for i in range(count):
        column, row = cells[i, 0] + x, cells[i, 1] + y
        if 0 <= row < layer.shape[0] and 0 <= column < layer.shape[1]:
            total += layer[row, column]
        if i % _EARLY == _EARLY - 1 and total + SURFACE * (count - 1 - i) < least:
            return SURFACE * -count - 1
    return total
