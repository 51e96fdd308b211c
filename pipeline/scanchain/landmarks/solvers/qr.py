"""Sparse orthogonal factorization A = Q R, R x = Qᵀb, without ever forming AᵀA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_matrix, triu
from scipy.sparse.linalg import spsolve_triangular

from scanchain.graph.cholesky import BlockPattern, analyze
from scanchain.kernels.graph import symbolic
from scanchain.kernels.landmarks import sparse_qr
from scanchain.landmarks.problem import LinearSystem, Pattern
from scanchain.landmarks.solvers.direct import Factor, Factored, check_pivots

Ordering = Literal["natural", "colamd"]
_REST = 4  # rows that wait for the dense factorization, over its columns


@dataclass(frozen=True, slots=True)
class _Analysis:
    """Order of the columns, position of each; rows of R, their tree, first full column; order of A's rows."""

    order: NDArray[np.int64]
    place: NDArray[np.int64]
    begin: NDArray[np.int64]
    right: NDArray[np.int64]
    parent: NDArray[np.int64]
    dense: int
    rows: NDArray[np.int64]


class QrMethod:
    """QR by Givens rotations, full columns by LAPACK; its analysis is reused while the pattern is the same."""

    def __init__(self, ordering: Ordering) -> None:
        self._ordering: Ordering = ordering
        self._known: tuple[Pattern, _Analysis] | None = None

    def build(self, system: LinearSystem) -> _Analysis:
        """The order of columns and rows."""
        if self._known is None or self._known[0] is not system.pattern:
            self._known = system.pattern, _analyze(system.pattern, self._ordering)
        return self._known[1]

    def factorize(self, system: LinearSystem, built: _Analysis) -> Factored:
        """R of A, and the head of Qᵀb."""
        R, z = _rotated(system, built)
        n = len(z)
        starts = built.begin + np.arange(n + 1)
        matrix = csr_matrix((R, np.insert(built.right, built.begin[:-1], np.arange(n)), starts), shape=(n, n))
        check_pivots(np.abs(R[starts[:-1]]), _column_lengths(system)[built.order])
        return Factored(
            lambda: spsolve_triangular(matrix, z, lower=False)[built.place],
            lambda: Factor("R of A", csc_matrix(matrix), built.order),
        )


def _column_lengths(system: LinearSystem) -> NDArray[np.float64]:
    """Length of each column of A, (n,)."""
    return np.sqrt(np.bincount(system.pattern.columns, system.values**2, system.pattern.shape[1]))


def _rotated(system: LinearSystem, known: _Analysis) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Entries of R, row by row, and the head of Qᵀb."""
    pattern, n = system.pattern, system.pattern.shape[1]
    R, z, width = np.zeros(len(known.right) + n), np.zeros(n), n - known.dense
    rest, tail, at = np.empty((_REST * width, width + 1)), np.zeros((width, width + 1)), 0
    while at < len(known.rows):
        at, filled = sparse_qr.rotate(
            at, known.rows, pattern.row_start, pattern.columns, system.values, system.b,
            known.place, known.begin, known.right, known.parent, known.dense, R, z, rest,
        )  # fmt: skip
        tail = np.asarray(np.linalg.qr(np.concatenate([tail, rest[:filled]]), mode="r"))[:width]
    R[known.begin[known.dense] + known.dense :] = tail[np.triu_indices(width)]
    z[known.dense :] = tail[:, width]
    return R, z


def _analyze(pattern: Pattern, ordering: Ordering) -> _Analysis:
    """Order the columns, those of "colamd" by minimum degree in AᵀA, and find where R has entries."""
    n = pattern.shape[1]
    joined = pattern.products()
    joined.setdiag(0.0)
    joined.eliminate_zeros()
    joined.sort_indices()
    start, neighbors = joined.indptr.astype(np.int64), joined.indices.astype(np.int64)
    order = np.arange(n)
    if ordering == "colamd":
        pairs = np.stack(triu(joined).nonzero(), axis=1).astype(np.int64)
        order = analyze(BlockPattern(np.ones(n, np.int64), pairs)).order
    parent = symbolic.elimination_tree(start, neighbors, order)
    begin, right = symbolic.column_structures(start, neighbors, order, parent)
    sparse = np.flatnonzero(np.diff(begin) < n - 1 - np.arange(n))
    dense = int(sparse[-1]) + 1 if len(sparse) else 0
    place = np.empty(n, np.int64)
    place[order] = np.arange(n)
    rows = np.flatnonzero(np.diff(pattern.row_start))
    places = place[pattern.columns]
    first, last = (ends.reduceat(places, pattern.row_start[rows]) for ends in (np.minimum, np.maximum))
    return _Analysis(order, place, begin, right, parent, dense, rows[np.lexsort((-last, first))])
