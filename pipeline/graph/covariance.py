"""Covariances of poses from the factor of H, without its inverse."""

from __future__ import annotations

import numpy as np

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem


def own_covariances(problem: BetweenProblem) -> Matrix:
    """Covariance (K, k, k) of every pose's twist in its own frame, T exp(ξ); the fixed ones zero, a point's 2 × 2.

    By the selected inverse of H over such twists, which the problem's solver has factored. Twists are
    (translation, rotation), so the units are m², m rad, rad².
    """
    k = problem.freedom
    result = np.zeros((len(problem.variable), k, k))
    result[problem.free] = problem.packing.blocks(problem.cholesky.inverse_blocks())[: len(problem.free)]
    return result


def relative_covariance(problem: BetweenProblem, poses: Matrix, i: int, j: int) -> Matrix:
    """Covariance (k, k) of a right twist on T_i⁻¹ T_j, Ad(T_j⁻¹) Cov(ξ_j − ξ_i) Ad(T_j⁻¹)ᵀ."""
    adjoint = lie.adjoint(lie.inverse(poses[j]))
    return adjoint @ difference_covariance(problem, i, j) @ adjoint.T


def difference_covariance(problem: BetweenProblem, i: int, j: int) -> Matrix:
    """Cov(ξ_j − ξ_i), (k, k), of the left twists of two poses, by k solves with the factor of H."""
    selection = np.zeros((len(problem.free), problem.freedom, problem.freedom))
    for pose, sign in ((i, -1.0), (j, 1.0)):
        if problem.variable[pose] >= 0:
            selection[problem.variable[pose]] += sign * np.eye(problem.freedom)
    flat = problem.packing.rows(selection)
    return flat.T @ problem.cholesky.solve(flat)
