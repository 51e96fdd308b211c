"""Sparse orthogonal factorization A = Q R by dense Householder fronts; Q is applied to b, not stored; compiled.

The multifrontal method (Matstoms 1994; Davis 2011) on the structure of R, which is at most that of the Cholesky
factor of AᵀA (George & Heath 1980): a front gathers the rows of A that begin at its pivots and the rows that its
children hand on, triangularizes them by Householder reflections (Golub & Van Loan 2013, section 5.1; Davis 2006,
chapter 5), keeps a row of R for each pivot and hands the rest on. Its rows are sorted by where they begin, so that
a reflection touches no row that is still zero there.
"""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.graph.fronts import Fronts

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]


@njit()
def assign_rows(
    fronts: Fronts, row_start: _Index, columns: _Index, place: _Index
) -> tuple[_Index, _Index, _Index, int]:
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


@njit()
def factorize(
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
    waiting, top, depth, largest = np.empty(count + 1, np.int64), 0, 0, 1
    for f in range(count):
        largest = max(largest, height[f] * (fronts.row_start[f + 1] - fronts.row_start[f] + 1))
    work, local = np.empty(largest), np.empty(place.size, np.int64)
    sums = np.empty(fronts.widest + 1)
    for f in range(count):
        columns_f = fronts.rows[fronts.row_start[f] : fronts.row_start[f + 1]]
        width, pivots = columns_f.size, fronts.pivots[f]
        for a in range(width):
            local[columns_f[a]] = a
        front = work[: height[f] * (width + 1)].reshape(height[f], width + 1)
        front[:] = 0.0
        mine = own[begin[f] : begin[f + 1]]
        top -= fronts.children[f]
        children = waiting[top : top + fronts.children[f]]
        leads = np.full(height[f], width, np.int64)
        _find_leads(fronts, children, height, mine, row_start, columns, place, local, leads)
        stairs, target = _sort_by_lead(leads, width)
        _place_own(front, target, mine, row_start, columns, values, b, place, local)
        depth = _place_children(front, target, mine.size, fronts, children, height, stack, depth)
        _triangularize(front, width, stairs, sums)
        _keep(front, columns_f, pivots, factor[fronts.factor_start[f] :], z)
        rest = width - pivots
        for a in range(_handed_on(height[f], rest, pivots)):
            stack[depth : depth + rest + 1] = front[pivots + a, pivots:]
            depth += rest + 1
        waiting[top] = f
        top += 1


@njit()
def _find_leads(
    fronts: Fronts, children: _Index, height: _Index, mine: _Index, row_start: _Index, columns: _Index,
    place: _Index, local: _Index, leads: _Index,
) -> None:  # fmt: skip
    """Fill the first column of every row that a front gathers: its own rows, then those of its children."""
    at = 0
    for r in mine:
        for q in range(row_start[r], row_start[r + 1]):
            leads[at] = min(leads[at], local[place[columns[q]]])
        at += 1
    for k in range(children.size):
        child = int(children[k])
        first = fronts.row_start[child] + fronts.pivots[child]
        for a in range(_rows_of(fronts, height, child)):
            leads[at] = fronts.place[first + a]
            at += 1


@njit()
def _place_own(
    front: _Array, target: _Index, mine: _Index, row_start: _Index, columns: _Index, values: _Array, b: _Array,
    place: _Index, local: _Index,
) -> None:  # fmt: skip
    """Write a front's own rows of A, and of b in the last column."""
    for k in range(mine.size):
        row = front[target[k]]
        for q in range(row_start[mine[k]], row_start[mine[k] + 1]):
            row[local[place[columns[q]]]] = values[q]
        row[-1] = b[mine[k]]


@njit()
def _place_children(
    front: _Array, target: _Index, at: int, fronts: Fronts, children: _Index, height: _Index, stack: _Array,
    depth: int,
) -> int:  # fmt: skip
    """Write the children's update rows, from row ``at`` on; return the stack's depth without them."""
    for k in range(children.size):
        child = int(children[k])
        first, end = fronts.row_start[child] + fronts.pivots[child], fronts.row_start[child + 1]
        depth -= _rows_of(fronts, height, child) * (end - first + 1)
    start = depth
    for k in range(children.size):
        child = int(children[k])
        first, end = fronts.row_start[child] + fronts.pivots[child], fronts.row_start[child + 1]
        for a in range(_rows_of(fronts, height, child)):
            row, kept = front[target[at]], stack[start : start + end - first + 1]
            for c in range(a, end - first):
                row[fronts.place[first + c]] = kept[c]
            row[-1] = kept[-1]
            start += kept.size
            at += 1
    return depth


@njit()
def _keep(front: _Array, columns: _Index, pivots: int, factor: _Array, z: _Array) -> None:
    """Store the rows of R that belong to the pivots; zeros where the front has too few rows."""
    width, at = columns.size, 0
    for a in range(pivots):
        if a < front.shape[0]:
            factor[at : at + width - a] = front[a, a:width]
            z[columns[a]] = front[a, width]
        else:
            factor[at : at + width - a] = 0.0
            z[columns[a]] = 0.0
        at += width - a


@njit()
def back_substitute(fronts: Fronts, factor: _Array, z: _Array) -> None:
    """Solve R x = z in place; z (n,) in the order of the columns. A zero on the diagonal gives infinities."""
    for f in range(fronts.pivots.size - 1, -1, -1):
        column0 = fronts.row_start[f]
        width, at = fronts.row_start[f + 1] - column0, fronts.factor_start[f + 1]
        for a in range(fronts.pivots[f] - 1, -1, -1):
            at -= width - a
            row, columns = factor[at : at + width - a], fronts.rows[column0 + a : column0 + width]
            total = z[columns[0]]
            for c in range(1, width - a):
                total -= row[c] * z[columns[c]]
            z[columns[0]] = total / row[0]


@njit()
def _handed_on(height: int, rest: int, pivots: int) -> int:
    """Number of update rows of a front of this height."""
    return max(min(height, rest + pivots) - pivots, 0)


@njit()
def _rows_of(fronts: Fronts, height: _Index, child: int) -> int:
    """Update rows of a front, for its parent."""
    width = fronts.row_start[child + 1] - fronts.row_start[child]
    return int(_handed_on(height[child], width - fronts.pivots[child], fronts.pivots[child]))


@njit()
def _sort_by_lead(leads: _Index, width: int) -> tuple[_Index, _Index]:
    """Rows that begin at or before each column, (width,), and the position of every row when sorted so."""
    stairs = np.zeros(width + 1, np.int64)
    for lead in leads:
        stairs[lead] += 1
    stairs = np.cumsum(stairs)
    following, target = np.concatenate((np.zeros(1, np.int64), stairs)), np.empty(leads.size, np.int64)
    for k in range(leads.size):
        target[k] = following[leads[k]]
        following[leads[k]] += 1
    return stairs, target


@njit()
def _triangularize(front: _Array, width: int, stairs: _Index, sums: _Array) -> None:
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
