"""Sparse orthogonal factorization A = Q R by Givens rotations, row after row of A; Q is not stored; compiled.

A row of A meets those rows of R alone that lie on the path of the elimination tree from its first column on
(George & Heath 1980): with one of them it is rotated so that its first entry vanishes, or it becomes the row of R
itself where there is none yet.
"""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]


@njit()
def rotate(
    rows: _Index, row_start: _Index, columns: _Index, values: _Array, b: _Array,
    place: _Index, begin: _Index, right: _Index, parent: _Index, R: _Array, z: _Array,
) -> None:  # fmt: skip
    """Rotate rows of A into R.

    rows : of A, in the order that they come in
    row_start (m + 1,), columns, values, b (m,) : A by rows, and the right-hand side
    place (n,) : of each column; begin (n + 1,), right, parent (n,) : columns to the right of the diagonal in each
        row of R, and its tree
    R : filled row by row, the diagonal before what is right of it; z (n,) filled with the head of Qᵀb
    """
    row = np.zeros(parent.size)
    for r in rows:
        k, beta = parent.size, b[r]
        for p in range(row_start[r], row_start[r + 1]):
            row[place[columns[p]]] = values[p]
            k = min(k, place[columns[p]])
        while k >= 0:
            first, count = begin[k], begin[k + 1] - begin[k]
            own = R[first + k : first + k + count + 1]
            if own[0] == 0.0 and row[k] != 0.0:
                own[0], z[k], row[k] = row[k], beta, 0.0
                for c in range(count):
                    own[c + 1] = row[right[first + c]]
                    row[right[first + c]] = 0.0
                break
            if row[k] != 0.0:
                length = np.hypot(own[0], row[k])
                cosine, sine = own[0] / length, row[k] / length
                own[0], row[k] = length, 0.0
                for c in range(count):
                    x, y = own[c + 1], row[right[first + c]]
                    own[c + 1], row[right[first + c]] = cosine * x + sine * y, cosine * y - sine * x
                z[k], beta = cosine * z[k] + sine * beta, cosine * beta - sine * z[k]
            k = parent[k]
