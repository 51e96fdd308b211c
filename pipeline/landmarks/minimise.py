"""Gauss-Newton and Levenberg-Marquardt for bearing-range problems, with any of the linear solvers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.graph.robust import RobustLoss
from pipeline.landmarks.bearing_range import BearingRangeProblem, Linearisation
from pipeline.landmarks.problem import State
from pipeline.landmarks.solvers import LinearSolver
from pipeline.landmarks.system import LinearSystem

Optimiser = Literal["gauss-newton", "levenberg-marquardt"]

QUADRATIC = RobustLoss("none", 1.0, 1.0)
_FIRST_DAMPING, _MOST_DAMPING = 1e-4, 1e12
_SMALL = 1e-10  # relative χ² change, gradient and step at which there is no more to gain


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
) -> Minimum:
    """Follow the residuals downhill from the guess; a linearised step at a time, each solved by ``solver``.

    Levenberg-Marquardt scales its damping by diag(AᵀA) and sets it by the gain ratio (Nielsen 1999).
    """
    damping, growth = (_FIRST_DAMPING if optimiser == "levenberg-marquardt" else 0.0), 2.0
    state, at = guess, problem.linearise(guess)
    cost = _cost(at, loss)
    for iteration in range(max_iterations):
        weights = loss.weight(at.observation_chi2)
        system = problem.system(at, weights, damping)
        if _is_flat(system):
            return Minimum(state, at, weights, cost, iteration, True, "gradient below the tolerance")
        step = solver.solve(system).x
        there = state.moved(step)
        at_there = problem.linearise(there)
        gained = cost - _cost(at_there, loss)
        if damping > 0.0 and not gained >= 0.0:
            if gained > -_SMALL * cost:
                return Minimum(state, at, weights, cost, iteration + 1, True, "χ² change below the tolerance")
            damping, growth = damping * growth, growth * 2.0
            if damping > _MOST_DAMPING:
                return Minimum(state, at, weights, cost, iteration + 1, False, "no step lowers χ²")
            continue
        if damping > 0.0:
            gain = min(gained / max(_predicted(system, step), 1e-300), 1.0)
            damping, growth = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-12), 2.0
        state, at, cost = there, at_there, cost - gained
        if not np.isfinite(cost):
            return Minimum(state, at, weights, cost, iteration + 1, False, "diverged")
        if abs(gained) <= _SMALL * cost:
            weights = loss.weight(at.observation_chi2)
            return Minimum(state, at, weights, cost, iteration + 1, True, "χ² change below the tolerance")
        if np.abs(step).max() <= _SMALL:
            return Minimum(state, at, weights, cost, iteration + 1, True, "step below the tolerance")
    weights = loss.weight(at.observation_chi2)
    return Minimum(state, at, weights, cost, max_iterations, False, f"{max_iterations} iterations reached")


def _cost(at: Linearisation, loss: RobustLoss) -> float:
    trusted = float(np.square(at.prior).sum() + np.square(at.odometry).sum())
    return trusted + float(loss.loss(at.observation_chi2).sum())


def _predicted(system: LinearSystem, step: NDArray[np.float64]) -> float:
    """What the linear model gains by the step, damping included."""
    return float(np.square(system.b).sum() - np.square(system.A @ step - system.b).sum())


def _is_flat(system: LinearSystem) -> bool:
    """Whether the gradient, each entry in units of its own curvature, has vanished."""
    columns, rows = system.pattern.columns, np.repeat(np.arange(len(system.b)), np.diff(system.pattern.row_start))
    gradient = np.bincount(columns, system.values * system.b[rows], system.pattern.shape[1])
    curvature = np.bincount(columns, system.values**2, system.pattern.shape[1])
    return bool(np.all(np.abs(gradient) <= _SMALL * np.sqrt(curvature)))
