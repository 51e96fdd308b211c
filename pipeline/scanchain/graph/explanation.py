"""Errors of odometry that would explain closures left out: the search for the best, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain.config import GraphConfig
from scanchain.data import REJECTED_WEIGHT, Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.consistency import apart
from scanchain.graph.initialize import Initialization
from scanchain.graph.left_out import LeftOut
from scanchain.graph.losses import rejection_limit
from scanchain.graph.odometry_errors import (
    FEWEST,
    Loosened,
    Slip,
    corrected,
    cost_of,
    drift_step,
    loosened,
    next_loosened,
    penalty,
    rescaled,
    size,
)
from scanchain.graph.optimization import Solved, solve

_LARGE = 2000  # edges of odometry from which on groups of loop edges are judged once, under the last explanation
_FEWEST = 2  # least number of loop edges left out, none near another, that are to be explained
_MAX_STEPS = 20  # largest number of changes of an explanation in one optimization
_SETTLED = 0.1  # share of the price of a loop edge below which a change gains nothing


@dataclass(frozen=True, slots=True)
class Explanation:
    """Errors of odometry.

    Attributes
    ----------
    drift : (2,) or (4,) share of its way by which odometry is too short, and radians a meter it turns too little
    loosened : slips and jumps, stretches of odometry that are off by more than their edges say
    """

    drift: NDArray[np.float64]
    loosened: tuple[Loosened, ...] = ()

    @classmethod
    def none(cls, freedom: int) -> Explanation:
        """Odometry as it is."""
        return cls(np.zeros(size(freedom)))

    def applied(
        self, edges: NDArray[np.int64], measured: Matrix, information: Matrix, is_loop: NDArray[np.bool_]
    ) -> tuple[Matrix, Matrix]:
        """Measurements (E, d+1, d+1) without drift, and their information (E, k, k), slips and jumps loosened."""
        if not self.drift.any() and not self.loosened:
            return measured, information
        odometry = odometry_of(edges, is_loop)
        of_odometry, Z = information[odometry], measured[odometry]
        for stretch in self.loosened:
            twists = stretch.spread(Z, information[odometry])
            of_odometry[stretch.edges] = loosened(of_odometry[stretch.edges], twists)
        measured, information = measured.copy(), information.copy()
        measured[odometry] = corrected(Z, self.drift, _sign(edges[odometry]))
        information[odometry] = rescaled(of_odometry, self.drift)
        return measured, information

    def with_later(self, other: Explanation, before: int) -> Explanation:
        """The same with slips and jumps of another, of the edges of odometry that come after so many."""
        later = (replace(stretch, first=stretch.first + before) for stretch in other.loosened)
        return replace(self, loosened=(*self.loosened, *later))

    def cost(self, measured: Matrix, information: Matrix, price: float, nominal: float) -> float:
        """Cost of the explanation itself, where a loop edge left out costs this price; the arrays of odometry.

        nominal : price where the noise model is right
        """
        result = penalty(self.drift) + (FEWEST * price if self.drift.any() else 0.0)
        for stretch in self.loosened:
            B = stretch.spread(measured, information)
            claimed = (np.swapaxes(B, 1, 2) @ information[stretch.edges] @ B).sum(axis=0)
            result += float(cost_of(claimed, is_jump=stretch.is_jump, price=price, nominal=nominal))
        return result

    @property
    def jumps(self) -> tuple[int, ...]:
        """Edges of odometry, in the order of the poses, whose motion is wrong altogether."""
        return tuple(stretch.first for stretch in self.loosened if stretch.is_jump)


def odometry_of(edges: NDArray[np.int64], is_loop: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Edges of odometry (O,), in the order of the poses."""
    odometry = np.flatnonzero(~is_loop)
    return odometry[np.argsort(edges[odometry].min(axis=1), kind="stable")]


def _sign(edges: NDArray[np.int64]) -> NDArray[np.float64]:
    """1 of edges (O, 2) to a later pose, −1 of those to an earlier one."""
    return np.sign(edges[:, 1] - edges[:, 0]).astype(np.float64)


