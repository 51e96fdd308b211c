"""The product H = AᵀA of a tall sparse matrix, with the structure of the product found once; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]


@njit()
def product_structure(
    row_start: _Index, columns: _Index, column_start: _Index, rows: _Index
) -> tuple[_Index, _Index, _Index]:
    """Pairs of columns that share a row, and the destination of each product of two entries of a row.

    row_start (m + 1,), columns : columns in each row, each once; column_start (n + 1,), rows : rows in each column
    Returns start (n + 1,), others, slots: pair p of column v, for start[v] ≤ p < start[v + 1], is
    (v, others[p]) with others[p] > v. ``slots`` has, row by row, a square of as many rows and columns as the
    row has entries; slots[a, b] is the place of the product of its entries a and b in a list of the n diagonal
    entries and then the pairs, -1 below the diagonal.
    """
    n = column_start.size - 1
    base = np.zeros(row_start.size, np.int64)
    for r in range(row_start.size - 1):
        base[r + 1] = base[r] + (row_start[r + 1] - row_start[r]) ** 2
    slots = np.full(base[-1], -1, np.int64)
    start, others = np.zeros(n + 1, np.int64), np.empty(max(columns.size, 16), np.int64)
    place, end = np.full(n, -1, np.int64), 0
    for v in range(n):
        if end + n > others.size:
            others = np.concatenate((others, np.empty(others.size + n, np.int64)))
        for q in range(column_start[v], column_start[v + 1]):
            r = rows[q]
            first, width = row_start[r], row_start[r + 1] - row_start[r]
            a = 0
            while columns[first + a] != v:
                a += 1
            for b in range(width):
                w = columns[first + b]
                if w > v and place[w] < start[v]:
                    place[w] = end
                    others[end] = w
                    end += 1
                if w >= v:
                    slots[base[r] + a * width + b] = v if w == v else n + place[w]
        start[v + 1] = end
    return start, others[:end].copy(), slots


@njit()
def products(
    row_start: _Index, columns: _Index, values: _Array, b: _Array, slots: _Index, H: _Array, g: _Array
) -> None:
    """Fill H = AᵀA, in the order of ``slots``, and g = Aᵀb.

    row_start (m + 1,), columns, values : A by rows; b (m,); H (n + pairs,), g (n,) filled
    """
    H[:] = 0.0
    g[:] = 0.0
    at = 0
    for r in range(row_start.size - 1):
        first, end = row_start[r], row_start[r + 1]
        for p in range(first, end):
            g[columns[p]] += values[p] * b[r]
            for q in range(first, end):
                if slots[at] >= 0:
                    H[slots[at]] += values[p] * values[q]
                at += 1


@njit()
def gradient(row_start: _Index, columns: _Index, values: _Array, b: _Array, g: _Array, diagonal: _Array) -> None:
    """Fill g = Aᵀb and the diagonal of AᵀA, both (n,)."""
    g[:] = 0.0
    diagonal[:] = 0.0
    for r in range(row_start.size - 1):
        for p in range(row_start[r], row_start[r + 1]):
            g[columns[p]] += values[p] * b[r]
            diagonal[columns[p]] += values[p] * values[p]
