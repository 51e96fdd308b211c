"""Bearing-range problems minimized by the step rules of pose graphs, with any of the linear solvers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from scanchain.graph.robust.losses import RobustLoss
from scanchain.graph.solvers.cholesky import SingularMatrixError
from scanchain.graph.solvers.descent import LocalModel, descend, step_rule
from scanchain.kernels.landmarks import normal_equations
from scanchain.landmarks.bearing_range import BearingRangeProblem, Linearization
from scanchain.landmarks.problem import Values
from scanchain.landmarks.solvers import LinearSolver, UndeterminedError
from scanchain.landmarks.system import LinearSystem

Optimizer = Literal["gauss-newton", "levenberg-marquardt", "dogleg", "gradient-descent"]


class Loss(Protocol):
    """Robust loss of observations."""

    def weight(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """dρ/dχ², (N,)."""
        ...

    def loss(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """ρ(χ²), (N,)."""
        ...


QUADRATIC = RobustLoss("none", 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Minimum:
    """End of a minimization.

    Attributes
    ----------
    state : the estimate; at : residuals and A there
    weights : (N,) robust weight of every observation
    cost : Σ r² of priors and odometry plus Σ ρ(χ²) of the observations
    iterations : steps; converged, reason : whether and why it stopped
    """

    state: Values
    at: Linearization
    weights: NDArray[np.float64]
    cost: float
    iterations: int
    converged: bool
    reason: str


def minimize(
    problem: BearingRangeProblem,
    guess: Values,
    solver: LinearSolver,
    *,
    loss: Loss = QUADRATIC,
    optimizer: Optimizer = "levenberg-marquardt",
    max_iterations: int = 100,
    tolerance: float = 1e-10,
    first_damping: float = 1e-4,
) -> Minimum:
    """Follow the residuals downhill from the guess; a linearized step at a time, each solved by ``solver``.

    It ends as ``descend`` does. The first damping is for a guess that may be poor; near the minimum 1e-10
    serves better, since a long chain's weakest modes have 1e-9 of diag(AᵀA).
    """
    start = problem.linearize(guess)
    here = Evaluation(guess, start, _cost(start, loss))

    def moved(now: Evaluation, step: NDArray[np.float64]) -> Evaluation:
        state = now.state.moved(step)
        at = problem.linearize(state)
        return Evaluation(state, at, _cost(at, loss))

    def model_at(now: Evaluation) -> LocalModel:
        return _model(problem, solver, problem.system(now.at, loss.weight(now.at.observation_chi2)))

    descent = descend(model_at, moved, here, step_rule(optimizer, first_damping), max_iterations, tolerance)
    end = descent.end
    weights = loss.weight(end.at.observation_chi2)
    return Minimum(end.state, end.at, weights, end.cost, descent.iterations, descent.converged, descent.reason)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A state with its residuals and the cost of them."""

    state: Values
    at: Linearization
    cost: float


def _model(problem: BearingRangeProblem, solver: LinearSolver, system: LinearSystem) -> LocalModel:
    """H = AᵀA and g = −Aᵀb."""
    pattern = system.pattern
    downhill, diagonal = np.empty(pattern.shape[1]), np.empty(pattern.shape[1])
    normal_equations.gradient(pattern.row_start, pattern.columns, system.values, system.b, downhill, diagonal)

    def solve(damping: float) -> NDArray[np.float64]:
        if not damping:
            return solver.solve(system).x
        try:
            return solver.solve(problem.damped(system, damping * diagonal)).x
        except UndeterminedError as error:
            column = int(error.columns[0])
            raise SingularMatrixError(column, column) from error

    return LocalModel(-downhill, diagonal, solve, lambda step: system.A.T @ (system.A @ step))


def _cost(at: Linearization, loss: Loss) -> float:
    quadratic = sum(float(np.square(r).sum()) for r in (at.prior, at.calibration, at.odometry))
    return quadratic + float(loss.loss(at.observation_chi2).sum())
