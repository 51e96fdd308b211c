"""Step rules of the optimisers: where to go from the normal equations at the poses of now."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Matrix
from pipeline.graph.between import BetweenProblem, NormalEquations
from pipeline.graph.cholesky import SingularMatrixError
from pipeline.graph.curvature import full_curvature
from pipeline.graph.estimate import Estimate, Move

Optimiser = Literal["gauss-newton", "levenberg-marquardt", "dogleg", "newton", "gradient-descent"]
Evaluate = Callable[[Matrix], Estimate]
Curvature = Callable[[BetweenProblem, Estimate, NormalEquations], NDArray[np.float64]]

_MOST_DAMPING = 1e12
_FIRST_DAMPING = 1e-12  # all but Gauss-Newton: the weakest modes of a long chain have 1e-9 of diag H
_GROWTH = 8.0  # of the damping after a step that fails, four times as fast after each further one
_SHORTEST = 1e-12  # share of the first trust region, or of the best length, at which no step is worth trying


class StepRule(Protocol):
    """Makes moves; may keep what it learns from one to the next."""

    def move(self, now: Estimate, equations: NormalEquations, evaluate: Evaluate) -> Move | None:
        """One move, or None where no step lowers the cost."""
        ...


def step_rule(optimiser: Optimiser, problem: BetweenProblem) -> StepRule:
    """The rule by its name."""
    if optimiser == "gauss-newton":
        return GaussNewton(problem)
    if optimiser == "levenberg-marquardt":
        return Damped(problem, lambda problem, now, equations: equations.values)
    if optimiser == "newton":
        return Damped(problem, full_curvature)
    return Dogleg(problem) if optimiser == "dogleg" else GradientDescent(problem)


class GaussNewton:
    """x ← x − H⁻¹ g, whether or not the cost falls."""

    def __init__(self, problem: BetweenProblem) -> None:
        self._problem = problem

    def move(self, now: Estimate, equations: NormalEquations, evaluate: Evaluate) -> Move | None:
        """Raises SingularMatrixError where the edges leave a pose free."""
        self._problem.cholesky.factorise(equations.values)
        step = self._problem.cholesky.solve(-equations.gradient)
        to = evaluate(self._problem.moved(now.poses, step))
        return Move(step, to) if np.isfinite(to.cost) else None


class Damped:
    """x ← x − (C + λ diag H)⁻¹ g (Marquardt 1963), λ by the gain ratio (Nielsen 1999).

    C is H = Σ w JᵀΩJ for Levenberg-Marquardt, the second derivative of the cost for Newton.
    """

    def __init__(self, problem: BetweenProblem, curvature: Curvature) -> None:
        self._problem, self._curvature = problem, curvature
        self._damping, self._growth = _FIRST_DAMPING, _GROWTH

    def move(self, now: Estimate, equations: NormalEquations, evaluate: Evaluate) -> Move | None:
        """Damp more until the cost falls."""
        values = self._curvature(self._problem, now, equations)
        diagonal = equations.values[self._problem.pattern.diagonal]
        while self._damping < _MOST_DAMPING:
            step = self._solve(values, diagonal, equations.gradient)
            if step is not None:
                to = evaluate(self._problem.moved(now.poses, step))
                if to.cost <= now.cost:
                    predicted = float((step * (self._damping * diagonal * step - equations.gradient)).sum())
                    self._ease((now.cost - to.cost) / max(predicted, 1e-300))
                    return Move(step, to)
            self._damping *= self._growth
            self._growth *= 4.0
        self._damping, self._growth = _FIRST_DAMPING, _GROWTH
        return None

    def _solve(
        self, values: NDArray[np.float64], diagonal: NDArray[np.float64], gradient: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """The damped step; None where the matrix is still not definite."""
        damped = values.copy()
        damped[self._problem.pattern.diagonal] += self._damping * diagonal
        try:
            self._problem.cholesky.factorise(damped)
        except SingularMatrixError:
            return None
        return self._problem.cholesky.solve(-gradient)

    def _ease(self, gain: float) -> None:
        self._damping = max(self._damping * max(0.1, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3), 1e-15)
        self._growth = _GROWTH


class Dogleg:
    """Along the steepest descent and then towards the Gauss-Newton step, within a trust region (Powell 1970).

    Lengths are measured with diag H, so that metres and radians compare.
    """

    def __init__(self, problem: BetweenProblem) -> None:
        self._problem = problem
        self._radius = 0.0

    def move(self, now: Estimate, equations: NormalEquations, evaluate: Evaluate) -> Move | None:
        """Shrink the region until the cost falls; radius by Madsen et al. (2004), algorithm 3.21."""
        scale = np.sqrt(equations.values[self._problem.pattern.diagonal])
        self._problem.cholesky.factorise(equations.values)
        newton = self._problem.cholesky.solve(-equations.gradient)
        cauchy = steepest_descent(self._problem, equations)
        first = float(np.linalg.norm(scale * newton))
        self._radius = self._radius or first
        while self._radius > _SHORTEST * first:
            step = _within(newton, cauchy, scale, self._radius)
            to = evaluate(self._problem.moved(now.poses, step))
            bent = self._problem.pattern.multiply(equations.values, step)
            gain = (now.cost - to.cost) / max(float(-(step * (2.0 * equations.gradient + bent)).sum()), 1e-300)
            length = float(np.linalg.norm(scale * step))
            if gain > 0.75:
                self._radius = max(self._radius, 3.0 * length)
            elif not gain > 0.25:
                self._radius = 0.5 * min(self._radius, length)
            if to.cost <= now.cost:
                return Move(step, to)
        self._radius = 0.0
        return None


class GradientDescent:
    """Steepest descent in the measure of diag H, to the lowest point of the model, halved until it helps."""

    def __init__(self, problem: BetweenProblem) -> None:
        self._problem = problem

    def move(self, now: Estimate, equations: NormalEquations, evaluate: Evaluate) -> Move | None:
        """Go down the gradient."""
        step, share = steepest_descent(self._problem, equations), 1.0
        while share > _SHORTEST:
            to = evaluate(self._problem.moved(now.poses, share * step))
            if to.cost <= now.cost:
                return Move(share * step, to)
            share *= 0.5
        return None


def steepest_descent(problem: BetweenProblem, equations: NormalEquations) -> NDArray[np.float64]:
    """The lowest point of the quadratic model along −D⁻¹g, D = diag H."""
    direction = -equations.gradient / np.maximum(equations.values[problem.pattern.diagonal], 1e-300)
    bent = float(direction @ problem.pattern.multiply(equations.values, direction))
    return direction * (-float(direction @ equations.gradient) / max(bent, 1e-300))


def _within(
    newton: NDArray[np.float64], cauchy: NDArray[np.float64], scale: NDArray[np.float64], radius: float
) -> NDArray[np.float64]:
    """The point of the path 0 → cauchy → newton at which it leaves the region, or its end."""
    if np.linalg.norm(scale * newton) <= radius:
        return newton
    length = float(np.linalg.norm(scale * cauchy))
    if length >= radius:
        return cauchy * (radius / length)
    a, b = scale * cauchy, scale * (newton - cauchy)
    ab, bb = float(a @ b), float(b @ b)
    return cauchy + (newton - cauchy) * ((-ab + np.sqrt(ab * ab + bb * (radius**2 - length**2))) / bb)