def corrections(
    explanation: Explanation,
    slips: tuple[Slip, ...],
    edges: NDArray[np.int64],
    names: NDArray[np.int64],
    noun: str,
) -> list[str]:
    """Corrections of odometry in words, a line each.

    edges : (O, 2) those of odometry, in the order of the poses
    names (K,), noun : numbers of the poses for the reader, and what they number
    """
    found = []
    if explanation.drift.any():
        scale, *turns = explanation.drift.tolist()
        turn = ", ".join(f"{1e3 * rad_per_m:+.1f}" for rad_per_m in turns)
        found.append(f"length {100.0 * scale:+.1f} %, turn {turn} mrad/m")
    stretches = [(f"a slip of {slip.size_m:+.1f} m", slip.first, slip.count) for slip in slips]
    for what, first, count in [*stretches, *(("a jump", jump, 1) for jump in explanation.jumps)]:
        poses = edges[first : first + count]
        found.append(f"{what} between {noun} {names[poses.min()]:,} and {names[poses.max()]:,}")
    return [f"corrected by loop closures: {what}" for what in found]


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
        information: Matrix,
        is_loop: NDArray[np.bool_],
        config: GraphConfig,
        *,
        jumps: bool = False,
    ) -> None:
        """problem_of : the problem under an explanation; measured, information : of all edges, as added.

        jumps : whether to look for jumps rather than for a drift, which is one of all odometry
        """
        self._problem_of, self._is_loop, self._config = problem_of, is_loop, config
        self._measured, self._information = measured, information
        self._is_large = len(is_loop) - int(is_loop.sum()) >= _LARGE
        self._jumps = jumps
        self._nominal = rejection_limit(config.robust_scale, measured.shape[-1] * (measured.shape[-1] - 1) // 2)

    def solve(self, explanation: Explanation, poses: Matrix, initialize: Initialization) -> Explained:
        """The minimum, from these poses and this explanation."""
        best = first = self._solved(explanation, poses, initialize, groups=True)
        explains = not len(best.problem.sightings)
        for _ in range(_MAX_STEPS):
            better = next(self._better(best), None) if explains and best.solved.minimum.price else None
            if better is None:
                break
            best = better
        if best is not first and self._is_large:
            best = self._solved(best.explanation, best.solved.poses, "given", groups=True)
        return best

    def _better(self, best: Explained) -> Iterator[Explained]:
        """Explanations under which the cost is lower, those that promise most first."""
        price = best.solved.minimum.price
        for explanation, poses in self._candidates(best):
            trial = self._solved(explanation, poses, "given", groups=not self._is_large)
            if self._cost(trial, price) < self._cost(best, price) - _SETTLED * price:
                yield trial

    def _candidates(self, best: Explained) -> list[tuple[Explanation, Matrix]]:
        """Explanations, and poses to begin with."""
        problem, now, price = best.problem, best.explanation, best.solved.minimum.price
        poses = best.solved.poses
        kept = best.solved.minimum.weights > REJECTED_WEIGHT
        rejected = np.flatnonzero(~kept)
        if len(rejected) < _FEWEST or len(apart(problem.edges, rejected)) < _FEWEST:
            return []
        odometry = odometry_of(problem.edges, self._is_loop)
        left_out = LeftOut.at(problem, poses, odometry, kept)
        found: list[tuple[float, Explanation, Matrix]] = []
        if not self._jumps and (now.drift.any() or len(rejected) > FEWEST):
            gain, change = drift_step(left_out, _sign(problem.edges[odometry]), now.drift, price)
            gain -= 0.0 if now.drift.any() else FEWEST * price
            found.append((gain, replace(now, drift=now.drift + change), poses))
        for is_jump in (False, True)[: 1 + self._jumps]:
            next_one = next_loosened(
                left_out,
                self._measured[odometry],
                now.loosened,
                is_jump=is_jump,
                price=price,
                nominal=self._nominal,
            )
            if next_one is not None:
                gain, stretch, twists = next_one
                start = left_out.moved(poses, twists, stretch.edges)
                found.append((gain, replace(now, loosened=(*now.loosened, stretch)), start))
        found.sort(key=lambda each: -each[0])
        return [(explanation, start) for gain, explanation, start in found if gain > _SETTLED * price]

    def _solved(
        self, explanation: Explanation, poses: Matrix, initialize: Initialization, *, groups: bool
    ) -> Explained:
        problem = self._problem_of(explanation)
        solved = solve(problem, poses, self._is_loop, self._config, initialize, groups=groups)
        return Explained(problem, solved, explanation)

    def _cost(self, explained: Explained, price: float) -> float:
        """Cost of a minimum at this price of a loop edge, and of its explanation."""
        minimum, odometry = explained.solved.minimum, odometry_of(explained.problem.edges, self._is_loop)
        kept = minimum.weights > REJECTED_WEIGHT
        own = explained.explanation.cost(
            self._measured[odometry], self._information[odometry], price, self._nominal
        )
        return float(minimum.estimate.chi2[kept].sum()) + price * int((~kept).sum()) + own
