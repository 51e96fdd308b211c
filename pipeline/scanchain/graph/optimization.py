"""Optimization of a pose graph from its first guess to the minimum, and its result."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain.config import GraphConfig
from scanchain.data import GraphState, Matrix, brief, fit_text
from scanchain.errors import counted
from scanchain.graph.between import BetweenProblem
from scanchain.graph.edge_checks import has_loop
from scanchain.graph.graduation import LIMITS, Since, minimize, update
from scanchain.graph.initialize import Initialization, first_guess
from scanchain.graph.losses import robust_loss
from scanchain.graph.minimizer import Limits, Minimizer, Minimum


@dataclass(frozen=True, slots=True)
class GraphChange:
    """A graph before and after, for pictures and recordings, each with the edges that were in force then."""

    name: str
    before: GraphState
    after: GraphState


def fit(state: GraphState) -> str:
    """Fit of the edges in force as text."""
    count = int(state.is_rejected.sum())
    rejected = f"{counted(count, 'edge')} rejected" if count else ""
    return fit_text(state.chi2, state.degrees_of_freedom, rejected, has_loops=has_loops(state))


def has_loops(state: GraphState) -> bool:
    """True if an edge in force joins poses that the others join already."""
    return has_loop(state.edges[~state.is_rejected], len(state.poses))


@dataclass(frozen=True, slots=True)
class Optimization:
    """Result of ``PoseGraph.optimize``.

    Attributes
    ----------
    state : the graph as it is now
    chi2_before, chi2_after : Σ w eᵀΩe over the edges in force before and after, at the poses of then
    cost_after : what was minimized: Σ eᵀΩe of all edges, with the robust loss of the loop edges
    iterations : linear solves
    converged, reason : whether and why the iteration stopped
    initialization : where the first guess came from
    time_s : wall time
    """

    __repr__ = brief
    state: GraphState
    chi2_before: float
    chi2_after: float
    cost_after: float
    iterations: int
    converged: bool
    reason: str
    initialization: Initialization
    time_s: float

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(E,) bool, in the order of ``state.edges``: loop edges that contradict the rest."""
        return self.state.is_rejected


def solve(
    problem: BetweenProblem,
    poses: Matrix,
    is_loop: NDArray[np.bool_],
    config: GraphConfig,
    initialize: Initialization,
    since: Since | None = None,
    *,
    groups: bool = True,
) -> Minimum:
    """Minimize from the chosen guess; fixed poses stay to the bit. Loop edges (E,) bool get the robust loss.

    since : for an update, under the truncated loss; groups : otherwise, as for ``minimize``
    Raises SingularMatrixError where the edges leave a pose free, and the optimizer minds.
    """
    outlier_free = config.robust == "none" or not is_loop.any()
    guess, source = first_guess(problem, poses, initialize, outlier_free=outlier_free)
    joined = np.unique(problem.edges) if len(problem.edges) else slice(None)
    shift = guess[joined, :-1, -1].mean(axis=0)  # left twists turn about the origin: bring it into the middle
    guess[:, :-1, -1] -= shift
    loss = robust_loss(config.robust, config.robust_scale, problem.freedom)
    if since is not None:
        minimum = update(Minimizer(problem, is_loop, config.optimizer, LIMITS), guess, loss, since)
    else:
        limits = Limits(config.max_iterations, config.tolerance)
        minimum = minimize(Minimizer(problem, is_loop, config.optimizer, limits), guess, loss, groups=groups)
    found = _orthonormal(minimum.estimate.poses)
    found[:, :-1, -1] += shift
    fixed = problem.variable < 0
    found[fixed] = poses[fixed]
    return replace(minimum, estimate=replace(minimum.estimate, poses=found), initialization=source)


def _orthonormal(poses: Matrix) -> Matrix:
    """Poses whose nearly orthonormal rotations are made so again, R (3 I − RᵀR) / 2, one Newton step."""
    result, d = poses.copy(), poses.shape[-1] - 1
    R = poses[:, :d, :d]
    result[:, :d, :d] = R @ (1.5 * np.eye(d) - 0.5 * np.swapaxes(R, 1, 2) @ R)
    return result
