"""Symbolic analysis for the sparse Cholesky factorization, once per pattern: tree, structure, fronts; compiled.

All functions work on blocks (variables such as poses), except the layout of the fronts, which expands them to
scalars.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Index = NDArray[np.int64]


@njit(nogil=True)
def elimination_tree(start: _Index, neighbors: _Index, order: _Index) -> _Index:
    """Parent of every position of the elimination order, -1 at a root (Liu 1990, algorithm 4.2).

    start (n + 1,), neighbors : adjacency lists of the n variables, without the diagonal
    order (n,) : variable eliminated at each position
    """
    n = order.size
    place = np.empty(n, np.int64)
    for k in range(n):
        place[order[k]] = k
    parent, ancestor = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    for k in range(n):
        for q in range(start[order[k]], start[order[k] + 1]):
            i = place[neighbors[q]]
            while i != -1 and i < k:
                following = ancestor[i]
                ancestor[i] = k
                if following == -1:
                    parent[i] = k
                i = following
    return parent


@njit(nogil=True)
def families(parent: _Index) -> tuple[_Index, _Index]:
    """First child of every node of a tree, and the next child of its parent, ascending; -1 where there is none."""
    n = parent.size
    first_child, sibling = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    for j in range(n - 1, -1, -1):
        if parent[j] != -1:
            sibling[j] = first_child[parent[j]]
            first_child[parent[j]] = j
    return first_child, sibling


@njit(nogil=True)
def postorder(parent: _Index) -> _Index:
    """Positions in an order in which every subtree is contiguous and children precede parents."""
    n = parent.size
    first_child, sibling = families(parent)
    result, stack = np.empty(n, np.int64), np.empty(n, np.int64)
    count = 0
    for root in range(n):
        if parent[root] != -1:
            continue
        top = 0
        stack[0] = root
        while top >= 0:
            j = stack[top]
            child = first_child[j]
            if child == -1:
                result[count] = j
                count += 1
                top -= 1
            else:
                first_child[j] = sibling[child]
                top += 1
                stack[top] = child
    return result


def column_structures(start: _Index, neighbors: _Index, order: _Index, parent: _Index) -> tuple[_Index, _Index]:
    """Positions below the diagonal in every block column of the factor, ascending: (start (n + 1,), rows).

    struct(j) = adjacent(j) ∪ struct(children of j), without j and what precedes it. ``order`` is a postorder.
    """
    begin, rows = _structures(start, neighbors, order, parent)
    return begin, rows[np.lexsort((rows, np.repeat(np.arange(order.size), np.diff(begin))))]


@njit(nogil=True)
def _structures(start: _Index, neighbors: _Index, order: _Index, parent: _Index) -> tuple[_Index, _Index]:
    """``column_structures``, with unsorted rows."""
    n = order.size
    place = np.empty(n, np.int64)
    for k in range(n):
        place[order[k]] = k
    first_child, sibling = families(parent)
    begin = np.zeros(n + 1, np.int64)
    rows = np.empty(max(4 * neighbors.size, 16), np.int64)
    mark = np.full(n, -1, np.int64)
    for j in range(n):
        if begin[j] + n > rows.size:
            rows = np.concatenate((rows, np.empty(rows.size + n, np.int64)))
        adjacent = place[neighbors[start[order[j]] : start[order[j] + 1]]]
        end = _join(adjacent, j, mark, rows, begin[j])
        child = first_child[j]
        while child != -1:
            end = _join(rows[begin[child] : begin[child + 1]], j, mark, rows, end)
            child = sibling[child]
        begin[j + 1] = end
    return begin, rows[: begin[n]]


@njit(inline="always")
def _join(members: _Index, j: int, mark: _Index, rows: _Index, end: int) -> int:
    """Append the members beyond j that are not in column j yet; return the column's new end."""
    for i in members:
        if i > j and mark[i] != j:
            mark[i] = j
            rows[end] = i
            end += 1
    return end


@njit(nogil=True)
def group_columns(parent: _Index, begin: _Index, rows: _Index, sizes: _Index) -> _Index:
    """First position of every front (and n at the end): columns with nearly the same structure are merged.

    Columns of equal structure form a front. A front is then merged into its parent if it directly precedes it and
    few explicit zeros arise (relaxed supernodes, Ashcraft & Grimes 1989; thresholds of Chen et al. 2008): any
    number up to 4 scalar columns, 80 % up to 16, 10 % up to 48, 5 % above.

    sizes (n,) : scalars of the variable at each position
    """
    n = parent.size
    first, last, count = np.empty(n, np.int64), np.empty(n, np.int64), 0
    front_of = np.empty(n, np.int64)
    for j in range(n):
        same = j > 0 and parent[j - 1] == j and begin[j] - begin[j - 1] == begin[j + 1] - begin[j] + 1
        if not same:
            first[count] = j
            count += 1
        last[count - 1] = j
        front_of[j] = count - 1
    width, height, real = np.zeros(n, np.int64), np.zeros(n, np.int64), np.empty(n, np.float64)
    for s in range(count):
        for j in range(first[s], last[s] + 1):
            width[s] += sizes[j]
        for q in range(begin[last[s]], begin[last[s] + 1]):
            height[s] += sizes[rows[q]]
        real[s] = 0.5 * width[s] * (width[s] + 1) + width[s] * height[s]
    fronts, kept = np.empty(count + 1, np.int64), 0
    for s in range(count):
        above = parent[last[s]]
        if above != -1 and front_of[above] == s + 1:
            columns = width[s] + width[s + 1]
            total = 0.5 * columns * (columns + 1) + columns * height[s + 1]
            zeros = 1.0 - (real[s] + real[s + 1]) / total
            if zeros < _most_zeros(columns):
                first[s + 1], width[s + 1] = first[s], columns
                real[s + 1] += real[s]
                continue
        fronts[kept] = first[s]
        kept += 1
    fronts[kept] = n
    return fronts[: kept + 1]


