"""Descent over a pose graph with one robust loss, by the step rule of choice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem, NormalEquations
from scanchain.graph.robust.losses import RobustLoss
from scanchain.graph.robust.verdicts import Verdicts
from scanchain.graph.solvers.curvature import full_curvature
from scanchain.graph.solvers.descent import descend
from scanchain.graph.solvers.estimate import Estimate, Minimum
from scanchain.graph.solvers.steps import Optimizer, Vector, step_rule

Loss = RobustLoss | Verdicts


class Minimizer:
    """Minimizes Σ χ² of trusted edges plus Σ ρ(χ²) of loop edges; its step rule keeps what it learns."""

    def __init__(self, problem: BetweenProblem, is_loop: NDArray[np.bool_], optimizer: Optimizer) -> None:
        """Loop edges (E,) bool get the robust loss; the others stay quadratic."""
        self.problem = problem
        self.optimizer: Optimizer = optimizer
        self.is_loop, self.loops = is_loop, np.flatnonzero(is_loop)
        self._rule = step_rule(optimizer)

    def evaluate(self, poses: Matrix, loss: Loss) -> Estimate:
        """Residuals, χ² and cost at these poses."""
        errors = self.problem.errors(poses)
        chi2 = self.problem.chi2(errors)
        return Estimate(poses, errors, chi2, self._cost(chi2, loss))

    def reweighed(self, now: Estimate, loss: Loss) -> Estimate:
        """The same poses at the cost of another loss."""
        return Estimate(now.poses, now.errors, now.chi2, self._cost(now.chi2, loss))

    def restricted(self, kept: NDArray[np.bool_]) -> Minimizer:
        """The same with some of the edges, kept (E,)."""
        return Minimizer(self.problem.restricted(kept), self.is_loop[kept], self.optimizer)

    def weights(self, chi2: NDArray[np.float64], loss: Loss) -> NDArray[np.float64]:
        """Robust weight of every edge, (E,); 1 for the trusted ones."""
        result = np.ones(len(chi2))
        result[self.loops] = loss.weight(chi2[self.loops])
        return result

    def descend(self, now: Estimate, loss: Loss, max_iterations: int, tolerance: float) -> Minimum:
        """Step after step until nothing more is to be gained."""
        descent = descend(_Landscape(self, loss), now, self._rule, max_iterations, tolerance)
        weights = self.weights(descent.end.chi2, loss)
        return Minimum(descent.end, weights, descent.iterations, descent.converged, descent.reason)

    def _cost(self, chi2: NDArray[np.float64], loss: Loss) -> float:
        if loss.kernel == "none" or not len(self.loops):
            return float(chi2.sum())
        loops = chi2[self.loops]
        return float(chi2.sum() - loops.sum() + loss.loss(loops).sum())


class _Landscape:
    """The cost of a graph with one loss."""

    def __init__(self, minimizer: Minimizer, loss: Loss) -> None:
        self._minimizer, self._loss = minimizer, loss

    def model(self, now: Estimate) -> _Model:
        minimizer = self._minimizer
        weights = minimizer.weights(now.chi2, self._loss)
        equations = minimizer.problem.linearize(now.poses, now.errors, weights)
        is_full = minimizer.optimizer == "newton"
        curvature = full_curvature(minimizer.problem, now, equations) if is_full else equations.values
        return _Model(minimizer.problem, equations, curvature)

    def moved(self, now: Estimate, step: Vector) -> Estimate:
        return self._minimizer.evaluate(self._minimizer.problem.moved(now.poses, step), self._loss)


class _Model:
    """H = Σ w JᵀΩJ and the curvature that steps are solved with: H, or the second derivative for Newton."""

    def __init__(self, problem: BetweenProblem, equations: NormalEquations, curvature: Vector) -> None:
        self._problem, self._values, self._curvature = problem, equations.values, curvature
        self.gradient = equations.gradient
        self.diagonal = equations.values[problem.pattern.diagonal]

    def solve(self, damping: float) -> Vector:
        damped = self._curvature.copy()
        damped[self._problem.pattern.diagonal] += damping * np.where(self.diagonal > 0.0, self.diagonal, 1.0)
        self._problem.cholesky.factorize(damped)
        return self._problem.cholesky.solve(-self.gradient)

    def bend(self, step: Vector) -> Vector:
        return self._problem.pattern.multiply(self._values, step)
