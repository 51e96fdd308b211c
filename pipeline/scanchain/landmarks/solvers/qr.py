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


@dataclass(frozen=True, slots=True)
class _Analysis:
    """Order of the columns, position of each; rows of R, their tree; order of A's rows."""

    order: NDArray[np.int64]
    place: NDArray[np.int64]
    begin: NDArray[np.int64]
    right: NDArray[np.int64]
    parent: NDArray[np.int64]
    rows: NDArray[np.int64]


class QrMethod:
    """QR by Givens rotations; its analysis is reused while the pattern is the same."""

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
        pattern, n = system.pattern, system.pattern.shape[1]
        R, z = np.zeros(len(built.right) + n), np.zeros(n)
        sparse_qr.rotate(
            built.rows, pattern.row_start, pattern.columns, system.values, system.b,
            built.place, built.begin, built.right, built.parent, R, z,
        )  # fmt: skip
        starts = built.begin + np.arange(n + 1)
        matrix = csr_matrix((R, np.insert(built.right, built.begin[:-1], np.arange(n)), starts), shape=(n, n))
        lengths = np.sqrt(np.bincount(pattern.columns, system.values**2, n))
        check_pivots(np.abs(R[starts[:-1]]), lengths[built.order])
        return Factored(
            lambda: spsolve_triangular(matrix, z, lower=False)[built.place],
            lambda: Factor("R of A", csc_matrix(matrix), built.order),
        )


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
    place = np.empty(n, np.int64)
    place[order] = np.arange(n)
    rows = np.flatnonzero(np.diff(pattern.row_start))
    places = place[pattern.columns]
    first, last = (ends.reduceat(places, pattern.row_start[rows]) for ends in (np.minimum, np.maximum))
    return _Analysis(order, place, begin, right, parent, rows[np.lexsort((-last, first))])
