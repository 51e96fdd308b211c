"""Slow, clear twins of the kernels of correlative search."""

import numpy as np

from scanchain import lie


def hits(means, origin, resolution_m, shape):
    """2 in cells with a surface point, 1 in those around them."""
    grid = np.zeros(shape, int)
    cells = [tuple(np.floor((mean[1::-1] - origin[::-1]) / resolution_m).astype(int)) for mean in means]
    for row, column in cells:
        grid[row - 1 : row + 2, column - 1 : column + 2] = 1
    for cell in cells:
        grid[cell] = 2
    return grid


def windows(grid, size):
    """The largest value among the size × size cells that start at each cell."""
    padded = np.pad(grid, ((0, size - 1), (0, size - 1)))
    return np.max(
        [padded[r : r + grid.shape[0], c : c + grid.shape[1]] for r in range(size) for c in range(size)], axis=0
    )


def scores(grid, origin, resolution_m, points, T, shifts, turns, turn_rad):
    """Share of the highest score of every pose of the window, by (turn, shift along x, along y)."""
    result = {}
    for turn in range(-turns, turns + 1):
        rotated = lie.transform(lie.pose_2d(T[0, 2], T[1, 2], float(lie.yaw(T)) + turn * turn_rad), points)
        cells = np.floor((rotated - origin) / resolution_m).astype(int)
        for dx in range(-shifts, shifts + 1):
            for dy in range(-shifts, shifts + 1):
                column, row = cells[:, 0] + dx, cells[:, 1] + dy
                inside = (row >= 0) & (row < grid.shape[0]) & (column >= 0) & (column < grid.shape[1])
                result[turn, dx, dy] = grid[row[inside], column[inside]].sum() / (2 * len(points))
    return result
