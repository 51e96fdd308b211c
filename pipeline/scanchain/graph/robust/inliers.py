"""Inlier set of the loop edges, and the price of leaving one out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

_MARGIN = 6.0  # factor over the share of a pessimistic noise model: residuals have long tails
_FEWEST = 10  # least number of inlier edges from which a noise model is estimated


@dataclass(frozen=True, slots=True)
class InlierSet:
    """Loop edges kept or not, as a loss: a kept edge costs its χ², another its price.

    Attributes
    ----------
    kept : (L,) bool, of the loop edges
    price : what leaving an edge out costs, in χ²
    """

    kept: NDArray[np.bool_]
    price: float
    kernel: Literal["truncated"] = "truncated"

    def weight(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """1 or 0, whatever the residuals."""
        return self.kept.astype(np.float64)

    def loss(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """χ² or the price."""
        return np.where(self.kept, chi2, self.price)


def fair_price(against: NDArray[np.float64], nominal: float, degrees: int) -> float:
    """The price, lowered where the contradictions of kept edges (L,) show that the noise model is pessimistic.

    Information matrices that are far too small would let in any edge. The median of the contradictions, against
    that of χ² with so many degrees of freedom, is the factor.
    """
    if len(against) < _FEWEST:
        return nominal
    expected = 2.0 * float(gammaincinv(0.5 * degrees, 0.5))
    return nominal * min(1.0, _MARGIN * float(np.median(against)) / expected)
