"""Symbolic analysis for the sparse Cholesky factorization: elimination tree, structure, fronts; compiled.

Everything here works on blocks (variables such as poses), not on scalars, and is done once per pattern.
"""

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
    """The same, not in order."""
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


@njit(nogil=True)
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
    """First position of every front (and n at the end): columns with nearly the same structure join.

    Columns of equal structure form a front. Then a front joins its parent where it directly precedes it and few
    explicit zeros arise (relaxed supernodes, Ashcraft & Grimes 1989; thresholds of Chen et al. 2008): any number
    up to 4 scalar columns, 80 % up to 16, 10 % up to 48, 5 % above.

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


@njit(nogil=True)
def _most_zeros(columns: int) -> float:
    """Share of explicit zeros that a front of so many scalar columns may hold."""
    if columns <= 4:
        return 1.0
    if columns <= 16:
        return 0.8
    return 0.1 if columns <= 48 else 0.05
