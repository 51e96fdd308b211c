"""Dead reckoning between the observations of a log: motions with their uncertainty, and their chain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Matrix
from pipeline.kernels import dead_reckoning
from pipeline.landmarks.mrclam import RangeLog

_LEAST_VARIANCE = 1e-12  # m², rad²; keeps the covariance of a motion that takes no time invertible


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """White noise of a robot's velocities: what its motion is off by after one second, growing with √time.

    The values at hand are of a small differential drive on a smooth floor (iRobot Create, at most 0.1 m/s).
    """

    forward_m: float = 0.01
    sideways_m: float = 0.003
    turn_rad: float = 0.03

    @property
    def densities(self) -> NDArray[np.float64]:
        """Variances after one second, (3,)."""
        return np.square([self.forward_m, self.sideways_m, self.turn_rad])


@dataclass(frozen=True, slots=True)
class Reckoning:
    """The log cut at its observations.

    Attributes
    ----------
    nodes_s : (K,) every time at which a landmark was seen, once
    motion, covariance : (K − 1, 3), (K − 1, 3, 3) from each node to the next, in the frame of the former
    landmarks : (L,) subjects, ascending
    observed : (N, 2) node, landmark (its place in ``landmarks``)
    """

    nodes_s: NDArray[np.float64]
    motion: Matrix
    covariance: Matrix
    landmarks: NDArray[np.int64]
    observed: NDArray[np.int64]


def reckon(log: RangeLog, noise: OdometryNoise) -> Reckoning:
    """Integrate the velocities from one observation to the next."""
    nodes_s, node = np.unique(log.seen_s, return_inverse=True)
    landmarks, landmark = np.unique(log.subjects, return_inverse=True)
    steps = len(nodes_s) - 1
    motion, spread = np.empty((steps, 3)), np.empty((steps, 3, 3, 3))
    dead_reckoning.integrate(log.times_s, log.velocities, nodes_s, motion, spread)
    covariance = np.einsum("c,kcab->kab", noise.densities, spread) + _LEAST_VARIANCE * np.eye(3)
    return Reckoning(nodes_s, motion, covariance, landmarks, np.stack([node, landmark], axis=1))


def chain(start: NDArray[np.float64], motion: Matrix) -> Matrix:
    """Poses (K, 3) that follow each other by these motions (K − 1, 3), the first being ``start``."""
    poses = np.tile(start, (len(motion) + 1, 1))
    poses[1:, 2] += np.cumsum(motion[:, 2])
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    poses[1:, 0] += np.cumsum(c * motion[:, 0] - s * motion[:, 1])
    poses[1:, 1] += np.cumsum(s * motion[:, 0] + c * motion[:, 1])
    return poses
