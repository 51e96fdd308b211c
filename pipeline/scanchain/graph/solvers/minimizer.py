"""Minimization over a pose graph with one robust loss: cost and quadratic model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem, NormalEquations
from scanchain.graph.robust.inliers import InlierSet
from scanchain.graph.robust.losses import RobustLoss
from scanchain.graph.solvers.descent import LocalModel, Optimizer, Vector, descend, step_rule

_STEP = 1e-6  # step, m or rad, of the central differences
Loss = RobustLoss | InlierSet


class Limits(NamedTuple):
    """End of a descent: largest number of iterations, and relative change of the cost, gradient or step."""

    max_iterations: int
    tolerance: float


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Poses with what follows from them: residuals e, χ² of every edge, and the robust cost Σ ρ(χ²)."""

    poses: Matrix
    errors: Matrix
    chi2: NDArray[np.float64]
    cost: float


@dataclass(frozen=True, slots=True)
class Minimum:
    """End of a minimization: poses, robust weights (E,), number of linear solves, and reason.

    ``price`` is what leaving a loop edge out cost, in χ²; 0 where the set of inliers was not refined.
    """

    estimate: Evaluation
    weights: NDArray[np.float64]
    iterations: int
    converged: bool
    reason: str
    price: float = 0.0


def full_curvature(problem: BetweenProblem, now: Evaluation, equations: NormalEquations) -> NDArray[np.float64]:
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
    coupling = 0.5 * (by_i - np.swapaxes(by_j, 1, 2))
    of_i, of_j = (0.5 * (block + np.swapaxes(block, 1, 2)) for block in (-by_i, by_j))
    return problem.packing.values(problem.scattered(of_i, of_j, coupling))


def _slopes(
    problem: BetweenProblem, poses: Matrix, weights: NDArray[np.float64], end: int, twist: NDArray[np.float64]
) -> Matrix:
    """Slope (E, k) of every edge's ½ w χ² with a left twist of j, after one of its ends has moved."""
    ends = [poses[problem.edges[:, 0]], poses[problem.edges[:, 1]]]
    ends[end] = lie.exp(twist) @ ends[end]
    errors, jacobian = problem.between(*ends)
    pull = weights[:, None, None] * problem.information @ errors[..., None]
    return (np.swapaxes(jacobian, 1, 2) @ pull)[..., 0]


class Minimizer:
    """Minimizes Σ χ² of the quadratic edges plus Σ ρ(χ²) of loop edges, with one step rule throughout."""

    def __init__(
        self, problem: BetweenProblem, is_loop: NDArray[np.bool_], optimizer: Optimizer, limits: Limits
    ) -> None:
        """Loop edges (E,) bool get the robust loss; the others stay quadratic."""
        self.problem, self.limits = problem, limits
        self.optimizer: Optimizer = optimizer
        self.is_loop, self.loops = is_loop, np.flatnonzero(is_loop)
        self._rule = step_rule(optimizer)

    def evaluate(self, poses: Matrix, loss: Loss) -> Evaluation:
        """Residuals, χ² and cost at these poses."""
        errors = self.problem.errors(poses)
        chi2 = self.problem.chi2(errors)
        return Evaluation(poses, errors, chi2, self._cost(chi2, loss))

    def reweighed(self, now: Evaluation, loss: Loss) -> Evaluation:
        """The same poses at the cost of another loss."""
        return Evaluation(now.poses, now.errors, now.chi2, self._cost(now.chi2, loss))

    def restricted(self, kept: NDArray[np.bool_]) -> Minimizer:
        """The same with a subset of the edges, kept (E,)."""
        return Minimizer(self.problem.restricted(kept), self.is_loop[kept], self.optimizer, self.limits)

    def weights(self, chi2: NDArray[np.float64], loss: Loss) -> NDArray[np.float64]:
        """Robust weight of every edge, (E,); 1 for the quadratic ones."""
        result = np.ones(len(chi2))
        result[self.loops] = loss.weight(chi2[self.loops])
        return result

    def descend(self, now: Evaluation, loss: Loss, limits: Limits | None = None) -> Minimum:
        """Iterate until convergence, by default within the limits of all descents."""

        def moved(start: Evaluation, step: Vector) -> Evaluation:
            return self.evaluate(self.problem.moved(start.poses, step), loss)

        descent = descend(partial(self._model, loss), moved, now, self._rule, *(limits or self.limits))
        weights = self.weights(descent.end.chi2, loss)
        return Minimum(descent.end, weights, descent.iterations, descent.converged, descent.reason)

    def _model(self, loss: Loss, now: Evaluation) -> LocalModel:
        """H = Σ w JᵀΩJ and the curvature that steps are solved with: H, or the second derivative for Newton."""
        problem = self.problem
        equations = problem.linearize(now.poses, now.errors, self.weights(now.chi2, loss))
        is_full = self.optimizer == "newton"
        curvature = full_curvature(problem, now, equations) if is_full else equations.values
        diagonal = equations.values[problem.pattern.diagonal]

        def solve(damping: float) -> Vector:
            damped = curvature.copy()
            damped[problem.pattern.diagonal] += damping * np.where(diagonal > 0.0, diagonal, 1.0)
            problem.cholesky.factorize(damped)
            return problem.cholesky.solve(-equations.gradient)

        return LocalModel(equations.gradient, diagonal, solve, partial(problem.pattern.multiply, equations.values))

    def _cost(self, chi2: NDArray[np.float64], loss: Loss) -> float:
        if loss.kernel == "none" or not len(self.loops):
            return float(chi2.sum())
        loops = chi2[self.loops]
        return float(chi2.sum() - loops.sum() + loss.loss(loops).sum())
