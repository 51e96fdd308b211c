"""SVD-ICP: nearest voxel means and the closed-form rigid transformation between them, in turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.config import MatchingConfig
from scanchain.data import AnyPoints, Match, Points, Pose, Prior
from scanchain.errors import InputError, ScanchainError, counted
from scanchain.kernels.registration import icp
from scanchain.kernels.registration.association import associate, weighted_pairs
from scanchain.kernels.registration.icp import SHRINK, Fit
from scanchain.kernels.registration.match import assess
from scanchain.registration.plicp import checked, match_of, settings_of
from scanchain.registration.voxel_map import VoxelMap

_RANK_TOLERANCE = 1e-9  # of the largest singular value
_ROUNDINGS = 64.0  # of the products of the means, below which a singular value is noise


class DegeneratePairsError(ScanchainError):
    """The pairs leave a rotation free: all on one point, or in 3D on one line."""


def rigid_transform(source: AnyPoints, target: AnyPoints, weight: NDArray[np.floating] | None = None) -> Pose:
    """The pose T that minimizes Σ wᵢ ‖yᵢ − (R xᵢ + t)‖².

    With centered x' and y' and W = Σ wᵢ x'ᵢ y'ᵢᵀ = U Σ Vᵀ,
        R = V diag(1, …, det(V Uᵀ)) Uᵀ        t = μ_y − R μ_x
    (Arun, Huang & Blostein 1987; the determinant after Umeyama 1991, eq. 43; weights after Sorkine-Hornung &
    Rabinovich 2017, eq. 22). Without the determinant noisy or planar points give a reflection.

    source, target : (N, d) meters, pair by pair; weight : (N,), ≥ 0, 1 where left out
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
        """Pose of the scan in the map's frame, near the first one; arguments as ``Matcher.align``.

        The closed form has no place for the prediction's information; ``prior`` is not used.
        """
        del prior
        points, T_first = checked(points, target, T_first)
        settings = settings_of(self.config, target, wide=wide)
        T, scale_m = T_first.copy(), settings.first_scale_m
        correspondence = np.empty(len(points), np.int32)
        source, nearest, weight = np.empty_like(points), np.empty_like(points), np.empty(len(points))
        ending, iterations, pairs = icp.OUT_OF_ITERATIONS, 0, 0
        for _ in range(settings.max_iterations):
            iterations += 1
            associate(target.voxels, points, T, settings.reach, settings.max_distance_m, correspondence)
            pairs = weighted_pairs(target.voxels, points, T, correspondence, scale_m, source, nearest, weight)
            try:
                correction = rigid_transform(source[:pairs], nearest[:pairs], weight[:pairs])
            except DegeneratePairsError:
                ending = icp.SINGULAR if pairs else icp.NO_CORRESPONDENCES
                break
            T = lie.normalize(correction @ T)
            if scale_m <= settings.scale_m and self._is_small(correction, T):
                ending = icp.CONVERGED
                break
            scale_m = max(settings.scale_m, SHRINK * scale_m)
        source, weight = source[:pairs], weight[:pairs]
        errors, s2 = source - nearest[:pairs], settings.scale_m**2
        squares = np.einsum("ij,ij->i", errors, errors)
        fit = Fit(
            H=_information(source - T[:-1, -1], weight),
            cost=0.5 * float((s2 * squares / (s2 + squares)).sum()) + 0.5 * s2 * (len(points) - pairs),
            total_weight=float(weight.sum()),
            squares=float(weight @ squares),
            pairs=pairs,
            iterations=iterations,
            ending=ending,
        )
        return match_of(assess(target.voxels, points, T, fit, settings), len(points), target, self.config)

    def _is_small(self, correction: Pose, T: Pose) -> bool:
        position = T[:-1, -1]
        shift = lie.transform(correction, position[None])[0] - position
        turn = lie.rotation_angle(correction)
        return float(shift @ shift) < self.config.tolerance_m**2 and float(turn) < self.config.tolerance_rad


def _information(points: Points, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Σ w JᵀJ of point-to-point residuals about the lidar: J = [I, −p×], in 2D J = [I, (−p_y, p_x)ᵀ]."""
    d = points.shape[1]
    J = np.zeros((len(points), d, 3 if d == 2 else 6))
    J[:, :, :d] = np.eye(d)
    if d == 2:
        J[:, 0, 2], J[:, 1, 2] = -points[:, 1], points[:, 0]
    else:
        J[:, :, 3:] = -lie.hat(points)
    return np.einsum("n,nij,nik->jk", weight, J, J, optimize=True)
