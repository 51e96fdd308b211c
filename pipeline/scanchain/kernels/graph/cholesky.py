"""Sparse Cholesky factorization A = Uᵀ U by dense fronts, solves with it, the inverse where A is not 0; compiled.

Multifrontal method (Duff & Reid 1983; Liu 1992): every front gathers its entries of A and the update matrices of
its children, eliminates its pivots and passes its update matrix on. Fronts are row-major and only their upper
triangle is used, so that every inner loop runs along a row.
"""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.graph.symbolic import Blocks, Fronts, families, triangle

_Array = NDArray[np.float64]
_PANEL = 32  # pivots eliminated before the rest of the front is touched
_TILE = 256  # columns of the rest that are updated together, so that the panel stays in the cache


@njit(nogil=True)
def factorize(
    fronts: Fronts, blocks: Blocks, values: _Array, floor: _Array, factor: _Array, stack: _Array, work: _Array
) -> int:
    """Fill the factor; return -1, or the position in the elimination order of the first pivot that failed.

    values : the blocks of A (diagonal and one triangle); floor (n,) : a pivot at or below it has failed
    factor : fronts.factor_start[-1] scalars, filled
    stack : fronts.stack_size scalars of room, work : fronts.widest² scalars of room
    """
    count = fronts.pivots.size
    waiting, top, depth = np.empty(count + 1, np.int64), 0, 0
    runs = np.empty(fronts.widest + 1, np.int64)
    for f in range(count):
        row0 = fronts.row_start[f]
        height, pivots = fronts.row_start[f + 1] - row0, fronts.pivots[f]
        front = work[: height * height].reshape(height, height)
        for a in range(height):
            front[a].fill(0.0)
        for b in range(blocks.start[f], blocks.start[f + 1]):
            _place_block(front, blocks, b, values)
        for _ in range(fronts.children[f]):
            top -= 1
            child = waiting[top]
            first, end = fronts.row_start[child] + fronts.pivots[child], fronts.row_start[child + 1]
            depth -= triangle(end - first)
            _extend_add(front, fronts.place[first:end], stack[depth : depth + triangle(end - first)], runs)
        failed = _eliminate(front, pivots, floor[fronts.rows[row0] :])
        if failed >= 0:
            return int(fronts.rows[row0 + failed])
        rest = height - pivots
        at = fronts.factor_start[f]
        for a in range(pivots):
            for c in range(a, height):
                factor[at + c - a] = front[a, c]
            at += height - a
        for a in range(rest):
            for c in range(a, rest):
                stack[depth + c - a] = front[pivots + a, pivots + c]
            depth += rest - a
        waiting[top] = f
        top += 1
    return -1


@njit(nogil=True)
def solve_lower(fronts: Fronts, factor: _Array, path: NDArray[np.int64], x: _Array, local: _Array) -> None:
    """Solve Uᵀ x = b in place; x (n,) is ordered as the elimination, local : fronts.widest scalars.

    path : fronts to visit, ascending, each with its parent: all of them, or those that begin where b is
        not zero; x is zero in the rest
    """
    for f in path:
        row0 = fronts.row_start[f]
        height, pivots = fronts.row_start[f + 1] - row0, fronts.pivots[f]
        rows, at = fronts.rows[row0 : row0 + height], fronts.factor_start[f]
        local[:height].fill(0.0)
        for a in range(pivots):
            row, below = factor[at : at + height - a], local[a:height]
            value = (x[rows[a]] + below[0]) / row[0]
            x[rows[a]] = value
            for b in range(1, height - a):
                below[b] -= row[b] * value
            at += height - a
        for b in range(pivots, height):
            x[rows[b]] += local[b]


@njit(nogil=True)
def solve_upper(fronts: Fronts, factor: _Array, x: _Array, local: _Array) -> None:
    """Solve U x = b in place; arguments as of ``solve_lower``."""
    for f in range(fronts.pivots.size - 1, -1, -1):
        row0 = fronts.row_start[f]
        height, pivots = fronts.row_start[f + 1] - row0, fronts.pivots[f]
        rows, at = fronts.rows[row0 : row0 + height], fronts.factor_start[f + 1]
        for b in range(height):
            local[b] = x[rows[b]]
        for a in range(pivots - 1, -1, -1):
            at -= height - a
            row, below = factor[at : at + height - a], local[a:height]
            value = below[0]
            for b in range(1, height - a):
                value -= row[b] * below[b]
            below[0] = value / row[0]
            x[rows[a]] = below[0]


@njit(inline="always")
def _place_block(front: _Array, blocks: Blocks, b: int, values: _Array) -> None:
    """Add one block of A to the upper triangle of its front."""
    top, left, height, width = blocks.top[b], blocks.left[b], blocks.height[b], blocks.width[b]
    at = blocks.offset[b]
    for r in range(height):
        for c in range(width):
            if blocks.turned[b] == 1:
                front[top + c, left + r] += values[at]
            elif top != left or c >= r:
                front[top + r, left + c] += values[at]
            at += 1


@njit(inline="always")
def _extend_add(front: _Array, place: NDArray[np.int64], update: _Array, runs: NDArray[np.int64]) -> None:
    """Add a child's update matrix, its upper triangle, in runs of columns that are neighbors in the front too."""
    size, count, start = place.size, 0, 0
    for b in range(size):
        if b == 0 or place[b] != place[b - 1] + 1:
            runs[count] = b
            count += 1
    runs[count] = size
    first_run = 0
    for a in range(size):
        if runs[first_run + 1] <= a:
            first_run += 1
        row, source = front[place[a]], update[start : start + size - a]
        start += size - a
        for q in range(first_run, count):
            b0, b1 = max(runs[q], a), runs[q + 1]
            target = row[place[b0] : place[b0] + b1 - b0]
            for b in range(b1 - b0):
                target[b] += source[b0 - a + b]


