"""``cholesky``: sparse factorization of AᵀA; ``schur``: the poses eliminated first; marginal covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, triu

from scanchain.data import Matrix
from scanchain.graph.cholesky import BlockPattern, SingularMatrixError, SparseCholesky, analyze, upper_factor
from scanchain.kernels.landmarks import arrow
from scanchain.landmarks.problem import LinearSystem, Pattern, landmark_columns, pose_columns
from scanchain.landmarks.solvers.direct import LOST_DIGITS, Factor, Factored, normal_equations, undetermined


class CholeskyMethod:
    """Multifrontal Cholesky of AᵀA; while the pattern is the same only the numbers are computed again."""

    build = staticmethod(normal_equations)

    def __init__(self) -> None:
        self._known: tuple[Pattern, SparseCholesky] | None = None

    def factorize(self, system: LinearSystem, built: tuple[csc_matrix, NDArray[np.float64]]) -> Factored:
        """U with AᵀA = UᵀU."""
        H, g = built
        if self._known is None or self._known[0] is not system.pattern:
            pairs = np.stack(triu(system.pattern.products(), k=1).nonzero(), axis=1).astype(np.int64)
            pattern = BlockPattern(np.ones(len(g), np.int64), pairs)
            self._known = system.pattern, SparseCholesky(pattern, analyze(pattern))
        cholesky = self._known[1]
        H.sum_duplicates()  # sorts it, so that entries are found by bisection
        cholesky.factorize(np.asarray(H[cholesky.pattern.rows, cholesky.pattern.columns]).ravel())
        U, order = upper_factor, cholesky.analysis.order
        return Factored(lambda: cholesky.solve(g), lambda: Factor("U of AᵀA", csc_matrix(U(cholesky)), order))


_WIDEST_BAND = 64  # widest band in scalars; beyond it poses are joined by more than odometry
_LARGEST_BORDER = 25_000_000  # largest number of entries of the dense border: 200 MB


class SchurMethod:
    """Two stages: S = C − B P⁻¹ Bᵀ of AᵀA = [P, Bᵀ; B, C], dense as it joins every two landmarks, then the rest.

    Poses joined by odometry alone make P banded. Where they are joined by more, or where fewer than the landmarks,
    or B too large to be kept dense, sparse Cholesky of the whole is faster and takes its place.
    """

    def __init__(self) -> None:
        self._known: tuple[Pattern, int] | None = None
        self._cholesky = CholeskyMethod()

    def build(self, system: LinearSystem) -> tuple[Arrow | csc_matrix, NDArray[np.float64]]:
        """AᵀA, as an arrow where that is faster, and Aᵀb."""
        pattern = system.pattern
        split, rest = pattern.layout.split, pattern.shape[1] - pattern.layout.split
        if self._known is None or self._known[0] is not pattern:
            self._known = pattern, arrow.bandwidth(pattern.row_start, pattern.columns, split)
        if self._known[1] > _WIDEST_BAND or rest > split or rest * split > _LARGEST_BORDER:
            return normal_equations(system)
        return _form(system, self._known[1])

    def factorize(self, system: LinearSystem, built: tuple[Arrow | csc_matrix, NDArray[np.float64]]) -> Factored:
        """U with AᵀA = UᵀU."""
        U, g = built
        if not isinstance(U, Arrow):
            return self._cholesky.factorize(system, (U, g))
        _eliminate(U)
        return Factored(lambda: _solved(U, g), lambda: _factor_of_arrow(U))


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
        pattern, self._layout = system.pattern, system.pattern.layout
        U, _ = _form(system, arrow.bandwidth(pattern.row_start, pattern.columns, pattern.layout.split))
        try:
            _eliminate(U)
        except SingularMatrixError as error:
            raise undetermined(system) from error
        self._band, self._border, self._corner = (np.empty_like(part) for part in (U.band, U.border, U.corner))
        arrow.invert(U.band, U.border, U.corner, self._band, self._border, self._corner)

    @property
    def poses(self) -> Matrix:
        """Of every pose, (K, p, p), relative to the first where that is held; m, rad."""
        return self.of(pose_columns(self._layout, np.arange(self._layout.poses)))

    @property
    def landmarks(self) -> Matrix:
        """Of every landmark, (L, 2, 2) m²."""
        return self.of(landmark_columns(self._layout, np.arange(len(self._layout.landmarks))))

    def of(self, columns: NDArray[np.int64]) -> Matrix:
        """Covariances of groups of unknowns, (N, c) columns of A to (N, c, c); NaN for poses far apart."""
        result = np.empty((*columns.shape, columns.shape[1]))
        arrow.blocks(self._band, self._border, self._corner, columns, result)
        return result


def _solved(U: Arrow, g: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve UᵀU x = g, in place of g."""
    poses, landmarks = np.split(g, [U.band.shape[1]])
    arrow.solve_forward(U.band, poses)
    landmarks -= poses @ U.border
    arrow.solve_corner(U.corner, landmarks)
    poses -= U.border @ landmarks
    arrow.solve_backward(U.band, poses)
    return g


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


def _eliminate(H: Arrow) -> None:
    """Turn AᵀA into its factor, in place: P = UᵀU banded, Y = U⁻ᵀ Bᵀ, S = C − YᵀY = UᵀU dense."""
    floor = LOST_DIGITS * H.corner.diagonal()
    failed = arrow.eliminate(H.band, H.border, LOST_DIGITS)
    if failed < 0:
        arrow.complement(H.corner, H.border)
        failed = arrow.eliminate_corner(H.corner, floor)
    if failed >= 0:
        raise SingularMatrixError(failed, failed)


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
