"""Sparse orthogonal factorization A = Q R by Givens rotations, row after row of A; Q is not stored; compiled.

A row of A meets those rows of R alone that lie on the path of the elimination tree from its first column on
(George & Heath 1980): with one of them it is rotated so that its first entry vanishes, or it becomes the row of R
itself where there is none yet. The last columns, among which R is full, are left to a dense factorization.
"""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]


@njit()
def rotate(
    at: int, rows: _Index, row_start: _Index, columns: _Index, values: _Array, b: _Array,
    place: _Index, begin: _Index, right: _Index, parent: _Index, dense: int, R: _Array, z: _Array, rest: _Array,
) -> tuple[int, int]:  # fmt: skip
    """Rotate rows of A into R from ``rows[at]`` on, until they end or ``rest`` is full.

    row_start (m + 1,), columns, values, b (m,) : A by rows, and the right-hand side; place (n,) : of each column
    begin (n + 1,), right, parent (n,) : columns to the right of the diagonal in each row of R, and its tree
    dense : from this column on R is full
    R : filled row by row, the diagonal before what is right of it; z (n,) filled with the head of Qᵀb
    rest (., n − dense + 1) : filled with what is left of rows in the last columns, b behind
    Returns the place in ``rows`` to go on from, and the number of rows in ``rest``.
    """
    n, filled = parent.size, 0
    row = np.zeros(n)
    for q in range(at, rows.size):
        if filled == len(rest):
            return q, filled
        k, beta = n, b[rows[q]]
        for p in range(row_start[rows[q]], row_start[rows[q] + 1]):
            row[place[columns[p]]] = values[p]
            k = min(k, place[columns[p]])
        while 0 <= k < dense:
            first, count = begin[k], begin[k + 1] - begin[k]
            own = R[first + k : first + k + count + 1]
            if own[0] == 0.0 and row[k] != 0.0:
                own[0], z[k], row[k] = row[k], beta, 0.0
                for c in range(count):
                    own[c + 1] = row[right[first + c]]
                    row[right[first + c]] = 0.0
                k = -1
                continue
            if row[k] != 0.0:
                length = np.hypot(own[0], row[k])
                cosine, sine = own[0] / length, row[k] / length
                own[0], row[k] = length, 0.0
                for c in range(count):
                    x, y = own[c + 1], row[right[first + c]]
                    own[c + 1], row[right[first + c]] = cosine * x + sine * y, cosine * y - sine * x
                z[k], beta = cosine * z[k] + sine * beta, cosine * beta - sine * z[k]
            k = parent[k]
        if k >= dense:
            rest[filled, :-1], rest[filled, -1] = row[dense:], beta
            row[dense:] = 0.0
            filled += 1
    return rows.size, filled
