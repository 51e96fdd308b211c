"""Linear algebra of landmark problems: AᵀA as an arrow, banded poses with a border, and A = Q R; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]
_PANEL = 16  # rows of the border that are subtracted from the corner together


@njit()
def products(
    row_start: _Index, columns: _Index, values: _Array, b: _Array, split: int, band: _Array, border: _Array,
    corner: _Array, g: _Array,
) -> None:  # fmt: skip
    """Sum up H = AᵀA, in three parts, and g = Aᵀb.

        H = [P, Bᵀ; B, C],  band[w + i − j, j] = P_ij for i ≤ j  (LAPACK's upper band of width w)

    row_start (m + 1,), columns, values : A by rows; b (m,); split : columns of the poses
    band (w + 1, split), border (split, n − split) Bᵀ, corner (n − split, n − split) upper triangle of C, g (n,) :
        zero before
    """
    w = band.shape[0] - 1
    for r in range(row_start.size - 1):
        for p in range(row_start[r], row_start[r + 1]):
            if values[p] == 0.0:
                continue
            g[columns[p]] += values[p] * b[r]
            for q in range(p, row_start[r + 1]):
                i, j, product = min(columns[p], columns[q]), max(columns[p], columns[q]), values[p] * values[q]
                if j < split:
                    band[w + i - j, j] += product
                elif i < split:
                    border[i, j - split] += product
                else:
                    corner[i - split, j - split] += product


@njit()
def eliminate(band: _Array, border: _Array, share: float) -> int:
    """Factor P = UᵀU in its band and turn the border Bᵀ into Y = U⁻ᵀ Bᵀ (Golub & Van Loan 2013, 4.3.5).

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


@njit()
def complement(corner: _Array, border: _Array) -> None:
    """Subtract YᵀY from the upper triangle of the corner, four rows of Y at a time, in cached panels."""
    whole = border.shape[0] - border.shape[0] % 4
    for first in range(0, whole, _PANEL):
        for a in range(corner.shape[0]):
            row = corner[a, a:]
            for j in range(first, min(first + _PANEL, whole), 4):
                w, x, y, z = border[j, a], border[j + 1, a], border[j + 2, a], border[j + 3, a]
                if w != 0.0 or x != 0.0 or y != 0.0 or z != 0.0:
                    for c in range(row.size):
                        row[c] -= (w * border[j, a + c] + x * border[j + 1, a + c]) + (
                            y * border[j + 2, a + c] + z * border[j + 3, a + c]
                        )
    for j in range(whole, border.shape[0]):
        for a in range(corner.shape[0]):
            _subtract(corner[a, a:], border[j, a], border[j, a:])


@njit()
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


@njit()
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


@njit()
def invert(
    band: _Array, border: _Array, corner: _Array, Z_band: _Array, Z_border: _Array, Z_corner: _Array
) -> None:
    """Fill the inverse of AᵀA = UᵀU where the arrow has entries (Takahashi, Fagan & Chen 1973).

        Z_ij = [i = j] / U_ii² − Σ_k U_ik Z_kj / U_ii,   k > i over row i of U, from the last row up

    band, border, corner : U, as ``eliminate`` and ``eliminate_corner`` leave it
    Z_band, Z_border, Z_corner : filled, of the same shapes; all of the corner
    """
    w, n, rest = band.shape[0] - 1, band.shape[1], corner.shape[0]
    for i in range(rest - 1, -1, -1):
        for j in range(rest - 1, i - 1, -1):
            total = 1.0 / corner[i, i] if i == j else 0.0
            for k in range(i + 1, rest):
                total -= corner[i, k] * Z_corner[k, j]
            Z_corner[i, j] = Z_corner[j, i] = total / corner[i, i]
    for i in range(n - 1, -1, -1):
        last, pivot, row = min(n - 1, i + w), band[w, i], Z_border[i]
        row[:] = 0.0
        for k in range(i + 1, last + 1):
            _subtract(row, band[w + i - k, k], Z_border[k])
        for m in range(rest):
            _subtract(row, border[i, m], Z_corner[m])
        _divide(row, pivot)
        for j in range(last, i - 1, -1):
            total = 1.0 / pivot if i == j else 0.0
            for k in range(i + 1, last + 1):
                total -= band[w + i - k, k] * Z_band[w + min(j, k) - max(j, k), max(j, k)]
            for m in range(rest):
                total -= border[i, m] * Z_border[j, m]
            Z_band[w + i - j, j] = total / pivot


@njit()
def blocks(Z_band: _Array, Z_border: _Array, Z_corner: _Array, wanted: _Index, result: _Array) -> None:
    """Fill blocks of the inverse: wanted (N, c) columns of A, result (N, c, c); NaN for poses beyond the band."""
    w, n = Z_band.shape[0] - 1, Z_band.shape[1]
    for k in range(wanted.shape[0]):
        for a in range(wanted.shape[1]):
            for b in range(wanted.shape[1]):
                i, j = min(wanted[k, a], wanted[k, b]), max(wanted[k, a], wanted[k, b])
                if i >= n:
                    result[k, a, b] = Z_corner[i - n, j - n]
                elif j >= n:
                    result[k, a, b] = Z_border[i, j - n]
                else:
                    result[k, a, b] = Z_band[w + i - j, j] if j - i <= w else np.nan


@njit()
def solve_forward(band: _Array, x: _Array) -> None:
    """Solve Uᵀ x = b in place, U in its band."""
    w = band.shape[0] - 1
    for j in range(band.shape[1]):
        for i in range(max(0, j - w), j):
            x[j] -= band[w + i - j, j] * x[i]
        x[j] /= band[w, j]


@njit()
def solve_backward(band: _Array, x: _Array) -> None:
    """Solve U x = b in place, U in its band."""
    w = band.shape[0] - 1
    for j in range(band.shape[1] - 1, -1, -1):
        x[j] /= band[w, j]
        for i in range(max(0, j - w), j):
            x[i] -= band[w + i - j, j] * x[j]


@njit()
def rotate(
    rows: _Index, row_start: _Index, columns: _Index, values: _Array, b: _Array,
    place: _Index, begin: _Index, right: _Index, parent: _Index, R: _Array, z: _Array,
) -> None:  # fmt: skip
    """Rotate A into R, row after row, by Givens rotations; Q is not stored.

    A row of A affects only those rows of R on the path of the elimination tree from its first column to the root
    (George & Heath 1980): it is rotated with each of them so that its first entry vanishes, or becomes that row of
    R where there is none yet.

    rows : of A, in the order of insertion
    row_start (m + 1,), columns, values, b (m,) : A by rows, and the right-hand side
    place (n,) : of each column; begin (n + 1,), right, parent (n,) : columns to the right of the diagonal in each
        row of R, and its tree
    R : filled row by row, the diagonal before the entries to its right; z (n,) filled with the head of Qᵀb
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


@njit(inline="always")
def _subtract(row: _Array, factor: float, other: _Array) -> None:
    for c in range(row.size):
        row[c] -= factor * other[c]


@njit(inline="always")
def _divide(row: _Array, number: float) -> None:
    for c in range(row.size):
        row[c] /= number
