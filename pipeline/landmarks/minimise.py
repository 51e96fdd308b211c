"""Gauss-Newton and Levenberg-Marquardt for bearing-range problems, with any of the linear solvers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.graph.robust import RobustLoss
from pipeline.kernels import normal_equations
from pipeline.landmarks.bearing_range import BearingRangeProblem, Linearisation
from pipeline.landmarks.problem import State
from pipeline.landmarks.solvers import LinearSolver
from pipeline.landmarks.system import LinearSystem

Optimiser = Literal["gauss-newton", "levenberg-marquardt"]

QUADRATIC = RobustLoss("none", 1.0, 1.0)
_LEAST_DAMPING, _MOST_DAMPING = 1e-14, 1e12
_GROWTH = 8.0  # of the damping after a step that fails, four times as fast after each further one


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where a minimisation ended.

    Attributes
    ----------
    state : the estimate; at : residuals and A there
    weights : (N,) robust weight of every observation
    cost : Σ r² of prior and odometry plus Σ ρ(χ²) of the observations
    iterations : linear solves; converged, reason : whether and why it stopped
    """

    state: State
    at: Linearisation
    weights: NDArray[np.float64]
    cost: float
    iterations: int
    converged: bool
    reason: str


def minimise(
    problem: BearingRangeProblem,
    guess: State,
    solver: LinearSolver,
    *,
    loss: RobustLoss = QUADRATIC,
    optimiser: Optimiser = "levenberg-marquardt",
    max_iterations: int = 100,
    tolerance: float = 1e-10,
    first_damping: float = 1e-4,
) -> Minimum:
    """Follow the residuals downhill from the guess; a linearised step at a time, each solved by ``solver``.

    It ends where the relative change of χ², every entry of the gradient (in units of its own curvature) or of the
    step is below the tolerance.

    Levenberg-Marquardt scales its damping by diag(AᵀA) and sets it by the gain ratio (Nielsen 1999). The first
    damping is for a guess that may be poor; near the minimum 1e-10 serves better, since a long chain's weakest
    modes have 1e-9 of diag(AᵀA).
    """
    damping, growth = (first_damping if optimiser == "levenberg-marquardt" else 0.0), _GROWTH
    state, at = guess, problem.linearise(guess)
    cost = _cost(at, loss)
    for iteration in range(max_iterations):
        weights = loss.weight(at.observation_chi2)
        system = problem.system(at, weights)
        slope, curvature = _slope(system)
        if np.all(np.abs(slope) <= tolerance * np.sqrt(curvature)):
            return Minimum(state, at, weights, cost, iteration, True, "gradient below the tolerance")
        step = solver.solve(problem.damped(system, damping * curvature) if damping else system).x
        there = state.moved(step)
        at_there = problem.linearise(there)
        gained = cost - _cost(at_there, loss)
        if damping > 0.0 and not gained >= 0.0:
            if gained > -tolerance * cost:
                return Minimum(state, at, weights, cost, iteration + 1, True, "χ² change below the tolerance")
            damping, growth = damping * growth, growth * 4.0
            if damping > _MOST_DAMPING:
                return Minimum(state, at, weights, cost, iteration + 1, False, "no step lowers χ²")
            continue
        if damping > 0.0:
            gain = min(gained / max(step @ (slope + damping * curvature * step), 1e-300), 1.0)
            damping, growth = max(damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3), _LEAST_DAMPING), _GROWTH
        state, at, cost = there, at_there, cost - gained
        weights = loss.weight(at.observation_chi2)
        if not np.isfinite(cost):
            return Minimum(state, at, weights, cost, iteration + 1, False, "diverged")
        if abs(gained) <= tolerance * cost:
            return Minimum(state, at, weights, cost, iteration + 1, True, "χ² change below the tolerance")
        if np.abs(step).max() <= tolerance:
            return Minimum(state, at, weights, cost, iteration + 1, True, "step below the tolerance")
    weights = loss.weight(at.observation_chi2)
    return Minimum(state, at, weights, cost, max_iterations, False, f"{max_iterations} iterations reached")


def _cost(at: Linearisation, loss: RobustLoss) -> float:
    trusted = float(np.square(at.prior).sum() + np.square(at.odometry).sum())
    return trusted + float(loss.loss(at.observation_chi2).sum())


def _slope(system: LinearSystem) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Aᵀb, downhill, and the diagonal of AᵀA, (n,) both."""
    g, diagonal = np.empty(system.pattern.shape[1]), np.empty(system.pattern.shape[1])
    normal_equations.gradient(
        system.pattern.row_start, system.pattern.columns, system.values, system.b, g, diagonal
    )
    return g, diagonal
