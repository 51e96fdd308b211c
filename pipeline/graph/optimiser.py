"""Gauss-Newton and Levenberg-Marquardt over a pose graph, with robust and graduated loop edges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from pipeline.data import Matrix
from pipeline.graph.between import BetweenProblem, NormalEquations
from pipeline.graph.cholesky import SingularMatrixError
from pipeline.graph.robust import GRADUATED, RobustLoss
from pipeline.graph.verdicts import Verdicts, contradictions

Optimiser = Literal["gauss-newton", "levenberg-marquardt"]

_MOST_DAMPING = 1e12
_FIRST_DAMPING = 1e-12  # all but Gauss-Newton: the weakest modes of a long chain have 1e-9 of diag H
_MOST_ROUNDS = 50  # of mending verdicts
_GROWTH = 8.0  # of the damping after a step that fails, four times as fast after each further one


@dataclass(frozen=True, slots=True)
class Estimate:
    """Poses with what follows from them: residuals e, χ² of every edge, and the robust cost Σ ρ(χ²)."""

    poses: Matrix
    errors: Matrix
    chi2: NDArray[np.float64]
    cost: float


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where a minimisation ended, with what robust weights (E,), after how many linear solves, and why."""

    estimate: Estimate
    weights: NDArray[np.float64]
    iterations: int
    converged: bool
    reason: str


