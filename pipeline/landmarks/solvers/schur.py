"""``schur``: eliminate the poses, or the landmarks, and solve what is left for the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix

from pipeline.kernels import arrow
from pipeline.landmarks.solvers.eliminate_landmarks import LandmarkElimination
from pipeline.landmarks.solvers.solution import LOST_DIGITS, Factor, Solution, Stopwatch, undetermined
from pipeline.landmarks.system import LinearSystem, Pattern

_WIDEST_BAND = 64  # scalars; beyond it poses are joined by more than odometry
_LARGEST_BORDER = 25_000_000  # numbers of the dense border, 200 MB


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
class _Arrow:
    """U of the arrow: the band of P, the border Y = U_P⁻ᵀ Bᵀ, the corner U_S."""

    band: NDArray[np.float64]
    border: NDArray[np.float64]
    corner: NDArray[np.float64]


def _eliminate_poses(system: LinearSystem, width: int) -> Solution:
    """P = UᵀU banded, Y = U⁻ᵀ Bᵀ, S = C − YᵀY dense: it joins every two landmarks anyway."""
    watch = Stopwatch()
    pattern = system.pattern
    n, split = pattern.shape[1], pattern.layout.split
    band, Y = np.zeros((width + 1, split)), np.zeros((split, n - split))
    corner, g = np.zeros((n - split, n - split)), np.zeros(n)
    arrow.products(pattern.row_start, pattern.columns, system.values, system.b, split, band, Y, corner, g)
    diagonal = corner.diagonal()
    build_s = watch.lap()
    if arrow.eliminate(band, Y, LOST_DIGITS) >= 0:
        raise undetermined(system)
    arrow.complement(corner, Y)
    if arrow.eliminate_corner(corner, LOST_DIGITS * diagonal) >= 0:
        raise undetermined(system)
    factor_s = watch.lap()
    poses = g[:split]
    arrow.solve_forward(band, poses)
    landmarks = g[split:] - poses @ Y
    arrow.solve_corner(corner, landmarks)
    poses -= Y @ landmarks
    arrow.solve_backward(band, poses)
    solve_s = watch.lap()
    x = np.concatenate([poses, landmarks])
    return Solution(x, build_s, factor_s, solve_s, lambda: _factor(_Arrow(band, Y, np.triu(corner))))


def _factor(U: _Arrow) -> Factor:
    """The three parts put together."""
    width, split = U.band.shape[0] - 1, U.band.shape[1]
    n = split + len(U.corner)
    below, right = np.nonzero(U.band)
    inside = below + right >= width  # the corner of a band's storage is not part of it
    below, right = below[inside], right[inside]
    border, corner = coo_matrix(U.border), coo_matrix(U.corner)
    rows = np.concatenate([below + right - width, border.row, corner.row + split])
    columns = np.concatenate([right, border.col + split, corner.col + split])
    values = np.concatenate([U.band[below, right], border.data, corner.data])
    return Factor("U of AᵀA", csc_matrix((values, (rows, columns)), shape=(n, n)), np.arange(n))
