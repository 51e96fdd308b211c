"""A graph's problem from its first guess to the poses of its minimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.config import GraphConfig
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.initialize import Initialization, first_guess
from scanchain.graph.robust.graduation import Judgment, minimize
from scanchain.graph.robust.losses import robust_loss
from scanchain.graph.solvers.estimate import Minimum
from scanchain.graph.solvers.optimizer import Minimizer


@dataclass(frozen=True, slots=True)
class Solved:
    """Poses (K, d+1, d+1) of the minimum, the minimum itself, and whence it began."""

    poses: Matrix
    minimum: Minimum
    initialization: Initialization


def solve(
    problem: BetweenProblem,
    poses: Matrix,
    is_loop: NDArray[np.bool_],
    config: GraphConfig,
    initialize: Initialization,
    judgment: Judgment,
) -> Solved:
    """Minimize from the chosen guess; fixed poses stay to the bit. Loop edges (E,) bool get the robust loss.

    Raises SingularMatrixError where the edges leave a pose free, and the optimizer minds.
    """
    trusted = config.robust == "none" or not is_loop.any()
    guess, source = first_guess(problem, poses, initialize, trusted=trusted)
    shift = guess[:, :-1, -1].mean(axis=0)  # left twists turn about the origin: bring it into the middle
    guess[:, :-1, -1] -= shift
    loss = robust_loss(config.robust, config.robust_scale, problem.freedom)
    minimizer = Minimizer(problem, is_loop, config.optimizer)
    minimum = minimize(minimizer, guess, loss, config.max_iterations, config.tolerance, judgment)
    found = _orthonormal(minimum.estimate.poses)
    found[:, :-1, -1] += shift
    fixed = problem.variable < 0
    found[fixed] = poses[fixed]
    return Solved(found, minimum, source)


def _orthonormal(poses: Matrix) -> Matrix:
    """Poses whose nearly orthonormal rotations are made so again, R (3 I − RᵀR) / 2, one Newton step."""
    result, d = poses.copy(), poses.shape[-1] - 1
    R = poses[:, :d, :d]
    result[:, :d, :d] = R @ (1.5 * np.eye(d) - 0.5 * np.swapaxes(R, 1, 2) @ R)
    return result
