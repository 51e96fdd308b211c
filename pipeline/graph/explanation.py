"""Errors of odometry that explain loop edges which contradict it: a systematic drift, and slips."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain.config import GraphConfig
from scanchain.data import REJECTED_WEIGHT, Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.initialize import Initialization
from scanchain.graph.optimization import Solved, solve
from scanchain.graph.robust.drift import corrected, drift_step, penalty, size
from scanchain.graph.robust.graduation import OutlierRejection
from scanchain.graph.robust.groups import apart
from scanchain.graph.robust.slips import Slip, next_slip, price_of, without_slips

_WORTH = 3.0  # loop edges, none near another, that a systematic drift must bring in, less what it costs
_FEWEST = 2  # least number of loop edges left out, none near another, that are to be explained
_MAX_STEPS = 20  # largest number of changes of an explanation in one optimization
_SETTLED = 0.1  # share of the price of a loop edge below which a change gains nothing


@dataclass(frozen=True, slots=True)
class Explanation:
    """Errors of odometry.

    Attributes
    ----------
    drift : (2,) or (4,) share of its way by which odometry is too short, and radians a meter it turns too little
    slips : stretches of odometry that are too short by more than their edges say
    """

    drift: NDArray[np.float64]
    slips: tuple[Slip, ...] = ()

    @classmethod
    def none(cls, freedom: int) -> Explanation:
        """Odometry as it is."""
        return cls(np.zeros(size(freedom)))

    def measurements(self, measured: Matrix, information: Matrix, is_loop: NDArray[np.bool_]) -> Matrix:
        """Measurements (E, d+1, d+1) with drift and slips taken out of odometry."""
        if not self.drift.any() and not self.slips:
            return measured
        result, odometry = measured.copy(), ~is_loop
        result[odometry] = corrected(
            without_slips(measured[odometry], information[odometry], self.slips), self.drift
        )
        return result

    def cost(self, measured: Matrix, information: Matrix, is_loop: NDArray[np.bool_], price: float) -> float:
        """Cost of the explanation itself, where a loop edge left out costs this price."""
        odometry = ~is_loop
        of_slips = sum(price_of(slip, measured[odometry], information[odometry]) for slip in self.slips)
        return of_slips + penalty(self.drift) + (_WORTH * price if self.drift.any() else 0.0)


def corrections(
    explanation: Explanation, edges: NDArray[np.int64], names: NDArray[np.int64], noun: str
) -> list[str]:
    """Corrections of odometry in words, a line each.

    edges : (O, 2) those of odometry; names (K,), noun : numbers of the poses for the reader, and what they number
    """
    lines = []
    if explanation.drift.any():
        scale, *turns = explanation.drift.tolist()
        turn = ", ".join(f"{1e3 * rad_per_m:+.1f}" for rad_per_m in turns)
        lines.append(f"corrected by loop closures: length {100.0 * scale:+.1f} %, turn {turn} mrad/m")
    for slip in explanation.slips:
        first, last = (names[pose] for pose in (edges[slip.edges][0, 0], edges[slip.edges][-1, 1]))
        lines.append(
            f"corrected by loop closures: a slip of {slip.size_m:+.1f} m between {noun} {first:,} and {last:,}"
        )
    return lines


@dataclass(frozen=True, slots=True)
class Explained:
    """The minimum of the problem under an explanation."""

    problem: BetweenProblem
    solved: Solved
    explanation: Explanation


class Explainer:
    """Optimizes a graph with explanations that lower the cost by more than they cost themselves."""

    def __init__(
        self,
        problem_of: Callable[[Explanation], BetweenProblem],
        measured: Matrix,
        is_loop: NDArray[np.bool_],
        config: GraphConfig,
        rejection: OutlierRejection,
        unexplained: int,
    ) -> None:
        """problem_of : the problem under an explanation; measured : (E, d+1, d+1) as odometry has it.

        unexplained : number of loop edges left out for which no slip was found; until there are more, slips are
            looked for again where the rejection is "refined" only
        """
        self._problem_of, self._measured, self._is_loop = problem_of, measured, is_loop
        self._config, self.unexplained = config, unexplained
        self._rejection: OutlierRejection = rejection

    def solve(self, explanation: Explanation, poses: Matrix, initialize: Initialization) -> Explained:
        """The minimum, from these poses and this explanation."""
        best = self._solved(explanation, poses, initialize)
        for _ in range(_MAX_STEPS):
            better = next(self._better(best), None)
            if better is None:
                break
            best = better
        return best

    def _better(self, best: Explained) -> Iterator[Explained]:
        """Explanations under which the cost is lower, those that promise most first."""
        minimum, problem = best.solved.minimum, best.problem
        if minimum.price == 0.0 or len(problem.sightings):
            return
        for explanation in self._candidates(best):
            trial = self._solved(explanation, best.solved.poses, "given")
            if self._cost(trial, minimum.price) < self._cost(best, minimum.price) - _SETTLED * minimum.price:
                yield trial

    def _candidates(self, best: Explained) -> list[Explanation]:
        problem, now, poses, price = best.problem, best.explanation, best.solved.poses, best.solved.minimum.price
        kept = best.solved.minimum.weights > REJECTED_WEIGHT
        count = len(apart(problem.edges, np.flatnonzero(self._is_loop & ~kept)))
        if count < _FEWEST:
            return []
        found: list[tuple[float, Explanation]] = []
        if now.drift.any() or (self._is_loop & ~kept).sum() > _WORTH:
            step = drift_step(problem, poses, self._is_loop, kept, now.drift, price)
            gain = step.gain - (0.0 if now.drift.any() else _WORTH * price)
            found.append((gain, replace(now, drift=now.drift + step.change)))
        if self._rejection == "refined" or count > self.unexplained:
            self.unexplained = count
            gain, slips = next_slip(problem, self._measured, poses, self._is_loop, kept, now.slips, price)
            found.append((gain, replace(now, slips=slips)))
        found.sort(key=lambda each: -each[0])
        return [explanation for gain, explanation in found if gain > _SETTLED * price]

    def _solved(self, explanation: Explanation, poses: Matrix, initialize: Initialization) -> Explained:
        problem = self._problem_of(explanation)
        solved = solve(problem, poses, self._is_loop, self._config, initialize, self._rejection)
        return Explained(problem, solved, explanation)

    def _cost(self, explained: Explained, price: float) -> float:
        """Cost of a minimum at this price of a loop edge, and of its explanation."""
        minimum, explanation = explained.solved.minimum, explained.explanation
        kept = minimum.weights > REJECTED_WEIGHT
        chi2 = float(minimum.estimate.chi2[kept].sum())
        information = explained.problem.information
        own = explanation.cost(self._measured, information, self._is_loop, price)
        return chi2 + price * int((self._is_loop & ~kept).sum()) + own
