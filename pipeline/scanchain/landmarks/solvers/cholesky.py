"""``cholesky``: the project's own sparse factorization of AᵀA in a fill-reducing order, its analysis kept."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from scanchain.graph.solvers.cholesky import (
    BlockPattern,
    SingularMatrixError,
    SparseCholesky,
    analyze,
    upper_factor,
)
from scanchain.kernels.landmarks import normal_equations
from scanchain.landmarks.solvers.solution import Factor, Solution, Stopwatch, undetermined
from scanchain.landmarks.system import LinearSystem, Pattern


class NormalEquations:
    """H = AᵀA and g = Aᵀb for one pattern of A; where every product of two entries goes is found once.

    ``pattern`` is that of H, the values are its diagonal and then its pairs.
    """

    def __init__(self, pattern: Pattern) -> None:
        n = pattern.shape[1]
        start, others, self._slots = normal_equations.product_structure(
            pattern.row_start, pattern.columns, *pattern.by_column()
        )
        owners = np.repeat(np.arange(n), np.diff(start))
        self.pattern = BlockPattern(np.ones(n, np.int64), np.stack([owners, others], axis=1))

    def form(self, system: LinearSystem) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values of H and g."""
        H, g = np.empty(self.pattern.value_count), np.empty(self.pattern.scalars)
        pattern = system.pattern
        normal_equations.products(pattern.row_start, pattern.columns, system.values, system.b, self._slots, H, g)
        return H, g


class CholeskySolver:
    """Multifrontal Cholesky of AᵀA; while the pattern is the same only the numbers are computed again."""

    def __init__(self) -> None:
        self._known: tuple[Pattern, NormalEquations, SparseCholesky] | None = None

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is U with AᵀA = UᵀU."""
        watch = Stopwatch()
        equations, cholesky = self._prepared(system.pattern)
        H, g = equations.form(system)
        build_s = watch.lap()
        try:
            cholesky.factorize(H)
        except SingularMatrixError as error:
            raise undetermined(system) from error
        factor_s = watch.lap()
        x = cholesky.solve(g)
        solve_s = watch.lap()
        return Solution(x, build_s, factor_s, solve_s, lambda: _factor(cholesky))

    def _prepared(self, pattern: Pattern) -> tuple[NormalEquations, SparseCholesky]:
        if self._known is None or self._known[0] is not pattern:
            equations = NormalEquations(pattern)
            cholesky = SparseCholesky(equations.pattern, analyze(equations.pattern))
            self._known = pattern, equations, cholesky
        return self._known[1:]


def _factor(cholesky: SparseCholesky) -> Factor:
    return Factor("U of AᵀA", csc_matrix(upper_factor(cholesky)), cholesky.analysis.order)
