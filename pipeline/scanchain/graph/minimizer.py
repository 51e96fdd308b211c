"""Minimizers by name: Levenberg-Marquardt, Gauss-Newton, gradient descent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Generic, Literal, NamedTuple, Protocol, TypeVar

import numpy as np

from scanchain.data import Mask, Matrix, Vector
from scanchain.errors import counted
from scanchain.graph.cholesky import SingularMatrixError
from scanchain.graph.initialize import Initialization
from scanchain.graph.losses import InlierSet, RobustLoss
from scanchain.graph.problem import GraphProblem

Loss = RobustLoss | InlierSet


class Limits(NamedTuple):
    """Stopping criteria of a descent: number of iterations, and relative change of the cost, gradient or step."""

    max_iterations: int
    tolerance: float


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Poses, and the residuals e, χ² of every edge and robust cost Σ ρ(χ²) at them."""

    poses: Matrix
    errors: Matrix
    chi2: Vector
    cost: float


@dataclass(frozen=True, slots=True)
class Minimum:
    """Result of a minimization: poses, robust weights (E,), number of linear solves, why it ended, initialization.

    ``price`` is the cost of rejecting an edge that measures a whole pose, in χ²; 0 where the inlier set was not
    refined.
    """

    estimate: Evaluation
    weights: Vector
    iterations: int
    converged: bool
    reason: str
    price: float = 0.0
    initialization: Initialization = "given"


class Minimizer:
    """Minimizes Σ χ² of the quadratic edges plus Σ ρ(χ²) of robust ones, always with the same step rule."""

    def __init__(self, problem: GraphProblem, optimizer: Optimizer, limits: Limits, shares: Vector) -> None:
        """Shares (E,), as of ``limit_shares``, are the units of χ² of the edges in the truncated loss."""
        self.problem, self.limits, self.shares = problem, limits, shares
        self.optimizer: Optimizer = optimizer
        self.robust = np.flatnonzero(problem.is_robust)
        self._rule = step_rule(optimizer)

    def evaluate(self, poses: Matrix, loss: Loss) -> Evaluation:
        """Residuals, χ² and cost at these poses."""
        errors = self.problem.errors(poses)
        chi2 = self.problem.chi2(errors)
        return Evaluation(poses, errors, chi2, self._cost(chi2, loss))

    def reweighted(self, now: Evaluation, loss: Loss) -> Evaluation:
        """The same poses with the cost under another loss."""
        return Evaluation(now.poses, now.errors, now.chi2, self._cost(now.chi2, loss))

    def restricted(self, kept: Mask) -> Minimizer:
        """The same minimizer for a subset of the edges, kept (E,)."""
        return Minimizer(self.problem.restricted(kept), self.optimizer, self.limits, self.shares[kept])

    def weights(self, chi2: Vector, loss: Loss) -> Vector:
        """Robust weight of every edge, (E,); 1 for the quadratic ones."""
        result = np.ones(len(chi2))
        result[self.robust] = loss.weight(chi2[self.robust] / self._units(loss))
        return result

    def graduated(self, chi2: Vector, loss: RobustLoss) -> Iterator[RobustLoss]:
        """GNC schedule of the loss for edges that begin at these χ² (E,)."""
        return loss.graduated(chi2[self.robust] / self._units(loss))

    def descend(self, now: Evaluation, loss: Loss, limits: Limits | None = None) -> Minimum:
        """Iterate until convergence, by default within ``self.limits``."""

        def moved(start: Evaluation, step: Vector) -> Evaluation:
            return self.evaluate(self.problem.moved(start.poses, step), loss)

        descent = descend(partial(self._model, loss), moved, now, self._rule, *(limits or self.limits))
        weights = self.weights(descent.estimate.chi2, loss)
        return Minimum(descent.estimate, weights, descent.iterations, descent.converged, descent.reason)

    def _model(self, loss: Loss, now: Evaluation) -> LocalModel:
        """The model with H = Σ w JᵀΩJ."""
        problem = self.problem
        equations = problem.linearize(now.poses, now.errors, self.weights(now.chi2, loss))
        diagonal = equations.values[problem.pattern.diagonal]

        def solve(damping: float) -> Vector:
            damped = equations.values.copy()
            damped[problem.pattern.diagonal] += damping * np.where(diagonal > 0.0, diagonal, 1.0)
            problem.cholesky.factorize(damped)
            return problem.cholesky.solve(-equations.gradient)

        return LocalModel(equations.gradient, diagonal, solve, partial(problem.pattern.multiply, equations.values))

    def _cost(self, chi2: Vector, loss: Loss) -> float:
        if loss.kernel == "none" or not len(self.robust):
            return float(chi2.sum())
        of_robust, units = chi2[self.robust], self._units(loss)
        return float(chi2.sum() - of_robust.sum() + (units * loss.loss(of_robust / units)).sum())

    def _units(self, loss: Loss) -> Vector:
        """Units (L,) of the χ² of the robust edges in this loss."""
        shares = self.shares[self.robust]
        return shares if loss.kernel == "truncated" else np.ones_like(shares)


Optimizer = Literal["gauss-newton", "levenberg-marquardt", "gradient-descent"]

