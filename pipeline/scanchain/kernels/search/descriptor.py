"""A bird's-eye view of a local map: the occupied heights above each cell of a square."""

import numpy as np

from scanchain.kernels.compiling import njit

HEIGHTS = 64  # number of heights, one bit of a cell each


@njit(nogil=True)
def mark_heights(points, T, cell_m: float, masks):
    """Set the bit of every cube that holds a point.

    points : (N, 3) meters; T : (4, 4) moves them into the view's frame, x and y from the middle of the square, z
    from the middle of its heights. Cubes have edges of ``cell_m``.
    masks : (S, S) uint64, row along y, changed in place; points outside are left out
    """
    size = masks.shape[0]
    scale, half = 1.0 / cell_m, size // 2
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        column = int(np.floor((T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) * scale)) + half
        row = int(np.floor((T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) * scale)) + half
        bit = int(np.floor((T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]) * scale)) + HEIGHTS // 2
        if 0 <= column < size and 0 <= row < size and 0 <= bit < HEIGHTS:
            masks[row, column] |= np.uint64(1) << np.uint64(bit)


@njit(nogil=True)
def count_heights(masks, counts):
    """Fill ``counts`` (S, S) uint8 with the number of occupied heights of each cell above its lowest one."""
    for row in range(masks.shape[0]):
        for column in range(masks.shape[1]):
            mask = masks[row, column]
            count = 0
            while mask != np.uint64(0):
                mask &= mask - np.uint64(1)
                count += 1
            counts[row, column] = max(count - 1, 0)
