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
from scanchain.graph.solvers.cholesky import BlockPattern, analyze, front_rows
from scanchain.kernels.graph import symbolic
from scanchain.kernels.graph.fronts import Fronts, lay_out_fronts
from scanchain.kernels.landmarks import normal_equations, sparse_qr
from scanchain.landmarks.solvers.solution import LOST_DIGITS, Factor, Solution, Stopwatch, undetermined
from scanchain.landmarks.system import LinearSystem, Pattern

Ordering = Literal["natural", "colamd"]
_SPQR_ORDERINGS = {"natural": 0, "colamd": 2}  # SPQR_ORDERING_FIXED, SPQR_ORDERING_COLAMD


@dataclass(frozen=True, slots=True)
class _Analysis:
    """Analysis of the pattern: requested order, position of each column, fronts, and their rows of A."""

    order: NDArray[np.int64]
    place: NDArray[np.int64]
    fronts: Fronts
    begin: NDArray[np.int64]
    rows: NDArray[np.int64]
    height: NDArray[np.int64]
    stack_size: int


class QrSolver:
    """Householder QR of the project's own; its analysis is reused while the pattern is the same."""

    def __init__(self, ordering: Ordering) -> None:
        self._ordering: Ordering = ordering
        self._known: tuple[Pattern, _Analysis] | None = None

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is R."""
        watch = Stopwatch()
        analysis = self._analysis(system.pattern)
        build_s = watch.lap()
        fronts, pattern, n = analysis.fronts, system.pattern, system.pattern.shape[1]
        R, z = np.zeros(int(fronts.factor_start[-1])), np.zeros(n)
        sparse_qr.factorize(
            fronts, analysis.begin, analysis.rows, analysis.height, pattern.row_start, pattern.columns,
            system.values, system.b, analysis.place, R, z, np.empty(analysis.stack_size),
        )  # fmt: skip
        matrix = front_rows(fronts, R)
        factor_s = watch.lap()
        lengths = np.zeros(n)
        np.add.at(lengths, pattern.columns, system.values**2)
        diagonal = matrix.diagonal()[analysis.place]
        if not np.all(np.abs(diagonal) > LOST_DIGITS * np.sqrt(lengths)):
            raise undetermined(system)
        watch.lap()
        sparse_qr.back_substitute(fronts, R, z)
        x = z[analysis.place]
        solve_s = watch.lap()
        to_requested = analysis.place[analysis.order]
        return Solution(
            x, build_s, factor_s, solve_s,
            lambda: Factor("R of A", matrix[to_requested][:, to_requested].tocsc(), analysis.order),
        )  # fmt: skip

    def _analysis(self, pattern: Pattern) -> _Analysis:
        if self._known is None or self._known[0] is not pattern:
            self._known = pattern, _analyze(pattern, self._ordering)
        return self._known[1]


def _analyze(pattern: Pattern, ordering: Ordering) -> _Analysis:
    """Order the columns, those of "colamd" by minimum degree in AᵀA, and lay out the fronts.

    Within that order the fronts follow a postorder of the elimination tree, which leaves every entry of R as
    it is (Liu 1990), so that R can be given in the requested order.
    """
    n = pattern.shape[1]
    start, others, _ = normal_equations.product_structure(pattern.row_start, pattern.columns, *pattern.by_column())
    order = np.arange(n)
    if ordering == "colamd":
        pairs = np.stack([np.repeat(order, np.diff(start)), others], axis=1)
        order = analyze(BlockPattern(np.ones(n, np.int64), pairs)).order
    start, neighbors = _neighbor_lists(start, others)
    after = symbolic.postorder(symbolic.elimination_tree(start, neighbors, order))
    eliminated = order[after]
    parent = symbolic.elimination_tree(start, neighbors, eliminated)
    begin, below = symbolic.column_structures(start, neighbors, eliminated, parent)
    sizes = np.ones(n, np.int64)
    fronts = lay_out_fronts(symbolic.group_columns(parent, begin, below, sizes), begin, below, sizes)
    place = np.empty(n, np.int64)
    place[eliminated] = np.arange(n)
    found = sparse_qr.assign_rows(fronts, pattern.row_start, pattern.columns, place)
    return _Analysis(order, place, fronts, *found)


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
