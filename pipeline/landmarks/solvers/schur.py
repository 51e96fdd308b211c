"""``schur``: the Schur complement, eliminating the poses or the landmarks, solved for the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bmat, bsr_matrix, coo_matrix, csc_matrix

from scanchain.graph.solvers.cholesky import (
    BlockPattern,
    SingularMatrixError,
    SparseCholesky,
    analyze,
    upper_factor,
)
from scanchain.kernels.landmarks import arrow
from scanchain.landmarks.solvers.solution import LOST_DIGITS, Factor, Solution, Stopwatch, undetermined
from scanchain.landmarks.system import LinearSystem, Pattern

_WIDEST_BAND = 64  # widest band in scalars; beyond it poses are joined by more than odometry
_LARGEST_BORDER = 25_000_000  # largest number of entries of the dense border: 200 MB


@dataclass(frozen=True, slots=True)
class _Reduced:
    """The reduced system of the poses: its pattern, with the sparse Cholesky factor."""

    rows: NDArray[np.int32]
    columns: NDArray[np.int32]
    cholesky: SparseCholesky


class LandmarkElimination:
    """S = P − Bᵀ C⁻¹ B with C in blocks of 2 × 2, one a landmark; S is factored in a fill-reducing order.

    A calibration of the robot, where there is one, stays in P with the poses.
    """

    def __init__(self) -> None:
        self._known: _Reduced | None = None

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is U with AᵀA = UᵀU, the landmarks first."""
        watch = Stopwatch()
        split = system.pattern.layout.landmark_start
        A = csc_matrix(system.A)
        of_poses, of_landmarks = A[:, :split], A[:, split:]
        P, B = csc_matrix(of_poses.T @ of_poses), csc_matrix(of_landmarks.T @ of_poses)
        g_poses, g_landmarks = of_poses.T @ system.b, of_landmarks.T @ system.b
        blocks = _diagonal_blocks(of_landmarks)
        build_s = watch.lap()
        roots = self._roots(blocks, system)  # R of C = RᵀR
        inverse = csc_matrix(_block_diagonal(np.asarray(np.linalg.inv(roots), np.float64)))
        Y = csc_matrix(inverse.T @ B)
        S = csc_matrix(P - Y.T @ Y)
        reduced = self._factored(S, _diagonal(P), system)
        factor_s = watch.lap()
        forward = inverse.T @ g_landmarks
        poses = reduced.solve(g_poses - Y.T @ forward)
        landmarks = inverse @ (forward - Y @ poses)
        solve_s = watch.lap()
        x = np.concatenate([poses, landmarks])
        return Solution(x, build_s, factor_s, solve_s, lambda: _factor_of_roots(roots, Y, reduced, split))

    def _roots(self, blocks: NDArray[np.float64], system: LinearSystem) -> NDArray[np.float64]:
        """Upper triangular root of every block (L, 2, 2)."""
        a, b, c = blocks[:, 0, 0], blocks[:, 0, 1], blocks[:, 1, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            rest = c - b * b / a
        if not np.all((a > 0.0) & (rest > LOST_DIGITS * c)):
            raise undetermined(system)
        roots = np.zeros_like(blocks)
        roots[:, 0, 0], roots[:, 0, 1], roots[:, 1, 1] = np.sqrt(a), b / np.sqrt(a), np.sqrt(rest)
        return roots

    def _factored(self, S: csc_matrix, diagonal: NDArray[np.float64], system: LinearSystem) -> SparseCholesky:
        """The factor of S; its analysis is reused while its pattern is the same."""
        lower = coo_matrix(S)
        beyond = lower.row > lower.col
        rows, columns = lower.row[beyond], lower.col[beyond]
        known = self._known
        if known is None or not (np.array_equal(rows, known.rows) and np.array_equal(columns, known.columns)):
            pairs = np.stack([rows, columns], axis=1).astype(np.int64)
            pattern = BlockPattern(np.ones(len(diagonal), np.int64), pairs)
            known = _Reduced(rows, columns, SparseCholesky(pattern, analyze(pattern)))
            self._known = known
        if not np.all(_diagonal(S) > LOST_DIGITS * diagonal):
            raise undetermined(system)
        try:
            known.cholesky.factorize(
                np.concatenate([_diagonal(S), lower.data[beyond]]).astype(np.float64, copy=False)
            )
        except SingularMatrixError as error:
            raise undetermined(system) from error
        return known.cholesky


def _diagonal_blocks(of_landmarks: csc_matrix) -> NDArray[np.float64]:
    """C = AᵀA of the landmarks' columns, (L, 2, 2); no row joins two landmarks."""
    x, y = of_landmarks[:, 0::2], of_landmarks[:, 1::2]
    xx, yy, xy = (np.asarray(a.multiply(b).sum(axis=0)).ravel() for a, b in ((x, x), (y, y), (x, y)))
    return np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)


def _diagonal(matrix: csc_matrix) -> NDArray[np.float64]:
    return np.asarray(matrix.diagonal(), np.float64)


def _block_diagonal(blocks: NDArray[np.float64]) -> bsr_matrix:
    count = len(blocks)
    return bsr_matrix((blocks, np.arange(count), np.arange(count + 1)), shape=(2 * count, 2 * count))


def _factor_of_roots(roots: NDArray[np.float64], Y: csc_matrix, reduced: SparseCholesky, split: int) -> Factor:
    """U = [R, Y; 0, U_S], landmarks first, then the poses as they were eliminated."""
    order = reduced.analysis.order
    matrix = csc_matrix(bmat([[_block_diagonal(roots), Y[:, order]], [None, upper_factor(reduced)]]))
    return Factor("U of AᵀA", matrix, np.concatenate([split + np.arange(2 * len(roots)), order]))


class SchurSolver:
    """Two stages: S = C − B P⁻¹ Bᵀ of AᵀA = [P, Bᵀ; B, C], then the rest.

    Poses joined by odometry alone make P banded, landmarks make C block diagonal. The larger of the two is
    eliminated, unless the border of the poses would be too large to be kept dense.
    """

    def __init__(self) -> None:
        self._known: tuple[Pattern, int] | None = None
        self._landmarks_first = LandmarkElimination()

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is U with AᵀA = UᵀU, the eliminated columns first."""
        pattern = system.pattern
        if self._known is None or self._known[0] is not pattern:
            layout = pattern.layout
            self._known = pattern, arrow.bandwidth(pattern.row_start, pattern.columns, layout.split)
        split, rest = pattern.layout.split, pattern.shape[1] - pattern.layout.split
        if self._known[1] > _WIDEST_BAND or rest > split or rest * split > _LARGEST_BORDER:
            return self._landmarks_first.solve(system)
        return _eliminate_poses(system, self._known[1])


@dataclass(frozen=True, slots=True)
class Arrow:
    """U of AᵀA = UᵀU, or AᵀA before it is factored: band and border (split, n − split) of the poses, corner."""

    band: NDArray[np.float64]
    border: NDArray[np.float64]
    corner: NDArray[np.float64]


def factor_arrow(system: LinearSystem) -> Arrow:
    """U of a system whose poses are joined in a chain; raises UndeterminedError where there is none."""
    pattern = system.pattern
    parts, _ = _form(system, arrow.bandwidth(pattern.row_start, pattern.columns, pattern.layout.split))
    _eliminate(parts, system)
    return parts


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
