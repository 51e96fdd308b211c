"""Sparse orthogonal factorization A = Q R, R x = Qᵀb, without ever forming AᵀA.

``qr`` and ``qr_colamd`` are the project's own, ``spqr`` and ``spqr_colamd`` SuiteSparseQR (Davis 2011), where the
package sparseqr is installed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix
from scipy.sparse.linalg import spsolve_triangular

from scanchain.errors import MissingExtraError
from scanchain.graph.cholesky import BlockPattern, analyze
from scanchain.kernels.graph import symbolic
from scanchain.kernels.landmarks import normal_equations, sparse_qr
from scanchain.landmarks.problem import LinearSystem, Pattern
from scanchain.landmarks.solvers.direct import LOST_DIGITS, Factor, Solution, Stopwatch, undetermined

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


class QrSolver:
    """QR by Givens rotations, full columns by LAPACK; its analysis is reused while the pattern is the same."""

    def __init__(self, ordering: Ordering) -> None:
        self._ordering: Ordering = ordering
        self._known: tuple[Pattern, _Analysis] | None = None

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is R."""
        watch = Stopwatch()
        pattern, n = system.pattern, system.pattern.shape[1]
        if self._known is None or self._known[0] is not pattern:
            self._known = pattern, _analyze(pattern, self._ordering)
        known = self._known[1]
        build_s = watch.lap()
        R, z = _factorize(system, known)
        starts, k = known.begin + np.arange(n + 1), np.arange(n)
        matrix = csr_matrix((R, np.insert(known.right, known.begin[:-1], k), starts), shape=(n, n))
        factor_s = watch.lap()
        lengths = np.bincount(pattern.columns, system.values**2, n)
        if not np.all(np.abs(R[starts[:-1]]) > LOST_DIGITS * np.sqrt(lengths[known.order])):
            raise undetermined(system)
        watch.lap()
        x = spsolve_triangular(matrix, z, lower=False)[known.place]
        solve_s = watch.lap()
        return Solution(x, build_s, factor_s, solve_s, lambda: Factor("R of A", csc_matrix(matrix), known.order))


def _factorize(system: LinearSystem, known: _Analysis) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
    start, others, _ = normal_equations.product_structure(pattern.row_start, pattern.columns, *pattern.by_column())
    order = np.arange(n)
    if ordering == "colamd":
        pairs = np.stack([np.repeat(order, np.diff(start)), others], axis=1)
        order = analyze(BlockPattern(np.ones(n, np.int64), pairs)).order
    start, neighbors = _neighbor_lists(start, others)
    parent = symbolic.elimination_tree(start, neighbors, order)
    begin, right = symbolic.column_structures(start, neighbors, order, parent)
    sparse = np.flatnonzero(np.diff(begin) < n - 1 - np.arange(n))
    place = np.empty(n, np.int64)
    place[order] = np.arange(n)
    rows = np.flatnonzero(np.diff(pattern.row_start))
    places = place[pattern.columns]
    first, last = (ends.reduceat(places, pattern.row_start[rows]) for ends in (np.minimum, np.maximum))
    return _Analysis(
        order,
        place,
        begin,
        right,
        parent,
        int(sparse[-1]) + 1 if len(sparse) else 0,
        rows[np.lexsort((-last, first))],
    )


def _neighbor_lists(
    start: NDArray[np.int64], others: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Every column's neighbors on either side, from those beyond it: (start (n + 1,), neighbors)."""
    n = len(start) - 1
    beyond = csr_matrix((np.ones(len(others), np.int8), others, start), shape=(n, n))
    both = csr_matrix(beyond + beyond.T)
    return both.indptr.astype(np.int64), both.indices.astype(np.int64)


class SuiteSparseQrSolver:
    """Householder QR with the fronts of SuiteSparse; GPL, so never part of the default installation."""

    def __init__(self, ordering: Ordering) -> None:
        try:
            import sparseqr  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise MissingExtraError("sparseqr", "suitesparse") from error
        self._rz = sparseqr.rz
        self._ordering: Ordering = ordering

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is R."""
        watch = Stopwatch()
        A, n = coo_matrix(system.A), system.pattern.shape[1]
        lengths = np.bincount(system.pattern.columns, system.values**2, n)
        build_s = watch.lap()
        z, R, permutation, rank = self._rz(A, system.b[:, None], ordering=_SPQR_ORDERINGS[self._ordering])
        factor_s = watch.lap()
        order = np.asarray(permutation, np.int64) if self._ordering == "colamd" else np.arange(n)
        R = csc_matrix(R)
        if rank < n or not np.all(np.abs(R.diagonal()) > LOST_DIGITS * np.sqrt(lengths[order])):
            raise undetermined(system)
        watch.lap()
        x = np.empty(n)
        x[order] = spsolve_triangular(R.tocsr(), np.asarray(z).reshape(-1)[:n], lower=False)
        solve_s = watch.lap()
        return Solution(x, build_s, factor_s, solve_s, lambda: Factor("R of A", R, order))
