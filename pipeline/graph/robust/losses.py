"""Robust losses of loop edges, functions of the whitened residual χ alone, and their graduation.

A further one is two functions and a line in ``LOSSES``, and its name among the choices of ``graph.robust``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

Array = NDArray[np.float64]
OfResiduals = Callable[[Array, float, float], Array]  # of χ² (N,), the scale s and the control μ

_TRUE_SHARE = 0.999  # share of true loops whose χ² stays below the limit, if the noise model is right
_SHARP = 1e4  # control above which truncated least squares is as good as its limit
_FLAT, _LONG_FACTOR = 1e-2, 4.0  # control below which truncated least squares is all but convex; its step there
_FACTOR = 1.4  # step of the graduation (Yang et al. 2020, remark 5)


@dataclass(frozen=True, slots=True)
class Schedule:
    """Graduated non-convexity (Yang et al. 2020, remark 5) as a sequence of controls μ.

    Attributes
    ----------
    first : the convex end, from 2 χ²/s² of the largest residual
    following : the next, less convex control
    is_over : whether the loss itself is reached, from μ and the weights (N,)
    """

    first: Callable[[float], float]
    following: Callable[[float], float]
    is_over: Callable[[float, Array], bool]


@dataclass(frozen=True, slots=True)
class Kernel:
    """A loss by its functions.

    Attributes
    ----------
    weight : w = dρ/dχ² in [0, 1], 1 near zero whatever the scale
    loss : ρ(χ²), equal to χ² near zero
    schedule : of its graduation, None where it is minimized as it is
    """

    weight: OfResiduals
    loss: OfResiduals
    schedule: Schedule | None = None


def _quadratic_weight(chi2: Array, s: float, mu: float) -> Array:
    return np.ones_like(chi2)


def _quadratic_loss(chi2: Array, s: float, mu: float) -> Array:
    return chi2


def _huber_weight(chi2: Array, s: float, mu: float) -> Array:
    return s / np.sqrt(np.maximum(chi2, s**2))


def _huber_loss(chi2: Array, s: float, mu: float) -> Array:
    s2 = s**2
    return np.where(chi2 <= s2, chi2, 2.0 * s * np.sqrt(np.maximum(chi2, s2)) - s2)


def _cauchy_weight(chi2: Array, s: float, mu: float) -> Array:
    return s**2 / (s**2 + chi2)


def _cauchy_loss(chi2: Array, s: float, mu: float) -> Array:
    return s**2 * np.log1p(chi2 / s**2)


def _geman_mcclure_weight(chi2: Array, s: float, mu: float) -> Array:
    return (mu * s**2 / (mu * s**2 + chi2)) ** 2


def _geman_mcclure_loss(chi2: Array, s: float, mu: float) -> Array:
    return chi2 * mu * s**2 / (mu * s**2 + chi2)


def _tukey_weight(chi2: Array, s: float, mu: float) -> Array:
    return np.maximum(1.0 - chi2 / (mu * s**2), 0.0) ** 2


def _tukey_loss(chi2: Array, s: float, mu: float) -> Array:
    share = np.minimum(chi2 / (mu * s**2), 1.0)
    return mu * s**2 * share * (1.0 - share + share**2 / 3.0)


def _truncated_weight(chi2: Array, s: float, mu: float) -> Array:
    if np.isinf(mu):
        return (chi2 <= s**2).astype(np.float64)
    middle = s * np.sqrt(mu * (mu + 1.0) / np.maximum(chi2, 1e-300)) - mu
    return np.clip(middle, 0.0, 1.0)


def _truncated_loss(chi2: Array, s: float, mu: float) -> Array:
    s2 = s**2
    if np.isinf(mu):
        return np.minimum(chi2, s2)
    middle = 2.0 * s * np.sqrt(mu * (mu + 1.0) * np.maximum(chi2, 0.0)) - mu * (s2 + chi2)
    return np.where(chi2 <= mu / (mu + 1.0) * s2, chi2, np.where(chi2 >= (mu + 1.0) / mu * s2, s2, middle))


def _sharpened(mu: float) -> float:
    """The next control of truncated least squares."""
    factor = _FACTOR if mu > _FLAT else _LONG_FACTOR
    return mu * factor if mu < _SHARP else np.inf


_WIDENED = Schedule(  # μ ≥ 1 widens s²: ∞ is convex, 1 the loss itself
    first=lambda ratio: max(1.0, ratio),
    following=lambda mu: max(1.0, mu / _FACTOR),
    is_over=lambda mu, weight: mu <= 1.0,
)
_SURROGATE = Schedule(  # of truncated least squares: 0 is convex, ∞ the loss itself
    first=lambda ratio: np.inf if ratio <= 2.0 else 1.0 / (ratio - 1.0),
    following=_sharpened,
    is_over=lambda mu, weight: bool(np.all((weight < 1e-6) | (weight > 1.0 - 1e-6))),
)

LOSSES = {
    "none": Kernel(_quadratic_weight, _quadratic_loss),
    "huber": Kernel(_huber_weight, _huber_loss),
    "cauchy": Kernel(_cauchy_weight, _cauchy_loss),
    "geman-mcclure": Kernel(_geman_mcclure_weight, _geman_mcclure_loss, _WIDENED),
    "tukey": Kernel(_tukey_weight, _tukey_loss, _WIDENED),
    "truncated": Kernel(_truncated_weight, _truncated_loss, _SURROGATE),
}


@dataclass(frozen=True, slots=True)
class RobustLoss:
    """ρ(χ²) with weight w = dρ/dχ², so that w = 1 near zero whatever the scale.

    Attributes
    ----------
    kernel : which of ``LOSSES``
    scale : s, the χ (a pure number) at which a residual starts to count less
    control : μ of the graduation; 1, or ∞ for truncated least squares, is the loss itself
    """

    kernel: str
    scale: float
    control: float

    def weight(self, chi2: Array) -> Array:
        """Weight in [0, 1] of residuals with these χ²."""
        return LOSSES[self.kernel].weight(chi2, self.scale, self.control)

    def loss(self, chi2: Array) -> Array:
        """ρ(χ²), equal to χ² near zero."""
        return LOSSES[self.kernel].loss(chi2, self.scale, self.control)

    def graduation(self, chi2: Array) -> Graduation | None:
        """Its graduation from the convex end, for residuals that begin at these χ²; None where it has none."""
        schedule = LOSSES[self.kernel].schedule
        if schedule is None:
            return None
        ratio = 2.0 * float(chi2.max(initial=0.0)) / self.scale**2
        return Graduation(replace(self, control=schedule.first(ratio)), schedule)


class Graduation:
    """The present ``loss``, made less convex step by step."""

    def __init__(self, loss: RobustLoss, schedule: Schedule) -> None:
        self.loss = loss
        self._schedule = schedule

    def is_over(self, chi2: Array) -> bool:
        """True at the end of the schedule: the loss itself, or weights that are all 0 or 1."""
        return self._schedule.is_over(self.loss.control, self.loss.weight(chi2))

    def tighten(self) -> None:
        """Go on to the next, less convex loss."""
        self.loss = replace(self.loss, control=self._schedule.following(self.loss.control))


def rejection_limit(scale: float, degrees: int) -> float:
    """χ² above which a loop edge counts as false: its kernel's scale², but no true loop in a thousand."""
    return max(scale**2, 2.0 * float(gammaincinv(0.5 * degrees, _TRUE_SHARE)))


def robust_loss(kernel: str, scale: float, degrees: int) -> RobustLoss:
    """The loss by its name; truncated least squares cuts where the verdict falls."""
    if kernel == "truncated":
        return RobustLoss(kernel, np.sqrt(rejection_limit(scale, degrees)), np.inf)
    return RobustLoss(kernel, scale, 1.0)
