"""Student's t as a loss, of observations that are not all independent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_FREEDOM = 4.0
_SCALE2 = _FREEDOM + 2.0  # the weight (ν + 2) / (ν + χ²) is, but for a factor that σ takes up, s² / (s² + χ²)


@dataclass(frozen=True, slots=True)
class StudentLoss:
    """ρ(χ²) of a bearing and a range together, ν = 4, times what the observation counts as.

    Attributes
    ----------
    share : (N,) of an independent observation, above 0 up to 1
    """

    share: NDArray[np.float64]

    def weight(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """Up to the share, (N,)."""
        return self.share * _SCALE2 / (_SCALE2 + chi2)

    def loss(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """The share of χ² near zero, (N,)."""
        return self.share * _SCALE2 * np.log1p(chi2 / _SCALE2)
