"""The product AᵀA of a landmark problem as an arrow, banded poses with a border, and its elimination; compiled."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]
_PANEL = 16  # rows of the border that are subtracted from the corner together


@njit(cache=True)
def bandwidth(row_start: _Index, columns: _Index, split: int) -> int:
    """Most that two columns before ``split`` lie apart in one row."""
    widest = 0
    for r in range(row_start.size - 1):
        low, high = split, -1
        for q in range(row_start[r], row_start[r + 1]):
            if columns[q] < split:
                low, high = min(low, columns[q]), max(high, columns[q])
        widest = max(widest, high - low)
    return widest


@njit(cache=True)
def products(
    row_start: _Index, columns: _Index, values: _Array, b: _Array, split: int, band: _Array, border: _Array,
    corner: _Array, g: _Array,
) -> None:  # fmt: skip
    """Add up H = AᵀA, in three parts, and g = Aᵀb.

        H = [P, Bᵀ; B, C],  band[w + i − j, j] = P_ij for i ≤ j  (LAPACK's upper band of width w)

    row_start (m + 1,), columns, values : A by rows; b (m,); split : columns of the poses
    band (w + 1, split), border (split, n − split) Bᵀ, corner (n − split, n − split) C, g (n,) : zero before
    """
    w = band.shape[0] - 1
    for r in range(row_start.size - 1):
        for p in range(row_start[r], row_start[r + 1]):
            i = columns[p]
            g[i] += values[p] * b[r]
            for q in range(row_start[r], row_start[r + 1]):
                j, product = columns[q], values[p] * values[q]
                if i < split:
                    if i <= j < split:
                        band[w + i - j, j] += product
                    elif j >= split:
                        border[i, j - split] += product
                elif j >= split:
                    corner[i - split, j - split] += product


@njit(cache=True)
def eliminate(band: _Array, border: _Array, share: float) -> int:
    """Factor P = UᵀU in its band and turn the border Bᵀ into Y = U⁻ᵀ Bᵀ, row after row (Golub & Van Loan 2013, 4.3.5).

    share : a pivot at or below this share of its diagonal entry has failed
    Returns -1, or the first pivot that failed.
    """
    w = band.shape[0] - 1
    for j in range(band.shape[1]):
        first, whole = max(0, j - w), band[w, j]
        for i in range(first, j):
            total = band[w + i - j, j]
            for k in range(max(first, i - w), i):
                total -= band[w + k - i, i] * band[w + k - j, j]
            total /= band[w, i]
            band[w + i - j, j] = total
            band[w, j] -= total * total
            if total != 0.0:
                _subtract(border[j], total, border[i])
        if not band[w, j] > share * whole:
            return j
        band[w, j] = np.sqrt(band[w, j])
        _divide(border[j], band[w, j])
    return -1


@njit(cache=True)
def complement(corner: _Array, border: _Array) -> None:
    """Subtract YᵀY from the upper triangle of the corner, a few rows of Y at a time so that its rows stay near."""
    for first in range(0, border.shape[0], _PANEL):
        end = min(first + _PANEL, border.shape[0])
        for a in range(corner.shape[0]):
            row = corner[a, a:]
            for j in range(first, end):
                if border[j, a] != 0.0:
                    _subtract(row, border[j, a], border[j, a:])


@njit(cache=True)
def eliminate_corner(corner: _Array, floor: _Array) -> int:
    """Factor S = UᵀU in place, in its upper triangle; a pivot at or below its floor has failed.

    Returns -1, or the first pivot that failed.
    """
    n = corner.shape[0]
    for a in range(n):
        if not corner[a, a] > floor[a]:
            return a
        corner[a, a] = np.sqrt(corner[a, a])
        _divide(corner[a, a + 1 :], corner[a, a])
        for b in range(a + 1, n):
            if corner[a, b] != 0.0:
                _subtract(corner[b, b:], corner[a, b], corner[a, b:])
    return -1


@njit(cache=True)
def solve_corner(corner: _Array, x: _Array) -> None:
    """Solve UᵀU x = b in place, U in the upper triangle."""
    n = x.size
    for a in range(n):
        x[a] /= corner[a, a]
        _subtract(x[a + 1 :], x[a], corner[a, a + 1 :])
    for a in range(n - 1, -1, -1):
        total = x[a]
        for b in range(a + 1, n):
            total -= corner[a, b] * x[b]
        x[a] = total / corner[a, a]


@njit(cache=True)
def solve_forward(band: _Array, x: _Array) -> None:
    """Solve Uᵀ x = b in place, U in its band."""
    w = band.shape[0] - 1
    for j in range(band.shape[1]):
        for i in range(max(0, j - w), j):
            x[j] -= band[w + i - j, j] * x[i]
        x[j] /= band[w, j]


@njit(cache=True)
def solve_backward(band: _Array, x: _Array) -> None:
    """Solve U x = b in place, U in its band."""
    w = band.shape[0] - 1
    for j in range(band.shape[1] - 1, -1, -1):
        x[j] /= band[w, j]
        for i in range(max(0, j - w), j):
            x[i] -= band[w + i - j, j] * x[j]


@njit(cache=True)
def _subtract(row: _Array, factor: float, other: _Array) -> None:
    for c in range(row.size):
        row[c] -= factor * other[c]


@njit(cache=True)
def _divide(row: _Array, number: float) -> None:
    for c in range(row.size):
        row[c] /= number
