"""Robust losses of loop edges, functions of the whitened residual χ alone, and their graduation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

Kernel = Literal["none", "huber", "cauchy", "geman-mcclure", "tukey", "truncated"]
GRADUATED: tuple[Kernel, ...] = ("geman-mcclure", "tukey", "truncated")

_TRUE_SHARE = 0.999  # share of true loops whose χ² stays below the limit, if the noise model is right
_SHARP = 1e4  # control above which truncated least squares is as good as its limit
_FLAT, _LONG_FACTOR = 1e-2, 4.0  # control below which truncated least squares is all but convex; its step there
_FACTOR = 1.4  # step of the graduation (Yang et al. 2020, remark 5)


@dataclass(frozen=True, slots=True)
class RobustLoss:
    """ρ(χ²) with weight w = dρ/dχ², so that w = 1 near zero whatever the scale.

    Attributes
    ----------
    kernel : which loss
    scale : s, the χ (a pure number) at which a residual starts to count less
    control : μ of graduated non-convexity (Yang et al. 2020); ∞ → convex, and 1, for geman-mcclure and tukey,
        where it widens s²; 0 → convex, and ∞, for truncated least squares
    """

    kernel: Kernel
    scale: float
    control: float

    def weight(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weight in [0, 1] of residuals with these χ²."""
        s2 = self.scale**2
        if self.kernel == "huber":
            return self.scale / np.sqrt(np.maximum(chi2, s2))
        if self.kernel == "cauchy":
            return s2 / (s2 + chi2)
        if self.kernel == "geman-mcclure":
            return (self.control * s2 / (self.control * s2 + chi2)) ** 2
        if self.kernel == "tukey":
            return np.maximum(1.0 - chi2 / (self.control * s2), 0.0) ** 2
        if self.kernel == "truncated":
            return self._truncated_weight(chi2)
        return np.ones_like(chi2)

    def loss(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """ρ(χ²), equal to χ² near zero."""
        s2 = self.scale**2
        if self.kernel == "huber":
            return np.where(chi2 <= s2, chi2, 2.0 * self.scale * np.sqrt(np.maximum(chi2, s2)) - s2)
        if self.kernel == "cauchy":
            return s2 * np.log1p(chi2 / s2)
        if self.kernel == "geman-mcclure":
            return chi2 * self.control * s2 / (self.control * s2 + chi2)
        if self.kernel == "tukey":
            share = np.minimum(chi2 / (self.control * s2), 1.0)
            return self.control * s2 * share * (1.0 - share + share**2 / 3.0)
        if self.kernel == "truncated":
            return self._truncated_loss(chi2)
        return chi2

    def started(self, chi2: NDArray[np.float64]) -> RobustLoss:
        """The convex end of the graduation for residuals that begin at these χ² (Yang et al. 2020, remark 5)."""
        ratio = 2.0 * float(chi2.max(initial=0.0)) / self.scale**2
        if self.kernel == "truncated":
            return replace(self, control=np.inf if ratio <= 2.0 else 1.0 / (ratio - 1.0))
        return replace(self, control=max(1.0, ratio))

    def tightened(self) -> RobustLoss:
        """The next, less convex loss."""
        if self.kernel == "truncated":
            factor = _FACTOR if self.control > _FLAT else _LONG_FACTOR
            return replace(self, control=self.control * factor if self.control < _SHARP else np.inf)
        return replace(self, control=max(1.0, self.control / _FACTOR))

    def settled(self, chi2: NDArray[np.float64]) -> bool:
        """Whether the graduation has reached its end: the loss itself, or weights that are all 0 or 1."""
        if self.kernel == "truncated":
            weight = self.weight(chi2)
            return bool(np.all((weight < 1e-6) | (weight > 1.0 - 1e-6)))
        return self.control <= 1.0

    def _truncated_weight(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        s2, mu = self.scale**2, self.control
        if np.isinf(mu):
            return (chi2 <= s2).astype(np.float64)
        middle = self.scale * np.sqrt(mu * (mu + 1.0) / np.maximum(chi2, 1e-300)) - mu
        return np.clip(middle, 0.0, 1.0)

    def _truncated_loss(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        s2, mu = self.scale**2, self.control
        if np.isinf(mu):
            return np.minimum(chi2, s2)
        middle = 2.0 * self.scale * np.sqrt(mu * (mu + 1.0) * np.maximum(chi2, 0.0)) - mu * (s2 + chi2)
        return np.where(chi2 <= mu / (mu + 1.0) * s2, chi2, np.where(chi2 >= (mu + 1.0) / mu * s2, s2, middle))


def rejection_limit(scale: float, degrees: int) -> float:
    """χ² above which a loop edge counts as false: its kernel's scale², but no true loop in a thousand."""
    return max(scale**2, 2.0 * float(gammaincinv(0.5 * degrees, _TRUE_SHARE)))


def robust_loss(kernel: Kernel, scale: float, degrees: int) -> RobustLoss:
    """The loss by its name; truncated least squares cuts where the verdict falls."""
    if kernel == "truncated":
        return RobustLoss(kernel, np.sqrt(rejection_limit(scale, degrees)), np.inf)
    return RobustLoss(kernel, scale, 1.0)
