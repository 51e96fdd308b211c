"""LM-PLICP: a scan aligned to the local shapes of a voxel map, and whether the result is reliable."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from scanchain import checks, lie
from scanchain.config import MatchingConfig
from scanchain.data import LEAST_FIT, AnyPoints, Match, Points, Pose, Prior, Problem
from scanchain.errors import below, counted
from scanchain.kernels.geometry import largest_magnitude
from scanchain.kernels.registration import icp
from scanchain.kernels.registration.match import Result, match
from scanchain.kernels.registration.residuals import Settings
from scanchain.registration.voxel_map import VoxelMap

OPTIMIZERS = {each.name.lower().replace("_", "-"): int(each) for each in icp.Optimizer}

_REACH, _LARGEST_REACH = 0.4, 8  # share of the largest distance that is always searched; limit in voxels
_LEAST_OVERLAP = 0.75  # least share of points with a correspondence; correct poses in simulations exceed it
_REDUNDANCY = 10  # correspondences on surfaces per degree of freedom, below which wrong poses fit by chance
_SPAN_VOXELS = 4.0  # root mean square range of the points, below which voxels do not resolve their shape
_KERNEL_SIGMAS = 4.0  # least kernel scale, in standard deviations of a range
_ENDINGS: dict[int, str] = {
    icp.Ending.OUT_OF_ITERATIONS: "out of iterations (matching.max_iterations)",
    icp.Ending.NO_CORRESPONDENCES: "no point has a correspondence in the map",
    icp.Ending.SINGULAR: "the correspondences do not determine the pose",
}


class PointToShapeMatcher:
    """Point-to-line (2D) and point-to-plane (3D) ICP, by one of four optimizers.

    Residuals n·(R x + t − y) with n from the map (Chen & Medioni 1992; Censi 2008), Geman–McClure weights, and
    Levenberg–Marquardt by default.
    """

    def __init__(self, config: MatchingConfig) -> None:
        self.config = config

    def align(
        self, points: AnyPoints, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """Pose of the scan in the map's frame, near the initial one; arguments as ``Matcher.align``.

        The covariance of the prior sets the initial kernel scale.
        Raises InputError where points or initial pose do not fit the map.
        """
        points, T_first = checked(points, target, T_first)
        result = match(
            target.voxels, points, T_first, expected(prior, T_first), settings_of(self.config, target, wide=wide)
        )
        return match_of(result, len(points), target, self.config)


def checked(points: AnyPoints, target: VoxelMap, T_first: Pose) -> tuple[Points, Pose]:
    """Points and initial pose of an alignment, validated. Raises InputError where they do not fit the map."""
    checks.instance(target, VoxelMap, "target", "target = VoxelMap(3, config.local_map); target.insert(points, T)")
    sound = checks.points(points, "points", target.dimension)
    T_first = checks.pose(T_first, "T_first", target.dimension)
    checks.within_map(sound, T_first, target.voxels.size_m, "points")
    return sound, T_first


def settings_of(config: MatchingConfig, target: VoxelMap, *, wide: bool) -> Settings:
    """The settings of the kernels; residual scales grow where ranges are noisier than configured."""
    wide = checks.truth(wide, "wide")
    kernel_scale_m = kernel_scale_of(config, target)
    return Settings(
        optimizer=OPTIMIZERS[config.optimizer],
        max_iterations=config.max_iterations,
        reach=_reach(config.wide_max_distance_m if wide else config.max_distance_m, target),
        max_distance_m=target.scale * (config.wide_max_distance_m if wide else config.max_distance_m),
        last_reach=_reach(config.max_distance_m, target),
        last_distance_m=target.scale * config.max_distance_m,
        first_scale_m=config.wide_kernel_scale_m if wide else kernel_scale_m,
        widest_scale_m=max(config.wide_kernel_scale_m, kernel_scale_m),
        scale_m=kernel_scale_m,
        variance=max(config.sensor_noise_m, target.noise_m) ** 2,
        min_information=config.min_information,
        min_signal=config.min_signal,
        insertions=target.insertions,
        tolerance_m=config.tolerance_m,
        tolerance_rad=config.tolerance_rad,
    )


def kernel_scale_of(config: MatchingConfig, target: VoxelMap) -> float:
    """Scale of the robust kernel, meters: the one configured, or a larger one for noisier ranges."""
    return max(config.kernel_scale_m, _KERNEL_SIGMAS * target.noise_m)


def _reach(max_distance_m: float, target: VoxelMap) -> int:
    """Number of voxels to search in each direction for this largest distance of a correspondence."""
    return min(math.ceil(_REACH * max_distance_m / target.config.voxel_size_m), _LARGEST_REACH)


def match_of(result: Result, points: int, target: VoxelMap, config: MatchingConfig) -> Match:
    """The match from a kernel's result for this number of points."""
    observability = min(
        _ratio(result.eigenvalue, config.min_information), _ratio(result.signal, config.min_signal)
    )
    problem = next(_problems(result, points, target, observability, config), Problem("", ""))
    return Match(
        T_target_source=result.T,
        information=result.information,
        cost=result.cost,
        inliers=result.pairs,
        points=points,
        iterations=result.iterations,
        residual_m=result.residual_m,
        fit=result.fit,
        at_minimum=result.ending == icp.Ending.CONVERGED,
        converged=not problem.text,
        reason=problem.text or "converged",
        cause=problem.cause,
        degeneracy_eigenvalue=result.eigenvalue,
        observability=observability,
        degeneracy_direction=result.direction,
        variance_factor=result.variance_factor,
        systematic=result.systematic,
    )


