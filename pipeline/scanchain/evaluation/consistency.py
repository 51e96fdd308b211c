"""Consistency of odometries: NEES of their motions, and disagreement of methods without ground truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix


def motion_nees(poses: Matrix, covariances: Matrix, reference: Matrix) -> NDArray[np.float64]:
    """(N−1,) ξᵀ Σ⁻¹ ξ / k of the motion between each pose and the next: 1 on average is exact, more overconfident.

    poses, reference : (N, d+1, d+1) estimate and truth at the same instants
    covariances : (N, k, k) of each pose by itself, of a twist in its own frame, T exp(ξ); where one is NaN so is
        the answer. With M the motion, Σ = Σ_i+1 + Ad(M⁻¹) Σ_i Ad(M⁻¹)ᵀ, because both poses err independently.
    """
    motion = lie.between(poses[:-1], poses[1:])
    true_motion = lie.between(reference[:-1], reference[1:])
    error = lie.log(lie.between(true_motion, motion))
    Ad = lie.adjoint(lie.inverse(motion))
    covariance = covariances[1:] + Ad @ covariances[:-1] @ np.swapaxes(Ad, 1, 2)
    result = np.full(len(motion), np.nan)
    known = np.isfinite(covariance).all(axis=(1, 2))
    weighted = np.linalg.pinv(covariance[known], hermitian=True) @ error[known, :, None]
    result[known] = np.einsum("ni,ni->n", error[known], weighted[..., 0]) / error.shape[1]
    return result


def disagreement(trajectories: Sequence[Matrix]) -> NDArray[np.float64]:
    """(M, M) meters: median over the scans of the distance between the motions that two methods find for a scan.

    trajectories : M times poses (N, d+1, d+1) of the same scans, (0, d+1, d+1) of a method that has failed
    NaN where one of the two has failed.
    """
    motions = [lie.between(poses[:-1], poses[1:]) for poses in trajectories]
    result = np.full((len(motions), len(motions)), np.nan)
    for row, first in enumerate(motions):
        for column, second in enumerate(motions):
            if len(first) and len(second):
                error = lie.between(first, second)
                result[row, column] = float(np.median(np.linalg.norm(error[:, :-1, -1], axis=1)))
    return result
