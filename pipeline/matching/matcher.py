"""LM-PLICP: a scan aligned to the local shapes of a voxel map, and what the answer is worth."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.config import MatchingConfig
from pipeline.data import Match, Matrix, Points, Pose, Prior
from pipeline.kernels import registration
from pipeline.kernels.descent import GAUSS_NEWTON, GRADIENT_DESCENT, LEVENBERG_MARQUARDT, NEWTON
from pipeline.kernels.registration import Outcome, Terms, align
from pipeline.matching.voxel_map import VoxelMap

OPTIMISERS = {
    "gradient-descent": GRADIENT_DESCENT,
    "newton": NEWTON,
    "gauss-newton": GAUSS_NEWTON,
    "levenberg-marquardt": LEVENBERG_MARQUARDT,
}

_DOUBTS = 2.0  # standard deviations of the prediction that the kernel's first scale spans
_WEAK = 10.0  # times the least information, below which the data alone are not believed
_FIRM = 1e3  # times what all residuals together know of a direction

_ENDINGS = {
    registration.CONVERGED: "converged",
    registration.OUT_OF_ITERATIONS: "out of iterations",
    registration.NO_PARTNERS: "no point has a partner in the map",
    registration.SINGULAR: "the partners do not determine the pose",
}


class PointToShapeMatcher:
    """Point-to-line (2D) and point-to-plane (3D) ICP, by one of four optimisers.

    Residuals n·(R x + t − y) with n from the map (Chen & Medioni 1992; Censi 2008), Geman–McClure weights, and
    Levenberg–Marquardt by default.
    """

    def __init__(self, config: MatchingConfig) -> None:
        self.config = config

    def align(
        self, points: Points, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """Pose of the scan in the map's frame, near the first one.

        points : (N, d) metres, lidar frame
        prior : what the pose is expected to be, and how surely; its doubt sets the first scale of the kernel
        wide : search far, for a first pose that is little more than a guess
        """
        k, range_m = lie.twist_size(T_first), root_mean_square_range(points)
        information, away, doubt_m = np.zeros((k, k)), np.zeros(k), 0.0
        if prior is not None:
            information = turned(np.diag(prior.widest**-2.0), T_first) * self.config.sensor_noise_m**2
            if prior.T_target_source is not T_first:
                away = twist_between(prior.T_target_source, T_first)
            doubt_m = doubt_of(prior, range_m)
        terms = terms_of(self.config, target, wide, range_m, doubt_m)
        T = T_first.copy()
        outcome = align(target.voxels, points, T, away, information, terms)
        spectrum = spectrum_of(outcome, range_m)
        if spectrum.values[0] < _WEAK * self.config.min_information:
            expected = information if prior is None else turned(prior.information, T_first) * terms.variance
            anchor = hold(spectrum, outcome.weights, expected, self.config.min_information)
            T = T_first.copy()
            outcome = align(target.voxels, points, T, away, information + anchor, terms)
            spectrum = spectrum_of(outcome, range_m)
        return judge(T, T_first, outcome, spectrum, len(points), self.config.sensor_noise_m)


def root_mean_square_range(points: Points) -> float:
    """Of points (N, d) as the lidar sees them; metres."""
    return math.sqrt(np.einsum("ij,ij->", points, points) / max(len(points), 1))


def turned(information: Matrix, T: Pose) -> Matrix:
    """Information (k, k) about twists in the source's frame as that about twists along the target's axes."""
    centred = T.copy()
    centred[:-1, -1] = 0.0
    Ad = lie.adjoint(centred)
    return Ad @ information @ Ad.T


def twist_between(T_from: Pose, T_to: Pose) -> NDArray[np.float64]:
    """Twist (k,) from one pose to another near it, about the latter's position and along the target's axes."""
    a, b = T_from.copy(), T_to.copy()
    a[:-1, -1] -= T_to[:-1, -1]
    b[:-1, -1] = 0.0
    return lie.log(b @ lie.inverse(a))


def doubt_of(prior: Prior, range_m: float) -> float:
    """How far a point at that range may be from where the prior expects it: one standard deviation, metres."""
    d = len(prior.T_target_source) - 1
    variances = prior.covariance.diagonal()
    return math.sqrt(variances[:d].mean() + range_m * range_m * variances[d:].mean())


def terms_of(config: MatchingConfig, target: VoxelMap, wide: bool, range_m: float, doubt_m: float = 0.0) -> Terms:
    """The numbers a kernel runs under; doubt_m is how far off points may be, one standard deviation."""
    first_scale_m = min(max(config.kernel_scale_m, _DOUBTS * doubt_m), config.wide_kernel_scale_m)
    return Terms(
        optimiser=OPTIMISERS[config.optimiser],
        max_iterations=config.max_iterations,
        reach=config.wide_reach_voxels if wide else config.reach_voxels,
        range_m=range_m,
        max_distance_m=target.scale * (config.wide_max_distance_m if wide else config.max_distance_m),
        first_scale_m=config.wide_kernel_scale_m if wide else first_scale_m,
        scale_m=config.kernel_scale_m,
        variance=config.sensor_noise_m**2,
        tolerance_m=config.tolerance_m,
        tolerance_rad=config.tolerance_rad,
    )


class Spectrum(NamedTuple):
    """What the data determine, by direction, about the prediction's position and in the map's axes.

    scale : (k,) that evens out the units: rotations count as the lengths they move a point at the scan's root mean
        square range
    values : (k,) eigenvalues, ascending, of the information per weight; 1 is a direction that every residual sees
    vectors : (k, k) unit eigenvectors, a column each, in evened units
    """

    scale: NDArray[np.float64]
    values: NDArray[np.float64]
    vectors: Matrix


def spectrum_of(outcome: Outcome, range_m: float) -> Spectrum:
    """The spectrum of an outcome's information, of points with this root mean square range."""
    k = len(outcome.H)
    scale = np.ones(k)
    scale[2 if k == 3 else 3 :] = 1.0 / max(range_m, 1e-9)
    evened = outcome.H * (scale * scale[:, None] / max(outcome.weights, 1e-300))
    return Spectrum(scale, *np.linalg.eigh(evened))