def _problems(
    result: Result, points: int, target: VoxelMap, observability: float, config: MatchingConfig
) -> Iterator[Problem]:
    """Why a result did not converge, the worst first; none if it did."""
    kernel_scale_m = kernel_scale_of(config, target)
    if not math.isfinite(largest_magnitude(result.T)):
        yield Problem.plain("the pose is not finite")
    if result.ending == icp.Ending.NO_CORRESPONDENCES:
        yield Problem.plain(_ENDINGS[result.ending])
    if result.pairs < config.min_inlier_share * points:
        yield Problem(
            "few points have a correspondence (matching.min_inlier_share)",
            f"{result.pairs} of {points} points have a correspondence, below the share "
            f"matching.min_inlier_share ({config.min_inlier_share:g})",
        )
    if observability < 1.0:
        direction = " ".join(f"{value:.2f}" for value in result.direction)
        yield Problem(
            "motion is undetermined (matching.min_signal or matching.min_information)",
            f"motion along [{direction}] is undetermined: observability {observability:.1e} < 1, by "
            f"matching.min_signal ({config.min_signal:g}) or matching.min_information "
            f"({config.min_information:g})",
        )
    if result.ending != icp.Ending.CONVERGED:
        yield Problem.plain(_ENDINGS[result.ending])
    if result.fit < LEAST_FIT:
        yield Problem(
            f"the correspondences contradict the pose (fit < {LEAST_FIT:g})",
            f"the correspondences contradict the pose: fit {below(result.fit)} < {LEAST_FIT:g}, residuals along "
            f"one direction are far above matching.kernel_scale_m ({kernel_scale_m:g})",
        )
    if result.residual_m > kernel_scale_m:
        yield Problem(
            "residual > matching.kernel_scale_m",
            f"residual {result.residual_m:.2g} m > matching.kernel_scale_m ({kernel_scale_m:g})",
        )
    yield from _chances(result, points, target)


def _chances(result: Result, points: int, target: VoxelMap) -> Iterator[Problem]:
    """Why the fit may be due to chance; none if it is redundant enough."""
    freedom, voxel_m = len(result.information), target.voxels.size_m
    if result.pairs < _LEAST_OVERLAP * points:
        few = f"fewer than {100 * _LEAST_OVERLAP:.0f} %"
        yield Problem(
            f"{few} of the points have a correspondence",
            f"{result.pairs} of {points} points have a correspondence, {few}",
        )
    if result.on_surfaces < _REDUNDANCY * freedom:
        yield Problem(
            "few correspondences with a surface",
            f"{result.on_surfaces} correspondences with a surface, fewer than {_REDUNDANCY} for each of {freedom} "
            "degrees of freedom",
        )
    if len(target) < 2 * _REDUNDANCY * freedom:
        yield Problem(
            "the map has few voxels (local_map.voxel_size_m)",
            f"the map has {counted(len(target), 'voxel')}, fewer than {2 * _REDUNDANCY} for each degree of "
            f"freedom: lower local_map.voxel_size_m ({voxel_m:g})",
        )
    if result.range_m < _SPAN_VOXELS * voxel_m:
        yield Problem(
            "the points spread over few voxels (local_map.voxel_size_m)",
            f"the points spread over {result.range_m:.2g} m, less than {_SPAN_VOXELS:g} voxels: lower "
            f"local_map.voxel_size_m ({voxel_m:g})",
        )


def _ratio(known: float, least: float) -> float:
    return known / least if least else math.inf


def expected(prior: Prior | None, T_first: Pose) -> Prior:
    """The prior for the kernels; without one, the initial pose with zero information."""
    if prior is None:
        k = lie.twist_size(T_first)
        return Prior(np.ascontiguousarray(T_first), np.zeros((k, k)), np.full(k, np.inf))
    checks.instance(prior, Prior, "prior", "Prior(T_target_source, covariance, widest), or None")
    arrays = map(np.ascontiguousarray, (prior.T_target_source, prior.covariance, prior.widest))
    return Prior(*arrays, is_measured=bool(prior.is_measured))
