"""Robust losses of loop edges, and their schedules of graduated non-convexity (GNC)."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from scipy.special import gammaincinv

from scanchain import plugins
from scanchain.config import LOSSES
from scanchain.data import Integers, Mask, Vector
from scanchain.errors import InputError, one_line

_SHARP = 1e4  # control above which truncated least squares is replaced by its limit
_FLAT, _LONG_FACTOR = 1e-2, 4.0  # control below which truncated least squares is almost convex; its factor there
_FACTOR = 1.4  # ratio of successive controls (Yang et al. 2020, remark 5)
_MARGIN = 6.0  # safety factor on the price under a pessimistic noise model: residuals have long tails
_FEWEST = 10  # least number of inlier edges from which a noise model is estimated


class Kernel(Protocol):
    """A robust loss as functions of χ² (N,), the scale s, and the control μ of its GNC schedule.

    A non-convex loss may have a method ``schedule(ratio)`` with the controls of graduated non-convexity (Yang et
    al. 2020, remark 5), from a convex loss to the loss itself; the ratio is 2 χ²/s² of the largest residual.
    Without this method the loss is minimized directly, with μ = 1.
    """

    def weight(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Weight w = dρ/dχ² in [0, 1], 1 near zero for any scale."""
        ...

    def loss(self, chi2: Vector, s: float, mu: float) -> Vector:
        """ρ(χ²), equal to χ² near zero."""
        ...


def _widened(ratio: float) -> Iterator[float]:
    """Controls μ ≥ 1 that widen s²: ∞ is convex, 1 the loss itself."""
    mu = max(1.0, ratio)
    while mu > 1.0:
        yield mu
        mu = max(1.0, mu / _FACTOR)
    yield 1.0


def _sharpened(ratio: float) -> Iterator[float]:
    """Controls of truncated least squares: 0 is convex, ∞ the loss itself."""
    mu = np.inf if ratio <= 2.0 else 1.0 / (ratio - 1.0)
    while mu < np.inf:
        yield mu
        factor = _FACTOR if mu > _FLAT else _LONG_FACTOR
        mu = mu * factor if mu < _SHARP else np.inf
    yield np.inf


