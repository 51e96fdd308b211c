"""Errors of odometry that explain loop edges which contradict it: a systematic drift, and slips of single edges."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from scanchain.config import GraphConfig
from scanchain.data import REJECTED_WEIGHT, Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.initialize import Initialization
from scanchain.graph.optimization import Solved, solve
from scanchain.graph.robust.drift import corrected, drift_step, penalty, size
from scanchain.graph.robust.graduation import OutlierRejection
from scanchain.graph.robust.slips import directions, next_slip, prices, relaxed

_WORTH = 3.0  # loop edges, none near another, that a systematic drift must bring in, less what it costs
_MAX_STEPS = 20  # largest number of changes of an explanation in one optimization
_SETTLED = 0.1  # share of the price of a loop edge below which a change gains nothing


@dataclass(frozen=True, slots=True)
class Explanation:
    """Errors of odometry.

    Attributes
    ----------
    drift : (2,) or (4,) share of its way by which odometry is too short, and radians a meter it turns too little
    slips : odometry edges that are off by more than they say
    """

    drift: NDArray[np.float64]
    slips: frozenset[int] = field(default=frozenset())

    @classmethod
    def none(cls, freedom: int) -> Explanation:
        """Odometry as it is."""
        return cls(np.zeros(size(freedom)))

    @property
    def is_empty(self) -> bool:
        """True where odometry stays as it is."""
        return not self.slips and not self.drift.any()

    def measurements(self, measured: Matrix, is_loop: NDArray[np.bool_]) -> Matrix:
        """Measurements (E, d+1, d+1) with the drift taken out of odometry."""
        if not self.drift.any():
            return measured
        result = measured.copy()
        result[~is_loop] = corrected(measured[~is_loop], self.drift)
        return result

    def information(self, claimed: Matrix, measured: Matrix) -> Matrix:
        """Information (E, k, k) with that of the slips lowered."""
        if not self.slips:
            return claimed
        result, slips = claimed.copy(), sorted(self.slips)
        result[slips] = relaxed(claimed[slips], directions(claimed[slips], measured[slips]))
        return result

    def price(self, claimed: Matrix, measured: Matrix, price: float) -> float:
        """Cost of the explanation, where a loop edge left out costs this price."""
        slips = sorted(self.slips)
        of_slips = float(prices(claimed[slips], directions(claimed[slips], measured[slips])).sum())
        return of_slips + penalty(self.drift) + (_WORTH * price if self.drift.any() else 0.0)


@dataclass(frozen=True, slots=True)
class Explained:
    """A minimum under an explanation."""

    solved: Solved
    explanation: Explanation


class Explainer:
    """Optimizes a graph with explanations that lower the cost by more than they cost themselves."""

    def __init__(
        self,
        problem_of: Callable[[Explanation], BetweenProblem],
        claimed: Matrix,
        is_loop: NDArray[np.bool_],
        config: GraphConfig,
        rejection: OutlierRejection,
    ) -> None:
        """problem_of : the problem under an explanation; claimed : (E, k, k) information of the edges."""
        self._problem_of, self._claimed, self._is_loop = problem_of, claimed, is_loop
        self._config, self._rejection = config, rejection

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
        minimum = best.solved.minimum
        problem = self._problem_of(best.explanation)
        if minimum.price == 0.0 or len(problem.sightings):
            return
        for explanation in self._candidates(best, problem):
            trial = self._solved(explanation, best.solved.poses, "given")
            if self._cost(trial, minimum.price) < self._cost(best, minimum.price) - _SETTLED * minimum.price:
                yield trial

    def _candidates(self, best: Explained, problem: BetweenProblem) -> list[Explanation]:
        now, poses, price = best.explanation, best.solved.poses, best.solved.minimum.price
        kept = best.solved.minimum.weights > REJECTED_WEIGHT
        found: list[tuple[float, Explanation]] = []
        if now.drift.any() or (self._is_loop & ~kept).sum() > _WORTH:
            step = drift_step(problem, poses, self._is_loop, kept, now.drift, price)
            gain = step.gain - (0.0 if now.drift.any() else _WORTH * price)
            found.append((gain, replace(now, drift=now.drift + step.change)))
        slipped = np.zeros(len(kept), np.bool_)
        slipped[list(now.slips)] = True
        slip = next_slip(problem, poses, self._is_loop, kept, slipped, price)
        if slip.edge >= 0:
            found.append((slip.gain, replace(now, slips=now.slips | {slip.edge})))
        found.sort(key=lambda each: -each[0])
        return [explanation for gain, explanation in found if gain > _SETTLED * price]

    def _solved(self, explanation: Explanation, poses: Matrix, initialize: Initialization) -> Explained:
        problem = self._problem_of(explanation)
        solved = solve(problem, poses, self._is_loop, self._config, initialize, self._rejection)
        return Explained(solved, explanation)

    def _cost(self, explained: Explained, price: float) -> float:
        """Cost of a minimum at this price of a loop edge, and of its explanation."""
        minimum, explanation = explained.solved.minimum, explained.explanation
        kept = minimum.weights > REJECTED_WEIGHT
        chi2 = float(minimum.estimate.chi2[kept].sum())
        measured = self._problem_of(explanation).measurements
        return chi2 + price * int((self._is_loop & ~kept).sum()) + explanation.price(self._claimed, measured, price)
