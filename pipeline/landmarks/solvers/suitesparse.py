"""``spqr`` and ``spqr_colamd``: SuiteSparseQR (Davis 2011), where the package sparseqr is installed."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import spsolve_triangular

from scanchain.errors import MissingExtraError
from scanchain.landmarks.solvers.solution import LOST_DIGITS, Factor, Solution, Stopwatch, undetermined
from scanchain.landmarks.system import LinearSystem

_ORDERINGS = {"natural": 0, "colamd": 2}  # SPQR_ORDERING_FIXED, SPQR_ORDERING_COLAMD


class SuiteSparseQrSolver:
    """Householder QR with the fronts of SuiteSparse; GPL, so never part of the default installation."""

    def __init__(self, ordering: Literal["natural", "colamd"]) -> None:
        try:
            import sparseqr  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise MissingExtraError("sparseqr", "suitesparse") from error
        self._rz = sparseqr.rz
        self._ordering: Literal["natural", "colamd"] = ordering

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is R."""
        watch = Stopwatch()
        A, n = coo_matrix(system.A), system.pattern.shape[1]
        lengths = np.bincount(system.pattern.columns, system.values**2, n)
        build_s = watch.lap()
        z, R, permutation, rank = self._rz(A, system.b[:, None], ordering=_ORDERINGS[self._ordering])
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
