"""Step after step downhill by a step rule, until nothing more is to be gained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol

import numpy as np

from scanchain.graph.solvers.steps import E, LocalModel, StepRule, Vector
from scanchain.words import counted


class Landscape(Protocol[E]):
    """A cost to minimize."""

    def model(self, now: E) -> LocalModel:
        """Its quadratic model there."""
        ...

    def moved(self, now: E, step: Vector) -> E:
        """Where a step (n,) leads."""
        ...


@dataclass(frozen=True, slots=True)
class Descent(Generic[E]):
    """Where a minimization ended, after how many steps, and why."""

    end: E
    iterations: int
    converged: bool
    reason: str


def descend(landscape: Landscape[E], now: E, rule: StepRule, max_iterations: int, tolerance: float) -> Descent[E]:
    """Go downhill; done where the relative change of χ², every entry of the gradient or the step is that small.

    Entries of the gradient count in units of their own curvature; the largest counts as 1 where all are below.
    """
    for iteration in range(max_iterations):
        model = landscape.model(now)
        unit = np.sqrt(min(model.diagonal.max(initial=0.0), 1.0))
        if np.all(np.abs(model.gradient) <= unit * tolerance * np.sqrt(np.maximum(model.diagonal, 1e-300))):
            return Descent(now, iteration, True, "gradient below the tolerance")
        start = now
        move = rule.move(now, model, lambda step, start=start: landscape.moved(start, step))
        if move is None:
            return Descent(now, iteration, False, "no step lowers χ²")
        gained, now = now.cost - move.to.cost, move.to
        if gained < 0.0:
            continue
        if gained <= tolerance * now.cost:
            return Descent(now, iteration + 1, True, "χ² change below the tolerance")
        if np.abs(move.step).max(initial=0.0) <= tolerance:
            return Descent(now, iteration + 1, True, "step below the tolerance")
    return Descent(now, max_iterations, False, f"{counted(max_iterations, 'iteration')} reached")
