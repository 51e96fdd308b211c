"""``cholesky``: sparse factorization of AᵀA; ``schur``: the poses eliminated first; marginal covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from scanchain.data import Matrix
from scanchain.graph.cholesky import (
    BlockPattern,
    SingularMatrixError,
    SparseCholesky,
    analyze,
    upper_factor,
)
from scanchain.kernels.landmarks import arrow, normal_equations
from scanchain.landmarks.problem import LinearSystem, Pattern
from scanchain.landmarks.solvers.direct import LOST_DIGITS, Factor, Solution, Stopwatch, undetermined


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


_WIDEST_BAND = 64  # widest band in scalars; beyond it poses are joined by more than odometry
_LARGEST_BORDER = 25_000_000  # largest number of entries of the dense border: 200 MB


class SchurSolver:
    """Two stages: S = C − B P⁻¹ Bᵀ of AᵀA = [P, Bᵀ; B, C], then the rest.

    Poses joined by odometry alone make P banded. Where they are joined by more, or where fewer than the landmarks,
    or B too large to be kept dense, sparse Cholesky of the whole is faster and takes its place.
    """

    def __init__(self) -> None:
        self._known: tuple[Pattern, int] | None = None
        self._cholesky = CholeskySolver()

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is U with AᵀA = UᵀU."""
        pattern = system.pattern
        if self._known is None or self._known[0] is not pattern:
            layout = pattern.layout
            self._known = pattern, arrow.bandwidth(pattern.row_start, pattern.columns, layout.split)
        split, rest = pattern.layout.split, pattern.shape[1] - pattern.layout.split
        if self._known[1] > _WIDEST_BAND or rest > split or rest * split > _LARGEST_BORDER:
            return self._cholesky.solve(system)
        return _eliminate_poses(system, self._known[1])


@dataclass(frozen=True, slots=True)
class Arrow:
    """U of AᵀA = UᵀU, or AᵀA before it is factored: band and border (split, n − split) of the poses, corner."""

    band: NDArray[np.float64]
    border: NDArray[np.float64]
    corner: NDArray[np.float64]


class Covariance:
    """(AᵀA)⁻¹ between neighboring poses, between poses and landmarks, and between landmarks; never all of it."""

    def __init__(self, system: LinearSystem) -> None:
        """Raises UndeterminedError where A has not full column rank."""
        pattern = system.pattern
        U, _ = _form(system, arrow.bandwidth(pattern.row_start, pattern.columns, pattern.layout.split))
        _eliminate(U, system)
        self._band, self._border, self._corner = (np.empty_like(part) for part in (U.band, U.border, U.corner))
        arrow.invert(U.band, U.border, U.corner, self._band, self._border, self._corner)

    def of(self, columns: NDArray[np.int64]) -> Matrix:
        """Covariances of groups of unknowns, (N, c) columns of A to (N, c, c); NaN for poses far apart."""
        result = np.empty((*columns.shape, columns.shape[1]))
        arrow.blocks(self._band, self._border, self._corner, columns, result)
        return result


def _eliminate_poses(system: LinearSystem, width: int) -> Solution:
    """P = UᵀU banded, Y = U⁻ᵀ Bᵀ, S = C − YᵀY dense: it joins every two landmarks anyway."""
    watch = Stopwatch()
    U, g = _form(system, width)
    build_s = watch.lap()
    _eliminate(U, system)
    factor_s = watch.lap()
    poses, landmarks = np.split(g, [U.band.shape[1]])
    arrow.solve_forward(U.band, poses)
    landmarks -= poses @ U.border
    arrow.solve_corner(U.corner, landmarks)
    poses -= U.border @ landmarks
    arrow.solve_backward(U.band, poses)
    solve_s = watch.lap()
    return Solution(g, build_s, factor_s, solve_s, lambda: _factor_of_arrow(U))


def _form(system: LinearSystem, width: int) -> tuple[Arrow, NDArray[np.float64]]:
    """AᵀA as an arrow, and Aᵀb."""
    pattern = system.pattern
    n, split = pattern.shape[1], pattern.layout.split
    H = Arrow(np.zeros((width + 1, split)), np.zeros((split, n - split)), np.zeros((n - split, n - split)))
    g = np.zeros(n)
    arrow.products(
        pattern.row_start, pattern.columns, system.values, system.b, split, H.band, H.border, H.corner, g
    )
    return H, g


def _eliminate(H: Arrow, system: LinearSystem) -> None:
    """Turn AᵀA into its factor, in place."""
    floor = LOST_DIGITS * H.corner.diagonal()
    if arrow.eliminate(H.band, H.border, LOST_DIGITS) >= 0:
        raise undetermined(system)
    arrow.complement(H.corner, H.border)
    if arrow.eliminate_corner(H.corner, floor) >= 0:
        raise undetermined(system)


def _factor_of_arrow(U: Arrow) -> Factor:
    """The three parts put together, with every entry that may fill in."""
    width, split = U.band.shape[0] - 1, U.band.shape[1]
    n, rest = split + len(U.corner), len(U.corner)
    places = np.indices(U.band.shape).reshape(2, -1)
    below, right = places[:, places.sum(axis=0) >= width]  # the corner of a band's storage is not part of it
    pose, landmark = np.indices(U.border.shape)
    upper, lower = np.triu_indices(rest)
    rows = np.concatenate([below + right - width, pose.ravel(), split + upper])
    columns = np.concatenate([right, split + landmark.ravel(), split + lower])
    values = np.concatenate([U.band[below, right], U.border.ravel(), U.corner[upper, lower]])
    return Factor("U of AᵀA", csc_matrix((values, (rows, columns)), shape=(n, n)), np.arange(n))
