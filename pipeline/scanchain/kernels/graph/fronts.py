"""Layout of the frontal matrices of a multifrontal Cholesky factorization, done once per pattern; compiled."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Index = NDArray[np.int64]


class Fronts(NamedTuple):
    """Layout of the fronts. A front is a small dense symmetric matrix: its pivots first, then its update rows.

    Attributes
    ----------
    row_start : (F + 1,) into ``rows``
    rows : scalar position in the elimination order of every row of every front
    pivots : (F,) number of scalar columns that the front eliminates
    factor_start : (F + 1,) into the factor's values; front f keeps the rows of its pivots, from the diagonal on
    parent, children : (F,) the front that takes the update matrix, -1 for none, and how many hand theirs to it
    place : like ``rows``: row of the parent front that an update row falls on
    stack_size : most scalars of update matrices, their upper triangles, waiting at one time
    widest : most rows of a front
    """

    row_start: _Index
    rows: _Index
    pivots: _Index
    factor_start: _Index
    parent: _Index
    children: _Index
    place: _Index
    stack_size: int
    widest: int


class Blocks(NamedTuple):
    """Destinations of the blocks of the matrix: those of front f are start[f] to start[f + 1].

    Attributes
    ----------
    start : (F + 1,)
    offset : of the block among the matrix's values, where it is kept row-major
    height, width : of the block as kept
    top, left : its place in the front, in the upper triangle
    turned : 1 where the front takes its transpose
    """

    start: _Index
    offset: _Index
    height: _Index
    width: _Index
    top: _Index
    left: _Index
    turned: _Index


@njit(nogil=True)
def lay_out_fronts(groups: _Index, begin: _Index, rows: _Index, sizes: _Index) -> Fronts:
    """Expand fronts of blocks to scalars.

    groups (F + 1,) first block position of every front; begin, rows : structure of every block column;
    sizes (n,) : scalars of the block at each position
    """
    count, n = groups.size - 1, sizes.size
    scalar = np.zeros(n + 1, np.int64)
    for j in range(n):
        scalar[j + 1] = scalar[j] + sizes[j]
    front_of = np.empty(n, np.int64)
    row_start, factor_start = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    pivots, parent = np.zeros(count, np.int64), np.full(count, -1, np.int64)
    for f in range(count):
        last = groups[f + 1] - 1
        front_of[groups[f] : groups[f + 1]] = f
        pivots[f] = scalar[groups[f + 1]] - scalar[groups[f]]
        height = pivots[f]
        for q in range(begin[last], begin[last + 1]):
            height += sizes[rows[q]]
        row_start[f + 1] = row_start[f] + height
        factor_start[f + 1] = factor_start[f] + triangle(height) - triangle(height - pivots[f])
    scalar_rows, place = np.empty(row_start[count], np.int64), np.full(row_start[count], -1, np.int64)
    children = np.zeros(count, np.int64)
    for f in range(count):
        last = groups[f + 1] - 1
        at = row_start[f]
        for i in range(scalar[groups[f]], scalar[groups[f + 1]]):
            scalar_rows[at] = i
            at += 1
        for q in range(begin[last], begin[last + 1]):
            for i in range(scalar[rows[q]], scalar[rows[q] + 1]):
                scalar_rows[at] = i
                at += 1
        if begin[last] < begin[last + 1]:
            parent[f] = front_of[rows[begin[last]]]
            children[parent[f]] += 1
    widest, stack_size = _walk(row_start, scalar_rows, pivots, children, parent, place)
    return Fronts(row_start, scalar_rows, pivots, factor_start, parent, children, place, stack_size, widest)


@njit(nogil=True)
def _walk(
    row_start: _Index, rows: _Index, pivots: _Index, children: _Index, parent: _Index, place: _Index
) -> tuple[int, int]:
    """Fill ``place``; return the rows of the widest front and the deepest stack of update matrices."""
    count = pivots.size
    waiting, top = np.zeros(count + 1, np.int64), 0
    widest, deepest, depth = 0, 0, 0
    for f in range(count):
        height = row_start[f + 1] - row_start[f]
        widest = max(widest, height)
        for _ in range(children[f]):
            top -= 1
            depth -= waiting[top]
        waiting[top] = triangle(height - pivots[f])
        depth += waiting[top]
        top += 1
        deepest = max(deepest, depth)
        if parent[f] == -1:
            continue
        at = row_start[parent[f]]
        for q in range(row_start[f] + pivots[f], row_start[f + 1]):
            while rows[at] != rows[q]:
                at += 1
            place[q] = at - row_start[parent[f]]
    return widest, deepest


@njit(nogil=True)
def triangle(size: int) -> int:
    """Number of scalars on and above the diagonal of a square matrix."""
    return size * (size + 1) // 2


@njit(nogil=True)
def lay_out_blocks(
    fronts: Fronts, scalar_start: _Index, sizes: _Index, block_rows: _Index, block_columns: _Index
) -> Blocks:
    """Find the front and the position of every block of the matrix.

    scalar_start (n,) : first scalar position, in the elimination order, of every variable
    sizes (n,) : scalars of every variable
    block_rows, block_columns (B,) : variables of every block, kept one after the other, row-major
    """
    count = fronts.pivots.size
    front_of = np.empty(sizes.sum(), np.int64)
    for f in range(count):
        for q in range(fronts.row_start[f], fronts.row_start[f] + fronts.pivots[f]):
            front_of[fronts.rows[q]] = f
    blocks = block_rows.size
    start = np.zeros(count + 1, np.int64)
    owner = np.empty(blocks, np.int64)
    for b in range(blocks):
        owner[b] = front_of[min(scalar_start[block_rows[b]], scalar_start[block_columns[b]])]
        start[owner[b] + 1] += 1
    for f in range(count):
        start[f + 1] += start[f]
    following = start.copy()
    offset, height, width = np.empty(blocks, np.int64), np.empty(blocks, np.int64), np.empty(blocks, np.int64)
    top, left, turned = np.empty(blocks, np.int64), np.empty(blocks, np.int64), np.empty(blocks, np.int64)
    kept = 0
    for b in range(blocks):
        at, f = following[owner[b]], owner[b]
        following[f] += 1
        row, column = scalar_start[block_rows[b]], scalar_start[block_columns[b]]
        rows = fronts.rows[fronts.row_start[f] : fronts.row_start[f + 1]]
        offset[at], height[at], width[at] = kept, sizes[block_rows[b]], sizes[block_columns[b]]
        top[at] = _index_of(min(row, column), rows)
        left[at] = _index_of(max(row, column), rows)
        turned[at] = 1 if row > column else 0
        kept += height[at] * width[at]
    return Blocks(start, offset, height, width, top, left, turned)


@njit(nogil=True)
def _index_of(row: int, rows: _Index) -> int:
    """Index of a row among rows in ascending order."""
    low, high = 0, rows.size
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < row:
            low = middle + 1
        else:
            high = middle
    return low
