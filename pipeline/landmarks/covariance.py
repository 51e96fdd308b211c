"""Marginal covariances of an estimate from its sparse factor, without the dense inverse."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.kernels.landmarks import arrow
from scanchain.landmarks.solvers.schur import factor_arrow
from scanchain.landmarks.system import LinearSystem


class Covariance:
    """(AᵀA)⁻¹ between neighboring poses, between poses and landmarks, and between landmarks."""

    def __init__(self, system: LinearSystem) -> None:
        """Raises UndeterminedError where A has not full column rank."""
        U = factor_arrow(system)
        self._band, self._border, self._corner = (np.empty_like(part) for part in (U.band, U.border, U.corner))
        arrow.invert(U.band, U.border, U.corner, self._band, self._border, self._corner)

    def of(self, columns: NDArray[np.int64]) -> Matrix:
        """Covariances of groups of unknowns, (N, c) columns of A to (N, c, c); NaN for poses far apart."""
        result = np.empty((*columns.shape, columns.shape[1]))
        arrow.blocks(self._band, self._border, self._corner, columns, result)
        return result
