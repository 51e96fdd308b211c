"""Dead reckoning between the observations of a log: motions, their uncertainty and their Jacobians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.kernels.landmarks import dead_reckoning
from scanchain.landmarks.bearing_range import Calibration
from scanchain.landmarks.files.mrclam import RangeLog

_AT_REST = np.square([1e-3, 1e-3, 1e-3])  # m², m², rad² a second, whether or not the robot moves
_LEAST_VARIANCE = 1e-12  # m², rad²; keeps the covariance of a motion that takes no time invertible

OWN = ("forward scale", "forward lost in turning", "turn scale", "drift", "delay")
OWN_UNITS = ("", " m/rad", "", " rad/m", " s")
_MEAN = np.zeros(5)
_SIGMA = np.array([0.1, 0.1, 0.1, 0.1, 0.3])  # typical of differential drives; the units as above
_STEP = np.array([1e-3, 1e-3, 1e-3, 1e-3, 0.05])  # over which the slopes are taken


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """White noise of a robot's wheels: standard deviations of its motion after a meter, and after a radian turned.

    It grows with the root of either. The values at hand are of a small differential drive on a smooth floor.
    """

    forward_m: float = 0.03
    sideways_m: float = 0.01
    drift_rad: float = 0.05
    turn_rad: float = 0.1

    @property
    def densities(self) -> NDArray[np.float64]:
        """Variances after a meter, a meter, a meter and a radian, (4,)."""
        return np.square([self.forward_m, self.sideways_m, self.drift_rad, self.turn_rad])


@dataclass(frozen=True, slots=True)
class Reckoning:
    """The log cut at its observations.

    Attributes
    ----------
    motion : (K − 1, 3) from each node to the next, in the frame of the former
    sources, rest : (K − 1, 4, 3, 3), (K − 1, 3, 3) its covariance by each noise of unit density, and by none
    calibration : errors of the robot's velocities, and the motion's Jacobian
    """

    motion: Matrix
    sources: Matrix
    rest: Matrix
    calibration: Calibration

    def covariance(self, densities: NDArray[np.float64]) -> Matrix:
        """Of every motion, (K − 1, 3, 3)."""
        return np.einsum("c,kcab->kab", densities, self.sources) + self.rest


def reckon(log: RangeLog, nodes_s: NDArray[np.float64], own: NDArray[np.float64]) -> Reckoning:
    """Integrate the velocities from one node (K,) to the next, corrected by ``own`` (5,).

    With (v, ω) as logged and c as ``own``, the robot drives, a delay c₄ later, at
        (1 + c₀) v + c₁ |ω|   and   (1 + c₂) ω + c₃ v.
    """
    motion, sources = _integrated(log, nodes_s, own, sources=len(OdometryNoise().densities))
    slope = np.empty((*motion.shape, len(own)))
    for column, step in enumerate(np.diag(_STEP)):
        ahead, _ = _integrated(log, nodes_s, own + step, sources=0)
        slope[..., column] = (ahead - motion) / _STEP[column]
    rest = np.diff(nodes_s)[:, None, None] * np.diag(_AT_REST) + _LEAST_VARIANCE * np.eye(3)
    return Reckoning(motion, sources, rest, Calibration(OWN, own, slope, _MEAN, _SIGMA))


def chain(start: NDArray[np.float64], motion: Matrix) -> Matrix:
    """Poses (K, 3) that follow each other by these motions (K − 1, 3), the first being ``start``."""
    poses = np.tile(start, (len(motion) + 1, 1))
    poses[1:, 2] += np.cumsum(motion[:, 2])
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    poses[1:, 0] += np.cumsum(c * motion[:, 0] - s * motion[:, 1])
    poses[1:, 1] += np.cumsum(s * motion[:, 0] + c * motion[:, 1])
    return poses


def _integrated(
    log: RangeLog, nodes_s: NDArray[np.float64], own: NDArray[np.float64], *, sources: int
) -> tuple[Matrix, Matrix]:
    """Motions (K − 1, 3) and their Jacobians by so many sources of noise (K − 1, sources, 3, 3)."""
    v, turn_rate = log.velocities.T
    driven = np.stack(
        [(1.0 + own[0]) * v + own[1] * np.abs(turn_rate), (1.0 + own[2]) * turn_rate + own[3] * v], axis=1
    )
    steps = len(nodes_s) - 1
    motion, spread = np.empty((steps, 3)), np.empty((steps, sources, 3, 3))
    dead_reckoning.integrate(log.times_s + own[4], driven, nodes_s, motion, spread)
    return motion, spread
