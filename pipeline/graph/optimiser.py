"""Descent over a pose graph with one robust loss, by the step rule of choice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Matrix
from pipeline.graph.between import BetweenProblem, NormalEquations
from pipeline.graph.estimate import Estimate, Minimum
from pipeline.graph.robust import RobustLoss
from pipeline.graph.steps import Optimiser, step_rule
from pipeline.graph.verdicts import Verdicts

Loss = RobustLoss | Verdicts


class Minimiser:
    """Minimises Σ χ² of trusted edges plus Σ ρ(χ²) of loop edges; its step rule keeps what it learns."""

    def __init__(self, problem: BetweenProblem, is_loop: NDArray[np.bool_], optimiser: Optimiser) -> None:
        """Loop edges (E,) bool get the robust loss; the others stay quadratic."""
        self.problem = problem
        self.optimiser: Optimiser = optimiser
        self.is_loop, self.loops = is_loop, np.flatnonzero(is_loop)
        self._rule = step_rule(optimiser, problem)

    def evaluate(self, poses: Matrix, loss: Loss) -> Estimate:
        """Residuals, χ² and cost at these poses."""
        errors = self.problem.errors(poses)
        chi2 = self.problem.chi2(errors)
        return Estimate(poses, errors, chi2, self._cost(chi2, loss))

    def reweighed(self, now: Estimate, loss: Loss) -> Estimate:
        """The same poses at the cost of another loss."""
        return Estimate(now.poses, now.errors, now.chi2, self._cost(now.chi2, loss))

    def restricted(self, kept: NDArray[np.bool_]) -> Minimiser:
        """The same with some of the edges, kept (E,)."""
        return Minimiser(self.problem.restricted(kept), self.is_loop[kept], self.optimiser)

    def weights(self, chi2: NDArray[np.float64], loss: Loss) -> NDArray[np.float64]:
        """Robust weight of every edge, (E,); 1 for the trusted ones."""
        result = np.ones(len(chi2))
        result[self.loops] = loss.weight(chi2[self.loops])
        return result

    def descend(self, now: Estimate, loss: Loss, max_iterations: int, tolerance: float) -> Minimum:
        """Step after step until nothing more is to be gained."""
        for iteration in range(max_iterations):
            weights = self.weights(now.chi2, loss)
            equations = self.problem.linearise(now.poses, now.errors, weights)
            if self._flat(equations, tolerance):
                return Minimum(now, weights, iteration, True, "gradient below the tolerance")
            move = self._rule.move(now, equations, lambda poses: self.evaluate(poses, loss))
            if move is None:
                return Minimum(now, weights, iteration, False, "no step lowers χ²")
            gained, now = now.cost - move.to.cost, move.to
            if gained < 0.0:
                continue
            if gained <= tolerance * now.cost:
                return self._ended(now, loss, iteration + 1, "χ² change below the tolerance")
            if np.abs(move.step).max(initial=0.0) <= tolerance:
                return self._ended(now, loss, iteration + 1, "step below the tolerance")
        reason = f"{max_iterations} iterations reached"
        return Minimum(now, self.weights(now.chi2, loss), max_iterations, False, reason)

    def _ended(self, now: Estimate, loss: Loss, iterations: int, reason: str) -> Minimum:
        return Minimum(now, self.weights(now.chi2, loss), iterations, True, reason)

    def _flat(self, equations: NormalEquations, tolerance: float) -> bool:
        """Whether the gradient, each entry in units of its own curvature, is below the tolerance."""
        diagonal = np.maximum(equations.values[self.problem.pattern.diagonal], 1e-300)
        return bool(np.all(np.abs(equations.gradient) <= tolerance * np.sqrt(diagonal)))

    def _cost(self, chi2: NDArray[np.float64], loss: Loss) -> float:
        if loss.kernel == "none" or not len(self.loops):
            return float(chi2.sum())
        loops = chi2[self.loops]
        return float(chi2.sum() - loops.sum() + loss.loss(loops).sum())
