"""Variances of a log's noise, estimated along with its state: restricted maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.landmarks.bearing_range import BearingRangeProblem
from scanchain.landmarks.covariance import Covariance
from scanchain.landmarks.minimize import Minimum

_STATED = np.array([10.0, 10.0, 10.0, 10.0, 2.0, 2.0])  # degrees of freedom that what was stated counts as
_LEAST_REDUNDANCY = 0.05  # of what the sightings count as


@dataclass(frozen=True, slots=True)
class Consistency:
    """What an estimate's residuals say about the noise it was found with.

    Attributes
    ----------
    motion, sensor : χ² of the motions; of bearings and of ranges (2,), weighed
    motion_freedom, redundancy : degrees of freedom of those, observations less what the state takes up
    sightings : what all of them count as
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
        """The redundancy, but a small share of the sightings where shares are too rough for it, (2,)."""
        return np.maximum(self.redundancy, _LEAST_REDUNDANCY * self.sightings)

    def growth(self, stated: NDArray[np.float64]) -> NDArray[np.float64]:
        """By what the variances, those of odometry first, should grow, (6,); one where they are right.

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
    """Weigh residuals against what they should be where the noise is right.

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
