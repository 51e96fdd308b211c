"""Errors that keyframes share with the map they were aligned to, which the residuals of one scan do not show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.growing_array import GrowingArray


class KeyframeErrors(NamedTuple):
    """Errors of a keyframe's pose against the map, and of the map since the keyframe before.

    Attributes
    ----------
    variance_factor : of the covariance by the residuals, as in ``Match``
    systematic : (k, k) covariance by how sectors of the scans disagree, of a twist in the lidar's own frame
    renewal : share of the map that the lidar exchanged for another since the keyframe before, 0 to 1
    """

    variance_factor: float
    systematic: Matrix
    renewal: float


class MapErrors:
    """``KeyframeErrors`` of all keyframes, in columns."""

    def __init__(self, freedom: int) -> None:
        self._variance_factor = GrowingArray((), np.float64)
        self._systematic = GrowingArray((freedom, freedom), np.float64)
        self._renewal = GrowingArray((), np.float64)

    def __len__(self) -> int:
        return len(self._renewal)

    @property
    def variance_factor(self) -> NDArray[np.float64]:
        """(K,)."""
        return self._variance_factor.rows

    @property
    def systematic(self) -> Matrix:
        """(K, k, k)."""
        return self._systematic.rows

    @property
    def renewal(self) -> NDArray[np.float64]:
        """(K,)."""
        return self._renewal.rows

    def append(self, errors: KeyframeErrors) -> None:
        """Append those of the next keyframe."""
        self._variance_factor.append(errors.variance_factor)
        self._systematic.append(errors.systematic)
        self._renewal.append(errors.renewal)
