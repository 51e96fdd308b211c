"""Best poses of planar points in a grid of scores, by branch and bound (Hess et al. 2016).

A window is 2ʰ × 2ʰ shifts of the points under one heading: (−bound, level h, turn, column, row). Its score is at
most that of its points in level h of the grid's pyramid. The window with the highest bound is split until one of a
single shift comes first: no remaining one can beat it.
"""

import heapq
import math
from enum import IntEnum

import numpy as np

from scanchain.kernels.compiling import njit

APART_RAD = 0.1  # least angle between two distinct poses
_EARLY = 32  # points between two checks whether the rest can still reach the least score
TURNS = 3  # headings scored together: a point at the median range moves by one cell from one to the next


class Score(IntEnum):
    """Score of a point in a cell."""

    SURFACE, NEAR, UNKNOWN, FREE = 2, 1, 0, -2


@njit(nogil=True)
def score_windows(blocks, pyramid, room, has_room, spans, cells, first: int, least: float, rival: float, reached):
    """The largest windows whose bound reaches the limit, under some headings: (K, 5).

    One heading is scored in wider windows; only where it scores enough are it and its neighbors scored.

    blocks : (2ˡ, 2ˡ, rows, columns) of the best score in windows of the pyramid's last level l and one cell around
        them, by position in its 2ˡ × 2ˡ blocks: scores of one point in neighboring windows are adjacent in memory,
        and many windows are scored at once
    pyramid, room, least, rival : as in ``split_best``
    has_room : (rows, columns) whether a window contains a shift to search
    spans : (rows, 2) the first such window in each row, and one past the last
    cells : (turns, N, 2) column and row of the points without a shift, under the headings from ``first`` on
    reached : (1,) best score of a pose so far, among those in the best window of each heading; updated
    """
    level = pyramid.shape[0] - 1
    size, turns = 1 << level, cells.shape[0]
    scores = np.empty(has_room.shape, np.int16)
    windows = [(0, 0, 0, 0, 0) for _ in range(0)]
    for begin in range(0, turns, TURNS):
        end = min(begin + TURNS, turns)
        _score_heading(blocks, level, has_room, spans, cells[(begin + end - 1) // 2], scores)
        for turn in range(begin, end):
            limit = max(least, rival * reached[0])
            best, x, y = 0, 0, 0
            for row in range(scores.shape[0]):
                for column in range(spans[row, 0], spans[row, 1]):
                    if scores[row, column] >= limit:
                        bound = _score(pyramid[level], cells[turn], column * size, row * size, limit)
                        if bound >= limit:
                            windows.append((-bound, level, first + turn, column * size, row * size))
                        if bound > best:
                            best, x, y = bound, column * size, row * size
            if best > reached[0]:
                reached[0] = max(reached[0], _best_of_window(pyramid[0], room, cells[turn], y, x, size))
    return _array_of(windows)


@njit(inline="always")
def _score_heading(blocks, level: int, has_room, spans, cells, scores):
    """Score of the points in every window, under one heading: cells (N, 2). The innermost loop is vectorized."""
    size, rows, columns = 1 << level, blocks.shape[2], blocks.shape[3]
    scores[:] = 0
    for i in range(cells.shape[0]):
        x, y = cells[i, 0] >> level, cells[i, 1] >> level
        layer = blocks[cells[i, 1] & (size - 1), cells[i, 0] & (size - 1)]
        for row in range(max(0, -y), min(scores.shape[0], rows - y)):
            left = max(spans[row, 0], -x)
            count = max(min(spans[row, 1], columns - x) - left, 0)
            of_row, added = scores[row, left : left + count], layer[row + y, left + x : left + x + count]
            for column in range(count):
                of_row[column] += added[column]
    for row in range(scores.shape[0]):
        for column in range(scores.shape[1]):
            if not has_room[row, column]:
                scores[row, column] = -1


@njit(inline="always")
def _best_of_window(layer, room, cells, first_row: int, first_column: int, size: int) -> int:
    """Best score of the shifts to search in a window, 0 where there is none."""
    best = 0
    for y in range(first_row, min(first_row + size, room.shape[0])):
        for x in range(first_column, min(first_column + size, room.shape[1])):
            if room[y, x]:
                best = max(best, _score(layer, cells, x, y, best))
    return best


@njit(nogil=True)
def split_best(
    pyramid, room, cells, sorted_windows, split, windows, found, turn_rad: float, least: float, rival: float,
    apart: float, steps: int,
):  # fmt: skip
    """Split the most promising windows, at most ``steps``; returns those that may still contain a pose (K, 5).

    The search is complete once none of these and of the sorted ones is left.

    pyramid : (levels, rows, columns), level h the best score in the 2ʰ × 2ʰ cells that start at each cell
    room : (rows, columns) whether to search a shift
    cells : (turns, N, 2) as in ``score_windows``, points in random order: poor windows are rejected after a few
    sorted_windows : (K, 5) of ``score_windows``, the best first; split : (2,) number of them processed, and of
        poses found; updated
    windows : (K, 5) of the last call, a heap
    found : (A, 4) column, row, turn and score of the poses found, the best first, each ``apart`` cells or
        APART_RAD away from those before it; filled
    least : smallest score of a pose; rival : smallest score as a share of the best one
    """
    heap = [(w[0], w[1], w[2], w[3], w[4]) for w in windows]
    size = len(sorted_windows)
    for _ in range(steps):
        best = found[0, 3] if split[1] else 0.0
        limit = max(least, rival * best)
        if split[0] < size and (not len(heap) or sorted_windows[split[0], 0] < heap[0][0]):
            w = sorted_windows[split[0]]
            window = (w[0], w[1], w[2], w[3], w[4])
            split[0] += 1
        elif len(heap):
            window = heapq.heappop(heap)
        else:
            break
        negative, level, turn, x, y = window
        if -negative < limit or split[1] == found.shape[0]:
            split[0] = size
            heap.clear()
            break
        if _is_taken(found[: split[1]], level, turn, x, y, turn_rad, apart):
            continue
        if level > 0:
            _split(heap, pyramid, room, cells[turn], level - 1, turn, x, y, limit)
            continue
        found[split[1], 0], found[split[1], 1] = x, y
        found[split[1], 2], found[split[1], 3] = turn, -negative
        split[1] += 1
    return _array_of(heap)


@njit(inline="always")
def _split(heap, pyramid, room, cells, level: int, turn: int, x: int, y: int, least: float):
    """Push those of the four sub-windows of the next level whose bound reaches the least score."""
    half = 1 << level
    for far_y in (y, y + half):
        for far_x in (x, x + half):
            if far_y >= room.shape[0] or far_x >= room.shape[1] or (level == 0 and not room[far_y, far_x]):
                continue
            bound = _score(pyramid[level], cells, far_x, far_y, least)
            if bound >= least:
                heapq.heappush(heap, (-bound, level, turn, far_x, far_y))


@njit(inline="always")
def _array_of(windows):
    result = np.empty((len(windows), 5), np.int64)
    for k, window in enumerate(windows):
        for part, value in enumerate(window):
            result[k, part] = value
    return result


@njit(inline="always")
def _is_taken(found, level: int, turn: int, x: int, y: int, turn_rad: float, apart: float) -> bool:
    """True if a window lies near one of the (A, 4) poses that were found."""
    size = (1 << level) - 1
    for a in range(found.shape[0]):
        fx, fy = found[a, 0], found[a, 1]
        away = max(abs(x - fx), abs(x + size - fx), abs(y - fy), abs(y + size - fy))
        turned_rad = abs(turn - found[a, 2]) * turn_rad
        if min(turned_rad, 2.0 * math.pi - turned_rad) < APART_RAD and away < apart:
            return True
    return False


@njit(inline="always")
def _score(layer, cells, x: int, y: int, least: float) -> int:
    """Score in a layer of the points shifted by (x, y) cells; aborted once the rest cannot reach the least."""
    count = cells.shape[0]
    total = 0
    for i in range(count):
        column, row = cells[i, 0] + x, cells[i, 1] + y
        if 0 <= row < layer.shape[0] and 0 <= column < layer.shape[1]:
            total += layer[row, column]
        if i % _EARLY == _EARLY - 1 and total + Score.SURFACE * (count - 1 - i) < least:
            return Score.SURFACE * -count - 1
    return total


@njit(nogil=True)
def climb(cells, points, origin, resolution_m: float, pose, step_rad: float):
    """Move a pose (x, y, yaw), in place, to a local maximum of its points' mean score, which is returned.

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


@njit(inline="always")
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
