"""Fill-reducing order of the columns of a tall sparse matrix, from its own rows; compiled."""

from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Index = NDArray[np.int64]


@njit()
def column_minimum_degree(row_start: _Index, columns: _Index, column_start: _Index, rows: _Index) -> _Index:
    """Column to eliminate at each position, by approximate minimum degree (COLAMD, Davis et al. 2004).

    Eliminating a column joins all rows that hold it to one, its pivot row, which is how QR fills in at the worst.
    The next column is one whose rows, by the sum of what each has beyond the last pivot row, hold the fewest
    columns. Rows that hold nothing else are absorbed. Equal degrees go by the column's number.

    row_start (m + 1,), columns : columns in each row; column_start (n + 1,), rows : rows in each column
    Returns (n,).
    """
    n, m = column_start.size - 1, row_start.size - 1
    rows = rows.copy()
    held = np.diff(column_start)  # live rows of each column
    begin, length = np.empty(m + n, np.int64), np.zeros(m + n, np.int64)
    begin[:m], length[:m] = row_start[:m], np.diff(row_start)
    store, end = np.empty(2 * columns.size + n, np.int64), columns.size
    store[:end] = columns
    beyond, seen = np.zeros(m + n, np.int64), np.full(m + n, -1, np.int64)
    done, mark = np.zeros(n, np.bool_), np.full(n, -1, np.int64)
    degree, order = np.zeros(n, np.int64), np.empty(n, np.int64)
    for c in range(n):
        degree[c] = min((length[rows[column_start[c] : column_start[c + 1]]] - 1).sum(), n)
    queue = [(degree[c], c) for c in range(n)]
    heapify(queue)
    for k in range(n):
        stated, c = heappop(queue)
        while done[c] or stated != degree[c]:
            stated, c = heappop(queue)
        order[k], done[c] = c, True
        if end + n > store.size:
            store = np.concatenate((store, np.empty(store.size + n, np.int64)))
        pivot = m + k
        begin[pivot] = end
        for r in rows[column_start[c] : column_start[c] + held[c]]:
            end = _join(r, k, begin, length, done, mark, store, end)
            length[r] = 0
        members = store[begin[pivot] : end]
        length[pivot] = members.size
        _count_beyond(members, k, column_start, rows, held, length, beyond, seen)
        for w in members:
            degree[w] = _adopt(w, pivot, column_start, rows, held, length, beyond)
            degree[w] = min(degree[w] + members.size - 1, n - k - 2)
            heappush(queue, (degree[w], w))
    return order


@njit()
def _join(
    r: int, k: int, begin: _Index, length: _Index, done: NDArray[np.bool_], mark: _Index, store: _Index, end: int
) -> int:
    """Append the remaining columns of row r that the pivot row lacks; return its new end."""
    for w in store[begin[r] : begin[r] + length[r]]:
        if not done[w] and mark[w] != k:
            mark[w] = k
            store[end] = w
            end += 1
    return end


@njit()
def _count_beyond(
    members: _Index, k: int, column_start: _Index, rows: _Index, held: _Index, length: _Index, beyond: _Index,
    seen: _Index,
) -> None:  # fmt: skip
    """Fill, for every remaining row that shares a column with the pivot row, its number of columns beyond it."""
    for w in members:
        for q in range(column_start[w], column_start[w] + held[w]):
            r = rows[q]
            if length[r] == 0:
                continue
            if seen[r] != k:
                seen[r] = k
                beyond[r] = length[r]
            beyond[r] -= 1


@njit()
def _adopt(
    w: int, pivot: int, column_start: _Index, rows: _Index, held: _Index, length: _Index, beyond: _Index
) -> int:
    """Put the pivot row in place of the rows that it absorbs; return the sum of the others' excess columns."""
    kept, total = column_start[w], 0
    for q in range(column_start[w], column_start[w] + held[w]):
        r = rows[q]
        if length[r] > 0 and beyond[r] > 0:
            rows[kept] = r
            kept += 1
            total += int(beyond[r])
    rows[kept] = pivot
    held[w] = kept + 1 - column_start[w]
    return total