def hold(spectrum: Spectrum, weights: float, expected: Matrix, min_information: float) -> Matrix:
    """Information (k, k), in the kernel's units, that keeps a pose near the prediction where the data tell little.

    Along directions whose eigenvalue is below ``min_information`` the pose does not move at all (Zhang, Kaess &
    Singh 2016). Up to _WEAK times that the data may be mistaken about themselves, and the information ``expected``
    (k, k) of the prediction is taken as it is; beyond, a vehicle that brakes may contradict any experience.
    """
    weak = spectrum.values < _WEAK * min_information
    values, vectors = spectrum.values[weak], spectrum.vectors[:, weak]
    twists = vectors * spectrum.scale[:, None]
    strength = np.einsum("ik,ij,jk->k", twists, expected, twists)
    strength = np.where(values < min_information, _FIRM * weights, strength)
    held = vectors / spectrum.scale[:, None]
    return (held * strength) @ held.T


def judge(
    T: Pose, T_first: Pose, outcome: Outcome, spectrum: Spectrum, points: int, sensor_noise_m: float
) -> Match:
    """The match that an outcome amounts to: information and worst direction in the source's frame, words.

    The variance of a residual is that of the fit, or the sensor's where the fit is closer than that.
    """
    residual_m = math.sqrt(outcome.squares / outcome.weights) if outcome.weights > 0.0 else math.inf
    centred = T.copy()
    centred[:-1, -1] -= T_first[:-1, -1]
    Ad = lie.adjoint(centred)
    centred[:-1, -1] = 0.0
    direction = lie.adjoint(centred).T @ spectrum.vectors[:, 0]
    return Match(
        T_target_source=T,
        information=Ad.T @ outcome.H @ Ad / max(sensor_noise_m, residual_m) ** 2,
        cost=outcome.cost,
        inliers=outcome.pairs,
        points=points,
        iterations=outcome.iterations,
        residual_m=residual_m,
        converged=outcome.ending == registration.CONVERGED,
        reason=_ENDINGS[outcome.ending],
        degeneracy_eigenvalue=max(float(spectrum.values[0]), 0.0),
        degeneracy_direction=direction,
    )