@njit(inline="always")
def _most_zeros(columns: int) -> float:
    """Largest share of explicit zeros in a front with this number of scalar columns."""
    if columns <= 4:
        return 1.0
    if columns <= 16:
        return 0.8
    return 0.1 if columns <= 48 else 0.05


class Fronts(NamedTuple):
    """Layout of the fronts. A front is a small dense symmetric matrix: its pivots first, then its update rows.

    row_start : (F + 1,) into ``rows``
    rows : scalar position in the elimination order of every row of every front
    pivots : (F,) number of scalar columns that the front eliminates
    factor_start : (F + 1,) into the factor's values; front f keeps the rows of its pivots, from the diagonal on
    parent, children : (F,) the front that receives the update matrix, -1 for none; how many pass theirs to it
    place : like ``rows``: row of the parent front that corresponds to an update row
    stack_size : largest number of scalars in stored update matrices, as upper triangles, at one time
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

    start : (F + 1,)
    offset : of the block among the matrix's values, where it is kept row-major
    height, width : of the block as kept
    top, left : its position in the front, in the upper triangle
    turned : 1 where the front contains its transpose
    """

    start: _Index
    offset: _Index
    height: _Index
    width: _Index
    top: _Index
    left: _Index
    turned: _Index


def lay_out_fronts(groups: _Index, begin: _Index, rows: _Index, sizes: _Index) -> Fronts:
    """Expand fronts of blocks to scalars.

    groups (F + 1,) first block position of every front; begin, rows : structure of every block column;
    sizes (n,) : scalars of the block at each position
    """
    scalar = np.concatenate([[0], np.cumsum(sizes)])
    pivots, last = np.diff(scalar[groups]), groups[1:] - 1
    own, others = np.diff(groups), begin[groups[1:]] - begin[last]
    starts = np.stack([groups[:-1], len(sizes) + begin[last]], axis=1).ravel()
    blocks = np.concatenate([np.arange(len(sizes)), rows])[ranges(starts, np.stack([own, others], axis=1).ravel())]
    scalar_rows = ranges(scalar[blocks], sizes[blocks])
    of_front = np.repeat(np.arange(len(pivots)), own + others)
    heights = np.bincount(of_front, sizes[blocks], len(pivots)).astype(np.int64)
    row_start = np.concatenate([[0], np.cumsum(heights)])
    factor_start = np.concatenate([[0], np.cumsum(pivots * heights - pivots * (pivots - 1) // 2)])
    parent = np.full(len(pivots), -1)
    parent[others > 0] = np.repeat(np.arange(len(pivots)), own)[rows[begin[last[others > 0]]]]
    has_parent = parent >= 0
    children = np.bincount(parent[has_parent], minlength=len(pivots))
    row_front = np.repeat(np.arange(len(pivots)), heights)
    is_update = ranges(np.zeros_like(heights), heights) >= np.repeat(pivots, heights)
    place = np.full(len(scalar_rows), -1)
    place[is_update] = _index_in_front(
        row_start, scalar_rows, parent[row_front[is_update]], scalar_rows[is_update]
    )
    handed_on = (heights - pivots) * (heights - pivots + 1) // 2
    taken = np.bincount(parent[has_parent], handed_on[has_parent], len(pivots)).astype(np.int64)
    stack_size = int(np.cumsum(handed_on - taken).max(initial=0))
    widest = int(heights.max(initial=0))
    return Fronts(row_start, scalar_rows, pivots, factor_start, parent, children, place, stack_size, widest)


def lay_out_blocks(
    fronts: Fronts, scalar_start: _Index, sizes: _Index, block_rows: _Index, block_columns: _Index
) -> Blocks:
    """Find the front and the position of every block of the matrix.

    scalar_start (n,) : first scalar position, in the elimination order, of every variable
    sizes (n,) : scalars of every variable
    block_rows, block_columns (B,) : variables of every block, kept one after the other, row-major
    """
    count = len(fronts.pivots)
    row, column = scalar_start[block_rows], scalar_start[block_columns]
    first = np.minimum(row, column)
    owner = np.repeat(np.arange(count), fronts.pivots)[first]
    order = np.argsort(owner, kind="stable")
    start = np.searchsorted(owner[order], np.arange(count + 1))
    height, width = sizes[block_rows], sizes[block_columns]
    offset = np.cumsum(height * width) - height * width
    top, left = (
        _index_in_front(fronts.row_start, fronts.rows, owner, at) for at in (first, np.maximum(row, column))
    )
    turned = (row > column).astype(np.int64)
    return Blocks(start, *(each[order] for each in (offset, height, width, top, left, turned)))


def _index_in_front(row_start: _Index, rows: _Index, front: _Index, row: _Index) -> _Index:
    """Index of rows (n,) among those, ascending, of their fronts (n,)."""
    size = rows.max(initial=0) + 1
    keys = np.repeat(np.arange(len(row_start) - 1), np.diff(row_start)) * size + rows
    return np.searchsorted(keys, front * size + row) - row_start[front]


def ranges(starts: _Index, counts: _Index) -> _Index:
    """Concatenated ranges of consecutive numbers, from their starts and counts."""
    return np.repeat(starts - np.cumsum(counts) + counts, counts) + np.arange(int(counts.sum()))


@njit(nogil=True)
def triangle(size: int) -> int:
    """Number of scalars on and above the diagonal of a square matrix."""
    return size * (size + 1) // 2
