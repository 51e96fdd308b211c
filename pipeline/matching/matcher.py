"""LM-PLICP: a scan aligned to the local shapes of a voxel map, and what the answer is worth."""

from __future__ import annotations

import math

import numpy as np

from pipeline import lie
from pipeline.config import MatchingConfig
from pipeline.data import Match, Points, Pose, Prior
from pipeline.kernels import registration
from pipeline.kernels.descent import GAUSS_NEWTON, GRADIENT_DESCENT, LEVENBERG_MARQUARDT, NEWTON
from pipeline.kernels.estimate import Terms
from pipeline.kernels.matching import Answer, Expectation, match
from pipeline.matching.voxel_map import VoxelMap

OPTIMISERS = {
    "gradient-descent": GRADIENT_DESCENT,
    "newton": NEWTON,
    "gauss-newton": GAUSS_NEWTON,
    "levenberg-marquardt": LEVENBERG_MARQUARDT,
}

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
        expected = _expectation(prior, T_first)
        answer = match(
            target.voxels,
            np.ascontiguousarray(points),
            np.ascontiguousarray(T_first),
            expected,
            terms_of(self.config, target, wide=wide),
        )
        return match_of(answer, len(points), self.config)


def terms_of(config: MatchingConfig, target: VoxelMap, *, wide: bool) -> Terms:
    """The numbers a kernel runs under."""
    return Terms(
        optimiser=OPTIMISERS[config.optimiser],
        max_iterations=config.max_iterations,
        reach=config.wide_reach_voxels if wide else config.reach_voxels,
        max_distance_m=target.scale * (config.wide_max_distance_m if wide else config.max_distance_m),
        first_scale_m=config.wide_kernel_scale_m if wide else config.kernel_scale_m,
        widest_scale_m=config.wide_kernel_scale_m,
        scale_m=config.kernel_scale_m,
        variance=config.sensor_noise_m**2,
        min_information=config.min_information,
        min_signal=config.min_signal,
        insertions=target.insertions,
        tolerance_m=config.tolerance_m,
        tolerance_rad=config.tolerance_rad,
    )


def match_of(answer: Answer, points: int, config: MatchingConfig) -> Match:
    """The match that a kernel's answer for so many points amounts to."""
    return Match(
        T_target_source=answer.T,
        information=answer.information,
        cost=answer.cost,
        inliers=answer.pairs,
        points=points,
        iterations=answer.iterations,
        residual_m=answer.residual_m,
        converged=answer.ending == registration.CONVERGED,
        reason=_ENDINGS[answer.ending],
        degeneracy_eigenvalue=answer.eigenvalue,
        observability=min(
            _times(answer.eigenvalue, config.min_information), _times(answer.signal, config.min_signal)
        ),
        degeneracy_direction=answer.direction,
    )


def _times(known: float, least: float) -> float:
    return known / least if least else math.inf


def _expectation(prior: Prior | None, T_first: Pose) -> Expectation:
    """The prior as kernels take it."""
    if prior is None:
        k = lie.twist_size(T_first)
        return Expectation(np.ascontiguousarray(T_first), np.zeros((k, k)), np.zeros(k), 0)
    return Expectation(
        np.ascontiguousarray(prior.T_target_source), np.ascontiguousarray(prior.covariance), prior.widest, 1
    )