@njit(nogil=True)
def _eliminate(front: _Array, pivots: int, floor: _Array) -> int:
    """Factor the first ``pivots`` rows and update the rest; return -1 or the pivot that failed."""
    height = front.shape[0]
    for k0 in range(0, pivots, _PANEL):
        k1 = min(k0 + _PANEL, pivots)
        for k in range(k0, k1):
            row = front[k]
            diagonal = row[k]
            if not diagonal > floor[k]:
                return k
            scale = 1.0 / np.sqrt(diagonal)
            for c in range(k, height):
                row[c] *= scale
            for i in range(k + 1, k1):
                factor, target = row[i], front[i]
                for c in range(i, height):
                    target[c] -= factor * row[c]
        for c0 in range(k1, height, _TILE):
            _update_rest(front, k0, k1, c0, min(c0 + _TILE, height))
    return -1


@njit(inline="always")
def _update_rest(front: _Array, k0: int, k1: int, c0: int, c1: int) -> None:
    """Subtract Uᵀ U of rows k0 to k1 from columns c0 to c1 of the rows below: two rows, four pivots a time."""
    i = k1
    while i < c1:
        pair = i + 1 < c1
        begin = max(i, c0)
        size = c1 - begin
        upper = front[i, begin:c1]
        lower = front[i + 1, begin:c1] if pair else upper
        k = k0
        while k + 4 <= k1:
            p0, p1 = front[k, begin:c1], front[k + 1, begin:c1]
            p2, p3 = front[k + 2, begin:c1], front[k + 3, begin:c1]
            a0, a1, a2, a3 = front[k, i], front[k + 1, i], front[k + 2, i], front[k + 3, i]
            if pair:
                j = i + 1
                b0, b1, b2, b3 = front[k, j], front[k + 1, j], front[k + 2, j], front[k + 3, j]
                for c in range(size):
                    upper[c] -= a0 * p0[c] + a1 * p1[c] + a2 * p2[c] + a3 * p3[c]
                    lower[c] -= b0 * p0[c] + b1 * p1[c] + b2 * p2[c] + b3 * p3[c]
            else:
                for c in range(size):
                    upper[c] -= a0 * p0[c] + a1 * p1[c] + a2 * p2[c] + a3 * p3[c]
            k += 4
        while k < k1:
            p0, a0 = front[k, begin:c1], front[k, i]
            for c in range(size):
                upper[c] -= a0 * p0[c]
            if pair:
                b0 = front[k, i + 1]
                for c in range(size):
                    lower[c] -= b0 * p0[c]
            k += 1
        i += 2


@njit(nogil=True)
def selected_inverse(
    fronts: Fronts, blocks: Blocks, factor: _Array, inverse: _Array, stack: _Array, work: _Array
) -> None:
    """Fill the blocks of Z = A⁻¹ that A has, by fronts from the root down (Takahashi et al. 1973).

    From A = Uᵀ U follows U Z = U⁻ᵀ, which is zero above the diagonal; row a of a front, Z being known below it:
        Z_ac = −Σ_{m>a} U_am Z_mc / U_aa for c > a,      Z_aa = (1 / U_aa − Σ_{m>a} U_am Z_ma) / U_aa
    The part of Z beyond its pivots that a front needs is in its parent; it is kept on the stack, like the update
    matrices before.

    factor : as ``factorize`` left it; inverse : block values, laid out as those of A, filled
    stack : fronts.stack_size scalars of room, work : fronts.widest² scalars of room
    """
    first_child, sibling = families(fronts.parent)
    depth = 0
    for f in range(fronts.pivots.size - 1, -1, -1):
        height, pivots = fronts.row_start[f + 1] - fronts.row_start[f], fronts.pivots[f]
        rest = height - pivots
        Z = work[: height * height].reshape(height, height)
        depth -= triangle(rest)
        at = depth
        for a in range(rest):
            for c in range(a, rest):
                Z[pivots + a, pivots + c] = Z[pivots + c, pivots + a] = stack[at]
                at += 1
        at = fronts.factor_start[f + 1]
        for a in range(pivots - 1, -1, -1):
            at -= height - a
            _fill_row(Z, a, factor[at : at + height - a])
        for b in range(blocks.start[f], blocks.start[f + 1]):
            _take_block(Z, blocks, b, inverse)
        child = first_child[f]
        while child != -1:
            place = fronts.place[fronts.row_start[child] + fronts.pivots[child] : fronts.row_start[child + 1]]
            for a in range(place.size):
                for b in range(a, place.size):
                    stack[depth] = Z[place[a], place[b]]
                    depth += 1
            child = sibling[child]


@njit(inline="always")
def _fill_row(Z: _Array, a: int, upper: _Array) -> None:
    """Fill row and column a of Z from those beyond it; upper is row a of U from the diagonal on."""
    height = a + upper.size
    row = Z[a]
    row[a + 1 :].fill(0.0)
    for m in range(a + 1, height):
        weight, below = upper[m - a] / upper[0], Z[m]
        for c in range(a + 1, height):
            row[c] -= weight * below[c]
    total = 1.0 / upper[0]
    for m in range(a + 1, height):
        Z[m, a] = row[m]
        total -= upper[m - a] * row[m]
    row[a] = total / upper[0]


@njit(inline="always")
def _take_block(Z: _Array, blocks: Blocks, b: int, inverse: _Array) -> None:
    """Copy one block out of its front."""
    top, left, at = blocks.top[b], blocks.left[b], blocks.offset[b]
    for r in range(blocks.height[b]):
        for c in range(blocks.width[b]):
            inverse[at] = Z[top + c, left + r] if blocks.turned[b] == 1 else Z[top + r, left + c]
            at += 1
