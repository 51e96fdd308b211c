"""LM-PLICP: a scan aligned to the local shapes of a voxel map, and what the answer is worth."""

from __future__ import annotations

import math

import numpy as np

from scanchain import checks, lie
from scanchain.config import MatchingConfig
from scanchain.data import LEAST_FIT, Match, Points, Pose, Prior
from scanchain.kernels.geometry.validity import largest_magnitude
from scanchain.kernels.registration import icp
from scanchain.kernels.registration.descent import GAUSS_NEWTON, GRADIENT_DESCENT, LEVENBERG_MARQUARDT, NEWTON
from scanchain.kernels.registration.linearization import Terms
from scanchain.kernels.registration.match import Answer, Expectation, match
from scanchain.registration.voxel_map import VoxelMap
from scanchain.words import counted

OPTIMIZERS = {
    "gradient-descent": GRADIENT_DESCENT,
    "newton": NEWTON,
    "gauss-newton": GAUSS_NEWTON,
    "levenberg-marquardt": LEVENBERG_MARQUARDT,
}

_LEAST_OVERLAP = 0.75  # share of the points with a correspondence: made-up places have more at right poses
_REDUNDANCY = 10  # correspondences on surfaces for each degree of freedom, below which wrong poses fit by chance
_SPAN_VOXELS = 4.0  # root mean square range of the points, below which voxels do not resolve their shape
_ENDINGS = {
    icp.OUT_OF_ITERATIONS: "out of iterations (matching.max_iterations)",
    icp.NO_PARTNERS: "no point has a correspondence in the map",
    icp.SINGULAR: "the correspondences do not determine the pose",
}


class PointToShapeMatcher:
    """Point-to-line (2D) and point-to-plane (3D) ICP, by one of four optimizers.

    Residuals n·(R x + t − y) with n from the map (Chen & Medioni 1992; Censi 2008), Geman–McClure weights, and
    Levenberg–Marquardt by default.
    """

    def __init__(self, config: MatchingConfig) -> None:
        self.config = config

    def align(
        self, points: Points, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """Pose of the scan in the map's frame, near the first one.

        points : (N, d) meters, lidar frame
        prior : what the pose is expected to be, and how surely; its doubt sets the first scale of the kernel
        wide : search far, for a first pose that is little more than a guess
        Raises InputError where points or first pose do not fit the map.
        """
        points, T_first = aligned(points, target, T_first)
        if prior is not None:
            checks.instance(prior, Prior, "prior", "Prior(T_target_source, covariance, widest), or None")
        expected = _expectation(prior, T_first)
        answer = match(target.voxels, points, T_first, expected, terms_of(self.config, target, wide=wide))
        return match_of(answer, len(points), target, self.config)


def aligned(points: Points, target: VoxelMap, T_first: Pose) -> tuple[Points, Pose]:
    """The points and the first pose of an alignment to a map, checked."""
    checks.instance(target, VoxelMap, "target", "target = VoxelMap(3, config.local_map); target.insert(points, T)")
    points = checks.points(points, "points", target.dimension)
    T_first = checks.pose(T_first, "T_first", target.dimension)
    checks.within_map(points, T_first, target.voxels.size_m, "points")
    return points, T_first


def terms_of(config: MatchingConfig, target: VoxelMap, *, wide: bool) -> Terms:
    """The numbers a kernel runs under."""
    wide = checks.truth(wide, "wide")
    return Terms(
        optimizer=OPTIMIZERS[config.optimizer],
        max_iterations=config.max_iterations,
        reach=config.wide_reach_voxels if wide else config.reach_voxels,
        max_distance_m=target.scale * (config.wide_max_distance_m if wide else config.max_distance_m),
        last_reach=config.reach_voxels,
        last_distance_m=target.scale * config.max_distance_m,
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


def match_of(answer: Answer, points: int, target: VoxelMap, config: MatchingConfig) -> Match:
    """The match that a kernel's answer for so many points amounts to."""
    observability = min(
        _times(answer.eigenvalue, config.min_information), _times(answer.signal, config.min_signal)
    )
    problem = _problem(answer, points, target, observability, config)
    return Match(
        T_target_source=answer.T,
        information=answer.information,
        cost=answer.cost,
        inliers=answer.pairs,
        points=points,
        iterations=answer.iterations,
        residual_m=answer.residual_m,
        fit=answer.fit,
        at_minimum=answer.ending == icp.CONVERGED,
        converged=not problem,
        reason=problem or "converged",
        degeneracy_eigenvalue=answer.eigenvalue,
        observability=observability,
        degeneracy_direction=answer.direction,
    )


def _problem(answer: Answer, points: int, target: VoxelMap, observability: float, config: MatchingConfig) -> str:
    """Why an answer is no pose to rely on, empty if it is one."""
    if not math.isfinite(largest_magnitude(answer.T)):
        return "the pose is not finite"
    if answer.ending == icp.NO_PARTNERS:
        return _ENDINGS[answer.ending]
    if answer.pairs < config.min_inlier_share * points:
        return (
            f"{answer.pairs} of {points} points have a correspondence, below the share "
            f"matching.min_inlier_share ({config.min_inlier_share:g})"
        )
    if observability < 1.0:
        direction = " ".join(f"{value:.2f}" for value in answer.direction)
        return (
            f"motion along [{direction}] is undetermined: observability {observability:.1e} < 1, by "
            f"matching.min_signal ({config.min_signal:g}) or matching.min_information ({config.min_information:g})"
        )
    if answer.surface_signal < config.min_signal:
        return (
            f"motion along the weakest direction is undetermined: the points show {answer.surface_signal:.1g} "
            f"times what errors of the normals alone would, below matching.min_signal ({config.min_signal:g})"
        )
    if answer.ending != icp.CONVERGED:
        return _ENDINGS[answer.ending]
    return _contradiction(answer, config) or _chance(answer, points, target)


def _contradiction(answer: Answer, config: MatchingConfig) -> str:
    """How far the correspondences are from agreeing with the pose, empty if they do agree."""
    if answer.fit < LEAST_FIT:
        return (
            f"the correspondences contradict the pose: fit {answer.fit:.2f} < {LEAST_FIT:g}, residuals along one "
            f"direction are far above matching.kernel_scale_m ({config.kernel_scale_m:g})"
        )
    if answer.residual_m > config.kernel_scale_m:
        return f"residual {answer.residual_m:.2g} m > matching.kernel_scale_m ({config.kernel_scale_m:g})"
    return ""


def _chance(answer: Answer, points: int, target: VoxelMap) -> str:
    """Why so good a fit may be chance, empty if it cannot."""
    freedom, voxel_m = len(answer.information), target.voxels.size_m
    if answer.pairs < _LEAST_OVERLAP * points:
        return f"{answer.pairs} of {points} points have a correspondence, fewer than {100 * _LEAST_OVERLAP:.0f} %"
    if answer.on_surfaces < _REDUNDANCY * freedom:
        return (
            f"{answer.on_surfaces} correspondences with a surface, fewer than {_REDUNDANCY} for each of {freedom} "
            "degrees of freedom"
        )
    if len(target) < 2 * _REDUNDANCY * freedom:
        return (
            f"the map has {counted(len(target), 'voxel')}, fewer than {2 * _REDUNDANCY} for each degree of "
            f"freedom: lower local_map.voxel_size_m ({voxel_m:g})"
        )
    if answer.range_m < _SPAN_VOXELS * voxel_m:
        return (
            f"the points spread over {answer.range_m:.2g} m, less than {_SPAN_VOXELS:g} voxels: lower "
            f"local_map.voxel_size_m ({voxel_m:g})"
        )
    return ""


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
