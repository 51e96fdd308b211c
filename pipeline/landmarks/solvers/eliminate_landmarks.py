"""Elimination of the landmarks, which leaves a sparse system of the poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bmat, bsr_matrix, coo_matrix, csc_matrix

from scanchain.graph.solvers.cholesky import BlockPattern, SingularMatrixError, SparseCholesky, analyze
from scanchain.graph.solvers.factor_matrix import upper_factor
from scanchain.landmarks.solvers.solution import LOST_DIGITS, Factor, Solution, Stopwatch, undetermined
from scanchain.landmarks.system import LinearSystem


@dataclass(frozen=True, slots=True)
class _Reduced:
    """What is left for the poses, as the sparse Cholesky factorization takes it: its pattern, with the factor."""

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
        return Solution(x, build_s, factor_s, solve_s, lambda: _factor(roots, Y, reduced, split))

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
        """The factor of S; its analysis is kept while its pattern is the same."""
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


def _factor(roots: NDArray[np.float64], Y: csc_matrix, reduced: SparseCholesky, split: int) -> Factor:
    """U = [R, Y; 0, U_S], landmarks first, then the poses as they were eliminated."""
    order = reduced.analysis.order
    matrix = csc_matrix(bmat([[_block_diagonal(roots), Y[:, order]], [None, upper_factor(reduced)]]))
    return Factor("U of AᵀA", matrix, np.concatenate([split + np.arange(2 * len(roots)), order]))
