"""The noise model of a log: Student's t, the correlation of successive errors, and consistent variances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.landmarks.bearing_range import BearingRangeProblem
from scanchain.landmarks.minimize import Minimum
from scanchain.landmarks.solvers.schur import Covariance

_FREEDOM = 4.0
_SCALE2 = _FREEDOM + 2.0  # the weight (ν + 2) / (ν + χ²) is, but for a factor that σ takes up, s² / (s² + χ²)
_LAGS_S = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0])  # edges; farther apart errors count as independent
_FEWEST = 30  # least number of pairs from which a correlation is estimated
_STATED = np.array([10.0, 10.0, 10.0, 10.0, 2.0, 2.0])  # degrees of freedom that the stated noise counts as
_LEAST_REDUNDANCY = 0.05  # least redundancy as a share of the sightings


@dataclass(frozen=True, slots=True)
class StudentLoss:
    """ρ(χ²) of a bearing and a range together, ν = 4, times the share of the observation.

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


class SightingPairs:
    """Pairs of sightings of one landmark within some seconds of each other, found once."""

    def __init__(self, seen_s: NDArray[np.float64], landmarks: NDArray[np.int64]) -> None:
        """Times and landmarks of the sightings, (N,) each."""
        since = seen_s - seen_s.min(initial=np.inf)
        key = since + landmarks * (since.max(initial=0.0) + 2.0 * _LAGS_S[-1])  # a landmark's time is its own
        order = np.argsort(key, kind="stable")
        places = np.arange(len(key))
        after = np.searchsorted(key[order], key[order] + _LAGS_S[-1]) - places - 1
        first = np.repeat(places, after)
        second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(after) - after, after)
        self._first, self._second = order[first], order[second]
        self._lag = np.searchsorted(_LAGS_S, seen_s[self._second] - seen_s[self._first], side="right") - 1
        self._count = len(seen_s)

    def correlation(self, residuals: Matrix) -> NDArray[np.float64]:
        """Correlation of residuals (N, 2) by lag, pooled over bearings and ranges; it never grows with the lag."""
        bins = len(_LAGS_S) - 1
        products = residuals[self._first] * residuals[self._second] / np.mean(residuals**2, axis=0)
        sums = np.bincount(self._lag, products.mean(axis=1), bins)
        found = sums / np.maximum(np.bincount(self._lag, minlength=bins), _FEWEST)
        return np.minimum.accumulate(np.clip(found, 0.0, 1.0)).astype(np.float64)

    def share(self, correlation: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weight of each sighting as a share of an independent one, (N,): 1 / Σ of correlations (Kish 1965)."""
        alike = correlation[self._lag]
        sums = np.bincount(self._first, alike, self._count) + np.bincount(self._second, alike, self._count)
        return (1.0 / (1.0 + sums)).astype(np.float64)


@dataclass(frozen=True, slots=True)
class Consistency:
    """Consistency of an estimate's residuals with the noise it was found with.

    Attributes
    ----------
    motion, sensor : χ² of the motions; of bearings and of ranges (2,), weighed
    motion_freedom, redundancy : degrees of freedom of those, observations less what the state takes up
    sightings : effective number of them
    sources, sources_freedom : (4,) the parts of ``motion`` and of its freedom that are each source's
    """

    motion: float
    motion_freedom: float
    sources: NDArray[np.float64]
    sources_freedom: NDArray[np.float64]
    sensor: NDArray[np.float64]
    redundancy: NDArray[np.float64]
    sightings: float

    @property
    def sensor_freedom(self) -> NDArray[np.float64]:
        """The redundancy, at least a small share of the sightings, (2,)."""
        return np.maximum(self.redundancy, _LEAST_REDUNDANCY * self.sightings)

    def growth(self, stated: NDArray[np.float64]) -> NDArray[np.float64]:
        """Factors by which the variances, those of odometry first, should grow, (6,); one where they are right.

        stated : (6,) what they were thought to be beforehand, in units of what they are now
        """
        chi2 = np.concatenate([self.sources, self.sensor])
        freedom = np.concatenate([self.sources_freedom, self.sensor_freedom])
        return (chi2 + _STATED * stated) / (freedom + _STATED)


def consistency(
    problem: BearingRangeProblem,
    minimum: Minimum,
    covariance: Covariance,
    sources: Matrix,
    share: NDArray[np.float64],
) -> Consistency:
    """Compare residuals with their expectation under the noise model.

    With r a whitened motion, W its whitening, H = J C Jᵀ its leverage and V = Σ Vₛ its covariance by sources, the
    part of source s is rᵀ(W Vₛ Wᵀ)r, and tr(W Vₛ Wᵀ(I − H)) its expectation (Harville 1977). Of observations,
    weighed by w, of which ``share`` (N,) is what an independent one would count, they are Σ w r² and
    Σ share − w h (Lange et al. 1989).

    sources : (K − 1, 4, 3, 3) covariance of every motion by sources
    """
    at, W = minimum.at, problem.motion_whitening
    parts = W[:, None] @ sources @ np.swapaxes(W, 1, 2)[:, None]
    leverage = at.odometry_rows @ covariance.of(problem.motion_columns) @ np.swapaxes(at.odometry_rows, 1, 2)
    r = at.odometry
    rows, weights = at.observation_rows, minimum.weights[:, None]
    h = ((rows @ covariance.of(problem.observation_columns)) * rows).sum(axis=-1)
    return Consistency(
        motion=float(np.square(r).sum()),
        motion_freedom=float(r.size - np.trace(leverage, axis1=1, axis2=2).sum()),
        sources=((r[:, None, None, :] @ parts)[:, :, 0] * r[:, None]).sum(axis=(0, 2)),
        sources_freedom=(parts * (np.eye(3) - leverage)[:, None]).sum(axis=(0, 2, 3)),
        sensor=(weights * at.observations**2).sum(axis=0),
        redundancy=(share[:, None] - weights * h).sum(axis=0),
        sightings=float(share.sum()),
    )
