"""SVD-ICP: nearest voxel means and the closed-form transformation between them, in turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import MatchingConfig
from scanchain.data import AnyPoints, Match, Points, Pose, Prior
from scanchain.kernels.registration import icp
from scanchain.kernels.registration.association import associate, weighted_pairs
from scanchain.kernels.registration.icp import SHRINK, Fit
from scanchain.kernels.registration.match import assess
from scanchain.registration.plicp import checked, match_of, settings_of
from scanchain.registration.svd import DegeneratePairsError, rigid_transform
from scanchain.registration.voxel_map import VoxelMap


class SvdMatcher:
    """Point-to-point ICP by singular value decomposition (Besl & McKay 1992; Arun, Huang & Blostein 1987)."""

    def __init__(self, config: MatchingConfig) -> None:
        self.config = config

    def align(
        self, points: AnyPoints, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """Pose of the scan in the map's frame, near the first one; arguments as ``PointToShapeMatcher.align``.

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
        fit = self._fit(T, source[:pairs], nearest[:pairs], weight[:pairs], len(points), iterations, ending)
        result = assess(target.voxels, points, T, fit, settings)
        return match_of(result, len(points), target, self.config)

    def _is_small(self, correction: Pose, T: Pose) -> bool:
        position = T[:-1, -1]
        shift = lie.transform(correction, position[None])[0] - position
        turn = lie.rotation_angle(correction)
        return float(shift @ shift) < self.config.tolerance_m**2 and float(turn) < self.config.tolerance_rad

    def _fit(
        self,
        T: Pose,
        source: Points,
        nearest: Points,
        weight: NDArray[np.float64],
        tried: int,
        iterations: int,
        ending: int,
    ) -> Fit:
        """Normal equations of the point-to-point residuals about the lidar: J = [I, −p×]."""
        errors = source - nearest
        squares = np.einsum("ij,ij->i", errors, errors)
        s2 = self.config.kernel_scale_m**2
        cost = 0.5 * float((s2 * squares / (s2 + squares)).sum()) + 0.5 * s2 * (tried - len(source))
        return Fit(
            H=_information(source - T[:-1, -1], weight),
            unweighted=np.empty((0, 0)),
            cost=cost,
            total_weight=float(weight.sum()),
            squares=float(weight @ squares),
            pairs=len(source),
            iterations=iterations,
            ending=ending,
        )


def _information(points: Points, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Σ w JᵀJ with J = [I, −p×]; in 2D J = [I, (−p_y, p_x)ᵀ]."""
    d = points.shape[1]
    J = np.zeros((len(points), d, 3 if d == 2 else 6))
    J[:, :, :d] = np.eye(d)
    if d == 2:
        J[:, 0, 2], J[:, 1, 2] = -points[:, 1], points[:, 0]
    else:
        J[:, :, 3:] = -lie.hat(points)
    return np.einsum("n,nij,nik->jk", weight, J, J, optimize=True)