_DAMPING = (1e-15, 1e12)  # least and most
_GROWTH = 8.0  # factor on the damping after a failed step; it quadruples with each further failure


class Estimate(Protocol):
    """State of a minimization."""

    @property
    def cost(self) -> float:
        """χ², or the robust cost."""
        ...


E = TypeVar("E", bound=Estimate)


@dataclass(frozen=True, slots=True)
class LocalModel:
    """Quadratic model of the cost, cost(ξ) ≈ cost + 2 gᵀξ + ξᵀH ξ.

    gradient, diagonal : (n,) g and diag H
    solve : −(H + λ diag H)⁻¹ g for a damping λ; raises SingularMatrixError
    bend : H ξ of a step ξ (n,)
    """

    gradient: Vector
    diagonal: Vector
    solve: Callable[[float], Vector]
    bend: Callable[[Vector], Vector]


class GaussNewton:
    """x ← x − H⁻¹ g, whether or not the cost falls."""

    def move(self, now: E, model: LocalModel, moved: Callable[[Vector], E]) -> tuple[Vector, E] | None:
        """A step (n,) and the estimate after it; None if its cost is not finite.

        The other rules return None if no step lowers the cost. Raises SingularMatrixError where the equations do
        not determine all unknowns.
        """
        step = model.solve(0.0)
        to = moved(step)
        return (step, to) if np.isfinite(to.cost) else None


class Damped:
    """x ← x − (H + λ diag H)⁻¹ g (Marquardt 1963), λ by the gain ratio (Nielsen 1999)."""

    def __init__(self, first_damping: float) -> None:
        self._first, self._damping, self._growth = first_damping, first_damping, _GROWTH

    def move(self, now: E, model: LocalModel, moved: Callable[[Vector], E]) -> tuple[Vector, E] | None:
        """A step and the estimate after it, with the damping increased until the cost falls."""
        while self._damping < _DAMPING[1]:
            with suppress(SingularMatrixError):
                step = model.solve(self._damping)
                to = moved(step)
                if to.cost <= now.cost:
                    predicted = float((step * (self._damping * model.diagonal * step - model.gradient)).sum())
                    gain = min((now.cost - to.cost) / max(predicted, 1e-300), 1.0)
                    eased = self._damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3)
                    self._damping, self._growth = max(eased, _DAMPING[0]), _GROWTH
                    return step, to
            self._damping *= self._growth
            self._growth *= 4.0
        self._damping, self._growth = self._first, _GROWTH
        return None


class GradientDescent:
    """Steepest descent in the metric D = diag H, to the minimum of the model, halved until the cost falls."""

    def move(self, now: E, model: LocalModel, moved: Callable[[Vector], E]) -> tuple[Vector, E] | None:
        """A step along the negative gradient and the estimate after it."""
        direction, share = -model.gradient / np.maximum(model.diagonal, 1e-300), 1.0
        bent = float(direction @ model.bend(direction))
        step = direction * (-float(direction @ model.gradient) / max(bent, 1e-300))
        while share > 1e-12:  # of the model's best step
            to = moved(share * step)
            if to.cost <= now.cost:
                return share * step, to
            share *= 0.5
        return None


StepRule = GaussNewton | Damped | GradientDescent


def step_rule(optimizer: Optimizer, first_damping: float = 1e-12) -> StepRule:
    """Step rule of this name; at first almost Gauss-Newton: weak modes of a long chain have 1e-9 of diag H."""
    if optimizer == "levenberg-marquardt":
        return Damped(first_damping)
    return GaussNewton() if optimizer == "gauss-newton" else GradientDescent()


@dataclass(frozen=True, slots=True)
class Descent(Generic[E]):
    """Result of a descent: estimate, number of steps and why it ended."""

    estimate: E
    iterations: int
    converged: bool
    reason: str


def descend(
    model_at: Callable[[E], LocalModel],
    moved: Callable[[E, Vector], E],
    now: E,
    rule: StepRule,
    max_iterations: int,
    tolerance: float,
) -> Descent[E]:
    """Descend until the relative change of χ², every entry of the gradient, or the step is below the tolerance.

    Each entry of the gradient is divided by √(diag H), and also by √(max diag H) where that is below 1.

    model_at : quadratic model of the cost at an estimate
    moved : the estimate after a step (n,)
    """
    for iteration in range(max_iterations):
        model = model_at(now)
        unit = np.sqrt(min(model.diagonal.max(initial=0.0), 1.0))
        if np.all(np.abs(model.gradient) <= unit * tolerance * np.sqrt(np.maximum(model.diagonal, 1e-300))):
            return Descent(now, iteration, True, "gradient below the tolerance")
        move = rule.move(now, model, partial(moved, now))
        if move is None:
            return Descent(now, iteration, False, "no step lowers χ²")
        step, to = move
        gained, now = now.cost - to.cost, to
        if gained < 0.0:
            continue
        if gained <= tolerance * now.cost:
            return Descent(now, iteration + 1, True, "χ² change below the tolerance")
        if np.abs(step).max(initial=0.0) <= tolerance:
            return Descent(now, iteration + 1, True, "step below the tolerance")
    return Descent(now, max_iterations, False, f"{counted(max_iterations, 'iteration')} reached")
