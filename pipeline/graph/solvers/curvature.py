"""The second derivative of a graph's cost, for Newton's method."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem, NormalEquations
from scanchain.graph.solvers.estimate import Estimate

_STEP = 1e-6  # m or rad, of the central differences


def full_curvature(problem: BetweenProblem, now: Estimate, equations: NormalEquations) -> NDArray[np.float64]:
    """∂²(½ Σ w eᵀΩe)/∂ξ² as block values of the problem's pattern, the weights held.

    Gauss-Newton leaves out eᵀΩ ∂²e/∂ξ². Here the slope JᵀwΩe of every edge is differentiated by central
    differences over left twists of both ends; a second derivative in exponential coordinates is symmetric.
    """
    k, count = problem.freedom, len(problem.edges)
    turned = np.empty((2, k, count, k))
    for end in range(2):
        for axis in range(k):
            twist = np.zeros(k)
            twist[axis] = _STEP
            ahead, back = (_slopes(problem, now.poses, equations.weights, end, sign * twist) for sign in (1, -1))
            turned[end, axis] = (ahead - back) / (2.0 * _STEP)
    by_i, by_j = turned.transpose(0, 2, 1, 3)  # (E, k, k): row is the axis moved, column that of the slope at j
    both = 0.5 * (by_i - np.swapaxes(by_j, 1, 2))
    blocks = np.zeros((len(problem.pattern.rows), k, k))
    i, j, pair = problem.slots.T
    for slot, block in ((i, -by_i), (j, by_j)):
        np.add.at(blocks, slot[slot >= 0], 0.5 * (block + np.swapaxes(block, 1, 2))[slot >= 0])
    coupling = np.where((i > j)[:, None, None], both, np.swapaxes(both, 1, 2))
    np.add.at(blocks, pair[pair >= 0], coupling[pair >= 0])
    return problem.packing.values(blocks)


def _slopes(
    problem: BetweenProblem, poses: Matrix, weights: NDArray[np.float64], end: int, twist: NDArray[np.float64]
) -> Matrix:
    """Slope (E, k) of every edge's ½ w χ² with a left twist of j, after one of its ends has moved."""
    ends = [poses[problem.edges[:, 0]], poses[problem.edges[:, 1]]]
    ends[end] = lie.exp(twist) @ ends[end]
    errors, jacobian = problem.between(*ends)
    pull = weights[:, None, None] * problem.information @ errors[..., None]
    return (np.swapaxes(jacobian, 1, 2) @ pull)[..., 0]