class Minimiser:
    """Minimises Σ χ² of trusted edges plus Σ ρ(χ²) of loop edges; keeps its damping between calls."""

    def __init__(self, problem: BetweenProblem, is_loop: NDArray[np.bool_], optimiser: Optimiser) -> None:
        """Loop edges (E,) bool get the robust loss; the others stay quadratic."""
        self._problem = problem
        self._loops = np.flatnonzero(is_loop)
        self._damped = optimiser == "levenberg-marquardt"
        self._damping, self._growth = _FIRST_DAMPING, _GROWTH

    def evaluate(self, poses: Matrix, loss: RobustLoss | Verdicts) -> Estimate:
        """Residuals, χ² and cost at these poses."""
        errors = self._problem.errors(poses)
        chi2 = self._problem.chi2(errors)
        return Estimate(poses, errors, chi2, self._cost(chi2, loss))

    def weights(self, chi2: NDArray[np.float64], loss: RobustLoss | Verdicts) -> NDArray[np.float64]:
        """Robust weight of every edge, (E,); 1 for the trusted ones."""
        result = np.ones(len(chi2))
        result[self._loops] = loss.weight(chi2[self._loops])
        return result

    def minimise(self, poses: Matrix, loss: RobustLoss, max_iterations: int, tolerance: float) -> Minimum:
        """Minimise from these poses; a kernel that is not convex is graduated first (Yang et al. 2020)."""
        now, used = self.evaluate(poses, loss), 0
        if loss.kernel in GRADUATED and len(self._loops):
            now, loss, used = self._graduate(now, loss)
        minimum = self._descend(now, loss, max_iterations, tolerance)
        weights = self.weights(minimum.estimate.chi2, loss)
        minimum = replace(minimum, weights=weights, iterations=used + minimum.iterations)
        if loss.kernel == "truncated" and len(self._loops):
            minimum = self._mend(minimum, loss.scale**2, max_iterations, tolerance)
        return minimum

    def _mend(self, minimum: Minimum, price: float, max_iterations: int, tolerance: float) -> Minimum:
        """Change verdicts that the other edges contradict, as long as the truncated cost falls."""
        share = 1.0
        for round in range(_MOST_ROUNDS):
            kept = minimum.weights[self._loops] > 0.5
            against = contradictions(self._problem, minimum.estimate.poses, minimum.weights)[self._loops]
            if round == 0:
                price *= _pessimism(against[kept], self._problem.freedom)
                print('price', price)
                minimum = replace(minimum, estimate=self._reweighed(minimum.estimate, Verdicts(kept, price)))
            gain = np.where(kept, against - price, price - against)
            if not (gain > 0.0).any():
                break
            changed = gain > (1.0 - share) * gain.max()
            verdicts = Verdicts(kept ^ changed, price)
            start = self._reweighed(minimum.estimate, verdicts)
            trial = self._descend(start, verdicts, max_iterations, tolerance)
            print('mend', share, 'drop', (changed&kept).sum(), 'add', (changed&~kept).sum(), minimum.estimate.cost, trial.estimate.cost)
            if trial.estimate.cost < minimum.estimate.cost:
                minimum = replace(trial, weights=self.weights(trial.estimate.chi2, verdicts),
                                  iterations=minimum.iterations + trial.iterations)
                share = 1.0
            elif share > 1e-3:
                share *= 0.3
            else:
                break
        return minimum

    def _graduate(self, now: Estimate, loss: RobustLoss) -> tuple[Estimate, RobustLoss, int]:
        """Follow the minimum from the convex loss to the loss itself, one step for each level."""
        used = 0
        loss = loss.started(now.chi2[self._loops])
        while not loss.settled(now.chi2[self._loops]):
            minimum = self._descend(self._reweighed(now, loss), loss, 1, 0.0)
            now, used = minimum.estimate, used + minimum.iterations
            loss = loss.tightened()
        return self._reweighed(now, loss), loss, used

    def _reweighed(self, now: Estimate, loss: RobustLoss | Verdicts) -> Estimate:
        return Estimate(now.poses, now.errors, now.chi2, self._cost(now.chi2, loss))

    def _descend(self, now: Estimate, loss: RobustLoss | Verdicts, max_iterations: int, tolerance: float) -> Minimum:
        """Iterate x ← x − (H + λ diag H)⁻¹ g until nothing more is to be gained."""
        weights = np.ones(len(now.chi2))
        for iteration in range(max_iterations):
            weights = self.weights(now.chi2, loss)
            equations = self._problem.linearise(now.poses, now.errors, weights)
            if self._flat(equations, tolerance):
                return Minimum(now, weights, iteration, True, "gradient below the tolerance")
            step, following = self._step(now, equations, loss)
            if following is None:
                return Minimum(now, weights, iteration, False, "no step lowers χ²")
            gained, now = now.cost - following.cost, following
            if gained < 0.0:
                continue
            if gained <= tolerance * now.cost:
                return Minimum(now, weights, iteration + 1, True, "χ² change below the tolerance")
            if np.abs(step).max(initial=0.0) <= tolerance:
                return Minimum(now, weights, iteration + 1, True, "step below the tolerance")
        return Minimum(now, weights, max_iterations, False, f"{max_iterations} iterations reached")

    def _step(
        self, now: Estimate, equations: NormalEquations, loss: RobustLoss | Verdicts
    ) -> tuple[NDArray[np.float64], Estimate | None]:
        """Return one step and where it leads; None where no damping makes it one that lowers the cost."""
        while self._damping < _MOST_DAMPING:
            step = self._solve(equations)
            if step is not None:
                following = self.evaluate(self._problem.moved(now.poses, step), loss)
                if not self._damped and np.isfinite(following.cost):
                    return step, following
                if self._accept(now.cost - following.cost, step, equations):
                    return step, following
            if not self._damped:
                break
            self._damping *= self._growth
            self._growth *= 4.0
        self._damping, self._growth = _FIRST_DAMPING, _GROWTH
        return np.zeros(0), None

    def _solve(self, equations: NormalEquations) -> NDArray[np.float64] | None:
        """Solve (H + λ diag H) ξ = −g; None where the damped matrix is still singular."""
        values, diagonal = equations.values, self._problem.pattern.diagonal
        if self._damped:
            values = values.copy()
            values[diagonal] *= 1.0 + self._damping
        try:
            self._problem.cholesky.factorise(values)
        except SingularMatrixError:
            if not self._damped:
                raise
            return None
        return self._problem.cholesky.solve(-equations.gradient)

    def _accept(self, gained: float, step: NDArray[np.float64], equations: NormalEquations) -> bool:
        """Update λ by the gain ratio, true over predicted decrease (Nielsen 1999)."""
        diagonal = equations.values[self._problem.pattern.diagonal]
        predicted = float((step * (self._damping * diagonal * step - equations.gradient)).sum())
        if not gained >= 0.0:
            return False
        gain = min(gained / max(predicted, 1e-300), 1.0)
        self._damping = max(self._damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-15)
        self._growth = _GROWTH
        return True

    def _flat(self, equations: NormalEquations, tolerance: float) -> bool:
        """Whether the gradient, each entry in units of its own curvature, is below the tolerance."""
        diagonal = np.maximum(equations.values[self._problem.pattern.diagonal], 1e-300)
        return bool(np.all(np.abs(equations.gradient) <= tolerance * np.sqrt(diagonal)))

    def _cost(self, chi2: NDArray[np.float64], loss: RobustLoss | Verdicts) -> float:
        if loss.kernel == "none" or not len(self._loops):
            return float(chi2.sum())
        loops = chi2[self._loops]
        return float(chi2.sum() - loops.sum() + loss.loss(loops).sum())


def _pessimism(against, degrees):
    """Share of the nominal price."""
    if len(against) < 10:
        return 1.0
    return min(1.0, 4.0 * float(np.median(against)) / float(2.0 * gammaincinv(0.5 * degrees, 0.5)))
