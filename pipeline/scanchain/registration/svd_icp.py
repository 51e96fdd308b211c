"""SVD-ICP: alternates closest points on a voxel map's surfaces with the closed-form rigid transformation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.config import MatchingConfig
from scanchain.data import AnyPoints, Match, Pose, Prior
from scanchain.errors import InputError, ScanchainError, counted
from scanchain.kernels.registration import icp
from scanchain.kernels.registration.icp import SHRINK
from scanchain.kernels.registration.match import assess
from scanchain.registration.plicp import checked, expected, match_of, settings_of
from scanchain.registration.voxel_map import VoxelMap

_RELAXATION = 1.5  # over-relaxation of a closed-form step; below 2 it does not raise the cost
_LEFT = 0.1  # share of the tolerances below which a step has converged: the error left may be 1/_LEFT as large
_RANK_TOLERANCE = 1e-9  # of the largest singular value
_ROUNDINGS = 64.0  # rounding errors of the products of the means, below which a singular value is noise


class DegeneratePairsError(ScanchainError):
    """Correspondences that do not determine the rotation: all on one point, or in 3D on one line."""


def rigid_transform(source: AnyPoints, target: AnyPoints, weight: NDArray[np.floating] | None = None) -> Pose:
    """The pose T that minimizes Σ wᵢ ‖yᵢ − (R xᵢ + t)‖².

    With centered x' and y' and W = Σ wᵢ x'ᵢ y'ᵢᵀ = U Σ Vᵀ,
        R = V diag(1, …, det(V Uᵀ)) Uᵀ        t = μ_y − R μ_x
    (Arun, Huang & Blostein 1987; the determinant after Umeyama 1991, eq. 43; weights after Sorkine-Hornung &
    Rabinovich 2017, eq. 22). Without the determinant, noisy or planar points may give a reflection.

    source, target : (N, d) meters, corresponding row by row; weight : (N,), ≥ 0, 1 where left out
    Raises DegeneratePairsError where W leaves the rotation undetermined: rank below d − 1.
    """
    d = checks.dimension_of(source, "source")
    source = checks.points(source, "source", d)
    target = checks.points(target, "target", d)
    if len(target) != len(source):
        raise InputError(
            f"target has {counted(len(target), 'point')}, source {len(source)}; wanted pairs, row by row"
        )
    weight = np.ones(len(source)) if weight is None else checks.weights(weight, "weight", len(source))
    total = weight.sum()
    if len(source) < d or total <= 0.0:
        raise DegeneratePairsError(f"{len(source)} pairs of weight {total:g} do not determine a rotation in {d}D")
    mean_x, mean_y = weight @ source / total, weight @ target / total
    W = ((source - mean_x) * weight[:, None]).T @ (target - mean_y)
    U, singular, Vt = np.linalg.svd(W)
    rounding = np.finfo(float).eps * total * np.linalg.norm(mean_x) * np.linalg.norm(mean_y)
    if singular[d - 2] <= max(_RANK_TOLERANCE * singular[0] if d == 3 else 0.0, _ROUNDINGS * rounding):
        raise DegeneratePairsError(
            f"all {len(source)} pairs lie on a {'line' if d == 3 else 'point'}: the rotation about it is free"
        )
    signs = np.ones(d)
    signs[-1] = np.linalg.det(Vt.T @ U.T)
    T = np.eye(d + 1)
    T[:d, :d] = (Vt.T * np.sign(signs)) @ U.T
    T[:d, d] = mean_y - T[:d, :d] @ mean_x
    return T


class SvdMatcher:
    """Point-to-point ICP by singular value decomposition (Besl & McKay 1992; Arun, Huang & Blostein 1987)."""

    def __init__(self, config: MatchingConfig) -> None:
        self.config = config

    def align(
        self, points: AnyPoints, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """Pose of the scan in the map's frame, near the initial one; arguments as ``Matcher.align``.

        The closed form converges slowly where points slide along surfaces: its steps are over-relaxed and, while
        they shrink, extrapolated with the last one (Anderson acceleration; Walker & Ni 2011, Pavlov et al. 2018).
        It cannot include the prediction, which is applied afterwards along weakly constrained directions.
        """
        points, T_first = checked(points, target, T_first)
        settings, predicted = settings_of(self.config, target, wide=wide), expected(prior, T_first)
        problem = icp.problem_of(target.voxels, points, T_first, np.zeros_like(predicted.covariance), settings)
        source, closest, weight = np.empty_like(points), np.empty_like(points), np.empty(len(points))
        lengths = lie.by_component(len(predicted.widest), 1.0, problem.range_m)  # that a unit twist moves a point
        limits = _LEFT * lie.by_component(len(lengths), settings.tolerance_m, settings.tolerance_rad) * lengths
        last = moved = np.zeros(len(lengths))
        T, scale_m, iterations, ending = T_first.copy(), settings.first_scale_m, 0, icp.Ending.OUT_OF_ITERATIONS
        while ending == icp.Ending.OUT_OF_ITERATIONS and iterations < settings.max_iterations:
            iterations += 1
            pairs = icp.closest_pairs(problem, T, scale_m, source, closest, weight)
            try:
                closed_form = rigid_transform(source[:pairs], closest[:pairs], weight[:pairs])
            except DegeneratePairsError:
                ending = icp.Ending.SINGULAR if pairs else icp.Ending.NO_CORRESPONDENCES
                break
            step = _RELAXATION * lengths * lie.log(lie.between(T, closed_form @ T))
            change, is_shrinking = step - last, step @ step < last @ last
            share = (step @ change) / (change @ change) if is_shrinking else 0.0
            last, moved = step, step - share * (moved + change)
            T = lie.normalize(T @ lie.exp(moved / lengths))
            if scale_m <= settings.scale_m and (np.abs(moved) < limits).all():
                ending = icp.Ending.CONVERGED
            scale_m = max(settings.scale_m, SHRINK * scale_m)
        result = assess(target.voxels, points, T, predicted, iterations, ending, settings)
        return match_of(result, len(points), target, self.config)
