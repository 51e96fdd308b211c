"""Layout of the frontal matrices of a multifrontal Cholesky factorization, done once per pattern."""

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
    """The numbers from each start on, so many, one range after the other."""
    return np.repeat(starts - np.cumsum(counts) + counts, counts) + np.arange(int(counts.sum()))


@njit(nogil=True)
def triangle(size: int) -> int:
    """Number of scalars on and above the diagonal of a square matrix."""
    return size * (size + 1) // 2
