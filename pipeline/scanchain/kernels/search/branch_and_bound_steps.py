"""The search of ``branch_and_bound`` near given places only, in steps of bounded work."""

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.search.branch_and_bound import HIT, is_taken

LEVEL, TURN, COLUMN, ROW, NEXT = range(5)  # of a window; the next one of the same bound, or of those not in use
BEST, LIVE, FREE, USED, FOUND = range(5)  # of a queue: highest bound, windows, first unused row, rows, poses found

_EARLY = 16  # points between two tests whether the rest can still reach the least score


@njit(nogil=True)
def mark_places(positions, origin, resolution_m: float, reach_m: float, grid):
    """Set the cells of ``grid`` (rows, columns) uint8 to 1 whose middle is within reach of a position (K, 2)."""
    reach = int(np.ceil(reach_m / resolution_m))
    for k in range(positions.shape[0]):
        x, y = (positions[k, 0] - origin[0]) / resolution_m, (positions[k, 1] - origin[1]) / resolution_m
        for row in range(max(int(y) - reach, 0), min(int(y) + reach + 1, grid.shape[0])):
            for column in range(max(int(x) - reach, 0), min(int(x) + reach + 1, grid.shape[1])):
                away = (column + 0.5 - x) ** 2 + (row + 0.5 - y) ** 2
                if away * resolution_m**2 <= reach_m**2:
                    grid[row, column] = 1


@njit(nogil=True)
def queue_of_all(layers, places, offsets, boxes, least: int, most: int):
    """The largest windows with a place in them and a bound of ``least``, ``most`` at most, in a queue.

    A queue is three arrays: windows (M, 5), the first window (most + 1,) of each bound, and what it holds (5,).

    layers : (levels, rows · columns) of ``fill_pyramid`` over the surfaces
    places : (levels, rows, columns), likewise over the cells that the lidar may be in, from which all points lie
        within the grid
    offsets : (turns, N) of the cells of the points from that of the lidar, along the rows of a layer
    boxes : (turns, 5) as in ``_score``
    """
    windows, heads, held = np.empty((1024, 5), np.int64), np.full(most + 1, -1), np.zeros(5, np.int64)
    held[FREE], held[BEST] = -1, most
    top = layers.shape[0] - 1
    for column in range(0, places.shape[2], 1 << top):
        for row in range(0, places.shape[1], 1 << top):
            if places[top, row, column]:
                for turn in range(offsets.shape[0]):
                    bound = _score(layers[top], offsets[turn], boxes[turn], column, row, least)
                    if bound >= least:
                        windows = _push(windows, heads, held, bound, top, turn, column, row)
    return windows, heads, held


@njit(nogil=True)
def split_best(
    layers, places, offsets, boxes, windows, heads, held, found, steps: int, resolution_m: float,
    turn_rad: float, least: int, apart_m: float, rival: float,
):  # fmt: skip
    """Split the most promising windows of a queue, at most so many; the windows, and the number that were split.

    The search is over once ``held[LIVE]`` is 0. Of windows of one bound the last one comes first.

    found : (A, 4) poses found: score, turn, column and row of the lidar's cell; filled, the best first
    """
    taken = 0
    while held[LIVE] > 0 and taken < steps:
        while heads[held[BEST]] < 0:
            held[BEST] -= 1
        bound, count = held[BEST], held[FOUND]
        best = found[0, 0] if count else 0
        if count == found.shape[0] or bound < rival * best:
            held[LIVE] = 0
            break
        level, turn, column, row = _pop(windows, heads, held)
        if is_taken(found[:count, 1:], level, turn, column, row, resolution_m, turn_rad, apart_m):
            continue
        taken += 1
        if level == 0:
            found[count, 0], found[count, 1], found[count, 2], found[count, 3] = bound, turn, column, row
            held[FOUND] += 1
            continue
        limit, half = max(least, int(np.ceil(rival * best))), 1 << (level - 1)
        for x in (column, column + half):
            for y in (row, row + half):
                if x < places.shape[2] and y < places.shape[1] and places[level - 1, y, x]:
                    score = _score(layers[level - 1], offsets[turn], boxes[turn], x, y, limit)
                    if score >= limit:
                        windows = _push(windows, heads, held, score, level - 1, turn, x, y)
    return windows, taken


@njit(nogil=True)
def _push(windows, heads, held, bound: int, level: int, turn: int, column: int, row: int):
    """Put a window into a queue; its array of windows, a larger one where it was full."""
    slot = held[FREE]
    if slot >= 0:
        held[FREE] = windows[slot, NEXT]
    else:
        slot = held[USED]
        held[USED] += 1
        if slot == windows.shape[0]:
            larger = np.empty((2 * slot, 5), np.int64)
            larger[:slot] = windows
            windows = larger
    windows[slot, LEVEL], windows[slot, TURN] = level, turn
    windows[slot, COLUMN], windows[slot, ROW], windows[slot, NEXT] = column, row, heads[bound]
    heads[bound] = slot
    held[LIVE] += 1
    return windows


@njit(inline="always")
def _pop(windows, heads, held):
    """Level, turn, column and row of the last window with the highest bound, which leaves the queue."""
    slot = heads[held[BEST]]
    heads[held[BEST]] = windows[slot, NEXT]
    windows[slot, NEXT] = held[FREE]
    held[FREE] = slot
    held[LIVE] -= 1
    return windows[slot, LEVEL], windows[slot, TURN], windows[slot, COLUMN], windows[slot, ROW]


@njit(inline="always")
def _score(layer, offsets, box, x: int, y: int, least: int) -> int:
    """Score of the points with the lidar in a cell; −1 where it cannot reach the least, or a point lies outside.

    layer : (rows, columns) as one row; box : least and largest column and row of the points, columns of the layer
    """
    count, columns = offsets.shape[0], box[4]
    if x + box[0] < 0 or x + box[1] >= columns or y + box[2] < 0 or (y + box[3] + 1) * columns > layer.shape[0]:
        return -1
    here = y * columns + x
    total = 0
    for i in range(count):
        if i % _EARLY == 0 and total + HIT * (count - i) < least:
            return -1
        total += layer[here + offsets[i]]
    return total
