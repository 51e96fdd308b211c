"""LM-PLICP: a scan aligned to the local shapes of a voxel map, and what the answer is worth."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.config import MatchingConfig
from pipeline.data import Match, Matrix, Points, Pose
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
        self,
        points: Points,
        target: VoxelMap,
        T_predicted: Pose,
        prior: NDArray[np.float64],
        *,
        wide: bool = False,
    ) -> Match:
        """Pose of the scan in the map's frame, near the prediction.

        points : (N, d) metres, lidar frame
        prior : (k,) information of the prediction, m⁻² and rad⁻², twist order
        wide : search far, for a prediction that is little more than a guess
        """
        terms = terms_of(self.config, target, wide)
        information = np.diag(prior * terms.variance)
        T = T_predicted.copy()
        outcome = align(target.voxels, points, T, information, terms)
        spectrum = spectrum_of(outcome, points)
        if spectrum.values[0] < self.config.min_information:
            T = T_predicted.copy()
            anchor = hold_undetermined(spectrum, outcome.weights, self.config.min_information)
            outcome = align(target.voxels, points, T, information + anchor, terms)
            spectrum = spectrum_of(outcome, points)
        return judge(T, T_predicted, outcome, spectrum, len(points), self.config.sensor_noise_m)


def terms_of(config: MatchingConfig, target: VoxelMap, wide: bool) -> Terms:
    """The numbers a kernel runs under."""
    return Terms(
        optimiser=OPTIMISERS[config.optimiser],
        max_iterations=config.max_iterations,
        reach=config.wide_reach_voxels if wide else config.reach_voxels,
        max_distance_m=config.wide_max_distance_m if wide else config.max_distance_m,
        first_scale_m=config.wide_kernel_scale_m if wide else config.kernel_scale_m,
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


def spectrum_of(outcome: Outcome, points: Points) -> Spectrum:
    """The spectrum of an outcome's information."""
    d = points.shape[1]
    scale = np.ones(len(outcome.H))
    scale[d:] = 1.0 / max(math.sqrt(np.einsum("ij,ij->", points, points) / max(len(points), 1)), 1e-9)
    evened = outcome.H * (scale * scale[:, None] / max(outcome.weights, 1e-300))
    return Spectrum(scale, *np.linalg.eigh(evened))


def hold_undetermined(spectrum: Spectrum, weights: float, min_information: float) -> Matrix:
    """Information (k, k), in the kernel's units, that keeps a pose from moving where the data determine nothing.

    The solution is restricted to the directions whose eigenvalue is at least ``min_information`` (Zhang, Kaess &
    Singh 2016).
    """
    held = spectrum.vectors[:, spectrum.values < min_information] / spectrum.scale[:, None]
    return _FIRM * weights * held @ held.T


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
