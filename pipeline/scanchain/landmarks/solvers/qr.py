"""Sparse orthogonal factorization A = Q R, R x = Qᵀb, without ever forming AᵀA.

``qr`` and ``qr_colamd`` are the project's own, ``spqr`` and ``spqr_colamd`` SuiteSparseQR (Davis 2011), where the
package sparseqr is installed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, triu
from scipy.sparse.linalg import spsolve_triangular

from scanchain.errors import MissingExtraError
from scanchain.graph.cholesky import BlockPattern, SingularMatrixError, analyze
from scanchain.kernels.graph import symbolic
from scanchain.kernels.landmarks import sparse_qr
from scanchain.landmarks.problem import LinearSystem, Pattern
from scanchain.landmarks.solvers.direct import Factor, Factored, check_pivots

Ordering = Literal["natural", "colamd"]
_REST = 4  # rows that wait for the dense factorization, over its columns
_SPQR_ORDERINGS = {"natural": 0, "colamd": 2}  # SPQR_ORDERING_FIXED, SPQR_ORDERING_COLAMD


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


class SuiteSparseQrMethod:
    """Householder QR with the fronts of SuiteSparse; GPL, so never part of the default installation."""

    def __init__(self, ordering: Ordering) -> None:
        try:
            import sparseqr  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise MissingExtraError("sparseqr", "suitesparse") from error
        self._rz = sparseqr.rz
        self._ordering: Ordering = ordering

    def build(self, system: LinearSystem) -> coo_matrix:
        """A by triplets."""
        return coo_matrix(system.A)

    def factorize(self, system: LinearSystem, built: coo_matrix) -> Factored:
        """R of A, and the head of Qᵀb."""
        n = system.pattern.shape[1]
        z, R, permutation, rank = self._rz(built, system.b[:, None], ordering=_SPQR_ORDERINGS[self._ordering])
        if rank < n:
            raise SingularMatrixError(rank, rank)
        order = np.asarray(permutation, np.int64) if self._ordering == "colamd" else np.arange(n)
        R = csc_matrix(R)
        check_pivots(np.abs(R.diagonal()), _column_lengths(system)[order])

        def solve() -> NDArray[np.float64]:
            x = np.empty(n)
            x[order] = spsolve_triangular(R.tocsr(), np.asarray(z).reshape(-1)[:n], lower=False)
            return x

        return Factored(solve, lambda: Factor("R of A", R, order))
