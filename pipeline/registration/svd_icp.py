"""SVD-ICP: nearest voxel means and the closed-form transformation between them, in turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import MatchingConfig
from scanchain.data import Match, Points, Pose, Prior
from scanchain.kernels.registration import icp
from scanchain.kernels.registration.association import associate
from scanchain.kernels.registration.cross_covariance import weighted_pairs
from scanchain.kernels.registration.icp import SHRINK, Outcome
from scanchain.kernels.registration.match import judge
from scanchain.registration.plicp import aligned, match_of, terms_of
from scanchain.registration.svd import DegeneratePairsError, rigid_transform
from scanchain.registration.voxel_map import VoxelMap


class SvdMatcher:
    """Point-to-point ICP by singular value decomposition (Besl & McKay 1992; Arun, Huang & Blostein 1987)."""

    def __init__(self, config: MatchingConfig) -> None:
        self.config = config

    def align(
        self, points: Points, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """Pose of the scan in the map's frame, near the first one; arguments as ``PointToShapeMatcher.align``.

        The closed form has no place for the prediction's information; ``prior`` is not used.
        """
        del prior
        points, T_first = aligned(points, target, T_first)
        terms = terms_of(self.config, target, wide=wide)
        T, scale_m = T_first.copy(), terms.first_scale_m
        partner = np.empty(len(points), np.int32)
        source, nearest, weight = np.empty_like(points), np.empty_like(points), np.empty(len(points))
        ending, iterations, pairs = icp.OUT_OF_ITERATIONS, 0, 0
        for _ in range(terms.max_iterations):
            iterations += 1
            associate(target.voxels, points, T, terms.reach, terms.max_distance_m, partner)
            pairs = weighted_pairs(target.voxels, points, T, partner, scale_m, source, nearest, weight)
            try:
                correction = rigid_transform(source[:pairs], nearest[:pairs], weight[:pairs])
            except DegeneratePairsError:
                ending = icp.SINGULAR if pairs else icp.NO_PARTNERS
                break
            T = lie.normalize(correction @ T)
            if scale_m <= terms.scale_m and self._stands_still(correction, T):
                ending = icp.CONVERGED
                break
            scale_m = max(terms.scale_m, SHRINK * scale_m)
        outcome = self._outcome(
            T, source[:pairs], nearest[:pairs], weight[:pairs], len(points), iterations, ending
        )
        answer = judge(target.voxels, points, T, outcome, terms)
        return match_of(answer, len(points), target, self.config)

    def _stands_still(self, correction: Pose, T: Pose) -> bool:
        position = T[:-1, -1]
        shift = lie.transform(correction, position[None])[0] - position
        turn = lie.rotation_angle(correction)
        return float(shift @ shift) < self.config.tolerance_m**2 and float(turn) < self.config.tolerance_rad

    def _outcome(
        self,
        T: Pose,
        source: Points,
        nearest: Points,
        weight: NDArray[np.float64],
        tried: int,
        iterations: int,
        ending: int,
    ) -> Outcome:
        """Normal equations of the point-to-point residuals about the lidar: J = [I, −p×]."""
        errors = source - nearest
        squares = np.einsum("ij,ij->i", errors, errors)
        s2 = self.config.kernel_scale_m**2
        cost = 0.5 * float((s2 * squares / (s2 + squares)).sum()) + 0.5 * s2 * (tried - len(source))
        return Outcome(
            H=_information(source - T[:-1, -1], weight),
            unweighted=np.empty((0, 0)),
            cost=cost,
            weights=float(weight.sum()),
            squares=float(weight @ squares),
            pairs=len(source),
            iterations=iterations,
            ending=ending,
            origin=np.zeros(3),
            partner=np.empty(0, np.int32),
            trust=np.empty(0),
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
