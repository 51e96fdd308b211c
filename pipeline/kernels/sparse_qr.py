"""Sparse orthogonal factorisation A = Q R by dense Householder fronts; Q is applied to b and forgotten; compiled.

The multifrontal method (Matstoms 1994; Davis 2011) on the structure of R, which is at most that of the Cholesky
factor of AᵀA (George & Heath 1980): a front gathers the rows of A that begin at its pivots and the rows that its
children hand on, triangularises them by Householder reflections (Golub & Van Loan 2013, section 5.1; Davis 2006,
chapter 5), keeps a row of R for each pivot and hands the rest on. Its rows are sorted by where they begin, so that
a reflection touches no row that is still zero there.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.kernels.graph_fronts import Fronts

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]


@njit(cache=True)
def assign_rows(fronts: Fronts, row_start: _Index, columns: _Index, place: _Index) -> tuple[_Index, _Index, _Index, int]:
    """Find the front that takes each row of A: the one whose pivots hold the row's first column.

    row_start (m + 1,), columns : columns in each row; place (n,) : position of each column in the order
    Returns begin (F + 1,) and rows, those of front f from begin[f] on; height (F,) rows gathered by each front;
    and the scalars that the rows handed on take at most at one time.
    """
    count = fronts.pivots.size
    front_of = np.empty(place.size, np.int64)
    for f in range(count):
        for q in range(fronts.row_start[f], fronts.row_start[f] + fronts.pivots[f]):
            front_of[fronts.rows[q]] = f
    m = row_start.size - 1
    owner, begin = np.empty(m, np.int64), np.zeros(count + 1, np.int64)
    for r in range(m):
        first = place.size
        for q in range(row_start[r], row_start[r + 1]):
            first = min(first, place[columns[q]])
        owner[r] = -1 if first == place.size else front_of[first]
        if owner[r] >= 0:
            begin[owner[r] + 1] += 1
    begin = np.cumsum(begin)
    following, rows = begin.copy(), np.empty(begin[count], np.int64)
    for r in range(m):
        if owner[r] >= 0:
            rows[following[owner[r]]] = r
            following[owner[r]] += 1
    height, depth, deepest = np.diff(begin), 0, 0
    waiting, top = np.empty((count + 1, 2), np.int64), 0
    for f in range(count):
        for _ in range(fronts.children[f]):
            top -= 1
            height[f] += waiting[top, 0]
            depth -= waiting[top, 1]
        width = fronts.row_start[f + 1] - fronts.row_start[f]
        left = max(min(height[f], width) - fronts.pivots[f], 0)
        waiting[top, 0], waiting[top, 1] = left, left * (width - fronts.pivots[f] + 1)
        depth += waiting[top, 1]
        top += 1
        deepest = max(deepest, depth)
    return begin, rows, height, deepest


@njit(cache=True)
def factorise(
    fronts: Fronts,
    begin: _Index,
    own: _Index,
    height: _Index,
    row_start: _Index,
    columns: _Index,
    values: _Array,
    b: _Array,
    place: _Index,
    factor: _Array,
    z: _Array,
    stack: _Array,
) -> None:
    """Fill the factor with R, pivots × columns of every front, row-major, and z (n,) with the head of Qᵀb.

    fronts : their ``rows`` are columns of A here, by position in the order; begin, own, height : see assign_rows
    row_start (m + 1,), columns, values : A by rows; b (m,); place (n,) position of each column in the order
    stack : room for the rows handed on
    A pivot that no row determines is zero on the diagonal of R.
    """
    count = fronts.pivots.size
    waiting, top, depth = np.empty(count + 1, np.int64), 0, 0
    largest = 1
    for f in range(count):
        largest = max(largest, height[f] * (fronts.row_start[f + 1] - fronts.row_start[f] + 1))
    work, local = np.empty(largest), np.empty(place.size, np.int64)
    sums = np.empty(fronts.widest + 1)
    for f in range(count):
        column0 = fronts.row_start[f]
        width, pivots = fronts.row_start[f + 1] - column0, fronts.pivots[f]
        for a in range(width):
            local[fronts.rows[column0 + a]] = a
        front = work[: height[f] * (width + 1)].reshape(height[f], width + 1)
        front[:] = 0.0
        leads = np.full(height[f], width, np.int64)
        for k in range(begin[f], begin[f + 1]):
            for q in range(row_start[own[k]], row_start[own[k] + 1]):
                leads[k - begin[f]] = min(leads[k - begin[f]], local[place[columns[q]]])
        at, child_top, child_depth = begin[f + 1] - begin[f], top, depth
        for _ in range(fronts.children[f]):
            child_top -= 1
            child = waiting[child_top]
            first, end = fronts.row_start[child] + fronts.pivots[child], fronts.row_start[child + 1]
            for a in range(_handed_on(height[child], end - first, fronts.pivots[child])):
                leads[at] = fronts.place[first + a]
                at += 1
        stairs, target = _sort_by_lead(leads, width)
        for k in range(begin[f], begin[f + 1]):
            row = front[target[k - begin[f]]]
            for q in range(row_start[own[k]], row_start[own[k] + 1]):
                row[local[place[columns[q]]]] = values[q]
            row[width] = b[own[k]]
        at = begin[f + 1] - begin[f]
        for _ in range(fronts.children[f]):
            top -= 1
            child = waiting[top]
            first, end = fronts.row_start[child] + fronts.pivots[child], fronts.row_start[child + 1]
            left = _handed_on(height[child], end - first, fronts.pivots[child])
            depth -= left * (end - first + 1)
            for a in range(left):
                row = front[target[at + a]]
                kept = stack[depth + a * (end - first + 1) : depth + (a + 1) * (end - first + 1)]
                for c in range(a, end - first):
                    row[fronts.place[first + c]] = kept[c]
                row[width] = kept[end - first]
            at += left
        _triangularise(front, width, stairs, sums)
        start = fronts.factor_start[f]
        for a in range(pivots):
            if a < height[f]:
                factor[start + a * width + a : start + (a + 1) * width] = front[a, a:width]
                z[fronts.rows[column0 + a]] = front[a, width]
            else:
                factor[start + a * width + a : start + (a + 1) * width] = 0.0
                z[fronts.rows[column0 + a]] = 0.0
        left, rest = _handed_on(height[f], width - pivots, pivots), width - pivots
        for a in range(left):
            stack[depth + a * (rest + 1) : depth + (a + 1) * (rest + 1)] = front[pivots + a, pivots:]
        depth += left * (rest + 1)
        waiting[top] = f
        top += 1


@njit(cache=True)
def back_substitute(fronts: Fronts, factor: _Array, z: _Array) -> None:
    """Solve R x = z in place; z (n,) in the order of the columns. A zero on the diagonal gives infinities."""
    for f in range(fronts.pivots.size - 1, -1, -1):
        column0 = fronts.row_start[f]
        width, start = fronts.row_start[f + 1] - column0, fronts.factor_start[f]
        for a in range(fronts.pivots[f] - 1, -1, -1):
            row = factor[start + a * width : start + (a + 1) * width]
            total = z[fronts.rows[column0 + a]]
            for c in range(a + 1, width):
                total -= row[c] * z[fronts.rows[column0 + c]]
            z[fronts.rows[column0 + a]] = total / row[a]


@njit(cache=True)
def _handed_on(height: int, rest: int, pivots: int) -> int:
    """Rows that a front of this height hands on."""
    return max(min(height, rest + pivots) - pivots, 0)


@njit(cache=True)
def _sort_by_lead(leads: _Index, width: int) -> tuple[_Index, _Index]:
    """Rows that begin at or before each column, (width,), and the place of every row when sorted so."""
    stairs = np.zeros(width + 1, np.int64)
    for lead in leads:
        stairs[lead] += 1
    stairs = np.cumsum(stairs)
    following, target = np.concatenate((np.zeros(1, np.int64), stairs)), np.empty(leads.size, np.int64)
    for k in range(leads.size):
        target[k] = following[leads[k]]
        following[leads[k]] += 1
    return stairs, target


@njit(cache=True)
def _triangularise(front: _Array, width: int, stairs: _Index, sums: _Array) -> None:
    """Reflect the front to an upper trapezoid, column after column: F ← F − v (2 vᵀF / vᵀv)."""
    for k in range(min(front.shape[0], width)):
        end = max(stairs[k], k + 1)
        below = 0.0
        for i in range(k + 1, end):
            below += front[i, k] * front[i, k]
        if below == 0.0:
            continue
        head = front[k, k]
        norm = np.sqrt(head * head + below)
        norm = -norm if head > 0.0 else norm
        v = head - norm
        scale = 2.0 / (v * v + below)
        top, total = front[k], sums[: width + 1]
        total[k + 1 :] = v * top[k + 1 :]
        for i in range(k + 1, end):
            factor, row = front[i, k], front[i]
            for c in range(k + 1, width + 1):
                total[c] += factor * row[c]
        for c in range(k + 1, width + 1):
            total[c] *= scale
            top[c] -= v * total[c]
        top[k] = norm
        for i in range(k + 1, end):
            factor, row = front[i, k], front[i]
            for c in range(k + 1, width + 1):
                row[c] -= factor * total[c]
            row[k] = 0.0