class Quadratic:
    """ρ = χ²: no robust loss."""

    def weight(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Weight w = 1."""
        return np.ones_like(chi2)

    def loss(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Loss ρ = χ²."""
        return chi2


class Huber:
    """Huber 1964: linear in χ above s."""

    def weight(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Weight w = min(1, s/χ)."""
        return s / np.sqrt(np.maximum(chi2, s**2))

    def loss(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Loss ρ = 2 s χ − s² above s."""
        s2 = s**2
        return np.where(chi2 <= s2, chi2, 2.0 * s * np.sqrt(np.maximum(chi2, s2)) - s2)


class Cauchy:
    """Loss of the Cauchy distribution: grows without bound, but slowly."""

    def weight(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Weight w = s² / (s² + χ²)."""
        return s**2 / (s**2 + chi2)

    def loss(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Loss ρ = s² log(1 + χ²/s²)."""
        return s**2 * np.log1p(chi2 / s**2)


class GemanMcClure:
    """Geman and McClure 1985: bounded by s²."""

    schedule = staticmethod(_widened)

    def weight(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Weight w = (μ s² / (μ s² + χ²))²."""
        return (mu * s**2 / (mu * s**2 + chi2)) ** 2

    def loss(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Loss ρ = μ s² χ² / (μ s² + χ²)."""
        return chi2 * mu * s**2 / (mu * s**2 + chi2)


class Tukey:
    """Biweight of Beaton and Tukey 1974: constant above √μ s."""

    schedule = staticmethod(_widened)

    def weight(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Weight w = (1 − χ²/(μ s²))² or 0."""
        return np.maximum(1.0 - chi2 / (mu * s**2), 0.0) ** 2

    def loss(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Loss ρ = μ s² (1 − (1 − χ²/(μ s²))³) / 3, or μ s²/3."""
        share = np.minimum(chi2 / (mu * s**2), 1.0)
        return mu * s**2 * share * (1.0 - share + share**2 / 3.0)


class Truncated:
    """Truncated least squares by its surrogates (Yang et al. 2020, eq. 14): constant above s."""

    schedule = staticmethod(_sharpened)

    def weight(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Weight w = 1 or 0, and s √(μ (μ + 1))/χ − μ between."""
        if np.isinf(mu):
            return (chi2 <= s**2).astype(np.float64)
        middle = s * np.sqrt(mu * (mu + 1.0) / np.maximum(chi2, 1e-300)) - mu
        return np.clip(middle, 0.0, 1.0)

    def loss(self, chi2: Vector, s: float, mu: float) -> Vector:
        """Loss ρ = min(χ², s²), and 2 s χ √(μ (μ + 1)) − μ (s² + χ²) between."""
        s2 = s**2
        if np.isinf(mu):
            return np.minimum(chi2, s2)
        middle = 2.0 * s * np.sqrt(mu * (mu + 1.0) * np.maximum(chi2, 0.0)) - mu * (s2 + chi2)
        return np.where(chi2 <= mu / (mu + 1.0) * s2, chi2, np.where(chi2 >= (mu + 1.0) / mu * s2, s2, middle))


@dataclass(frozen=True, slots=True)
class RobustLoss:
    """ρ(χ²) with weight w = dρ/dχ², so that w = 1 near zero for any scale.

    kernel : name in ``LOSSES``, or module:Class
    scale : s, the χ (a pure number) at which a residual starts to be downweighted
    control : μ of the GNC schedule; 1, or ∞ for truncated least squares, is the loss itself
    """

    kernel: str
    scale: float
    control: float

    def weight(self, chi2: Vector) -> Vector:
        """Weight in [0, 1] of residuals with these χ²."""
        return _kernel(self.kernel).weight(chi2, self.scale, self.control)

    def loss(self, chi2: Vector) -> Vector:
        """ρ(χ²), equal to χ² near zero."""
        return _kernel(self.kernel).loss(chi2, self.scale, self.control)

    def graduated(self, chi2: Vector) -> Iterator[RobustLoss]:
        """Losses of its GNC schedule, from a convex one, for residuals that begin at these χ², to itself."""
        schedule = getattr(_kernel(self.kernel), "schedule", None)
        ratio = 2.0 * float(chi2.max(initial=0.0)) / self.scale**2
        for control in schedule(ratio) if schedule else (self.control,):
            yield replace(self, control=control)


def rejection_limit(scale: float, degrees: int) -> float:
    """χ² above which an edge is an outlier: the kernel's scale², at least the 99.9 % quantile of inliers."""
    return max(scale**2, 2.0 * float(gammaincinv(0.5 * degrees, 0.999)))


def limit_shares(scale: float, residuals: Integers, freedom: int) -> Vector:
    """``rejection_limit`` of edges with these numbers of residuals (E,), as shares of that of a whole pose."""
    limits = np.array([rejection_limit(scale, max(count, 1)) for count in range(freedom + 1)])
    return limits[residuals] / limits[freedom]


def robust_loss(kernel: str, scale: float, degrees: int) -> RobustLoss:
    """The loss of this name; truncated least squares truncates at ``rejection_limit``.

    Raises InputError if a user-defined class cannot be loaded or is not a loss.
    """
    if kernel == "truncated":
        return RobustLoss(kernel, np.sqrt(rejection_limit(scale, degrees)), np.inf)
    loss = RobustLoss(kernel, scale, 1.0)
    if kernel not in LOSSES:
        _check(loss)
    return loss


@functools.cache
def _kernel(name: str) -> Kernel:
    return plugins.load(LOSSES.get(name, name), "weight", "loss")()


def _check(loss: RobustLoss) -> None:
    """Raise InputError if a user-defined class has weights outside [0, 1], or a loss with another slope."""
    chi2 = loss.scale**2 * np.array([0.0, 1e-3, 0.3, 0.9, 3.0, 100.0])
    step = 1e-6 * loss.scale**2
    try:
        weight = np.asarray(loss.weight(chi2), np.float64)
        slope = (np.asarray(loss.loss(chi2 + step), np.float64) - loss.loss(chi2)) / step
    except InputError:
        raise
    except Exception as error:  # of user-defined code
        reason = one_line(error)
        raise InputError(
            f"{loss.kernel}: fails for χ² (N,) ({type(error).__name__}: {reason}); wanted weight(self, chi2, s, "
            "mu) and loss(self, chi2, s, mu)"
        ) from error
    if weight.shape != chi2.shape or not np.all((weight >= 0.0) & (weight <= 1.0)) or weight[0] < 0.99:
        raise InputError(f"{loss.kernel}: weight returned {weight.tolist()}; wanted (N,) in [0, 1], 1 at χ² = 0")
    if slope.shape != chi2.shape or not np.allclose(slope, weight, rtol=0.0, atol=1e-3):
        raise InputError(f"{loss.kernel}: the slope of loss over χ² is not weight; both belong to one function")


@dataclass(frozen=True, slots=True)
class InlierSet:
    """Inlier set of the robust edges as a loss: an inlier costs its χ², an outlier the price.

    kept : (L,) bool, inliers among the robust edges
    price : cost of rejecting an edge, in χ²
    """

    kept: Mask
    price: float
    kernel: Literal["truncated"] = "truncated"

    def weight(self, chi2: Vector) -> Vector:
        """1 or 0, whatever the residuals."""
        return self.kept.astype(np.float64)

    def loss(self, chi2: Vector) -> Vector:
        """χ² or the price."""
        return np.where(self.kept, chi2, self.price)


def fair_price(against: Vector, nominal: float, residuals: Integers) -> float:
    """The price, lowered if the distances ``against`` (L,) of kept edges show that the noise model is pessimistic.

    With information matrices that are far too small any edge would be accepted. The factor is the median of the
    distances over that of χ² with as many degrees of freedom as residuals (L,), with a margin.
    """
    if len(against) < _FEWEST:
        return nominal
    expected = 2.0 * gammaincinv(0.5 * np.maximum(residuals, 1), 0.5)
    most = float(expected.max())
    return nominal * min(1.0, _MARGIN * float(np.median(against * (most / expected))) / most)
