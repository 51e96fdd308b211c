"""Robust minimization: from a convex loss to the loss itself, then verdicts that the other edges bear out."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanchain.data import REJECTED_WEIGHT, Matrix
from scanchain.graph.robust.losses import GRADUATED, RobustLoss, rejection_limit
from scanchain.graph.robust.verdicts import Verdicts, contradictions, fair_price
from scanchain.graph.solvers.estimate import Estimate, Minimum
from scanchain.graph.solvers.optimizer import Minimizer
from scanchain.graph.soundness import is_connected

Judgment = Literal["graduated", "mended"]

_WASTE = 0.1  # share of edges without weight that is worth a new analysis
_MOST_ROUNDS = 50  # of mending verdicts
_FEWER, _FEWEST = 0.3, 1e-3  # after changes that do not help, of those that promise the most


def minimize(
    minimizer: Minimizer,
    poses: Matrix,
    loss: RobustLoss,
    max_iterations: int,
    tolerance: float,
    judgment: Judgment,
) -> Minimum:
    """Minimize from these poses; a kernel that is not convex is graduated first (Yang et al. 2020).

    judgment : of truncated edges: as the graduation leaves them, or mended by what the other edges bear out
    """
    now, used = minimizer.evaluate(poses, loss), 0
    if loss.kernel in GRADUATED and len(minimizer.loops):
        now, loss, used = _graduate(minimizer, now, loss)
    if judgment == "mended" and loss.kernel == "truncated" and len(minimizer.loops):
        minimum = _judge(minimizer, now, loss, max_iterations, tolerance)
    else:
        minimum = minimizer.descend(now, loss, max_iterations, tolerance)
        if loss.kernel not in ("none", "truncated"):
            minimum = _settle_without_outliers(minimizer, minimum, loss, max_iterations, tolerance)
    return replace(minimum, iterations=used + minimum.iterations)


def _graduate(minimizer: Minimizer, now: Estimate, loss: RobustLoss) -> tuple[Estimate, RobustLoss, int]:
    """Follow the minimum from the convex loss to the loss itself, one step for each level."""
    used, focus = 0, _Focus(minimizer)
    loss = loss.started(now.chi2[minimizer.loops])
    while not loss.settled(now.chi2[minimizer.loops]):
        chosen = focus.on(minimizer.weights(now.chi2, loss))
        minimum = chosen.descend(chosen.evaluate(now.poses, loss), loss, 1, 0.0)
        now, used = minimizer.evaluate(minimum.estimate.poses, loss), used + minimum.iterations
        loss = loss.tightened()
    return minimizer.reweighed(now, loss), loss, used


def _settle_without_outliers(
    minimizer: Minimizer, minimum: Minimum, loss: RobustLoss, max_iterations: int, tolerance: float
) -> Minimum:
    """The minimum without the edges that this one shows to be false, whose weight becomes 0.

    A loss that does not cut edges off leaves them some weight. They keep it where poses would be loose without.
    """
    problem, limit = minimizer.problem, rejection_limit(loss.scale, minimizer.problem.freedom)
    rejected = minimizer.is_loop & ((minimum.estimate.chi2 > limit) | (minimum.weights < REJECTED_WEIGHT))
    if not rejected.any() or not is_connected(problem.edges[~rejected], problem.variable < 0):
        return minimum
    rest = minimizer.restricted(~rejected)
    settled = rest.descend(rest.evaluate(minimum.estimate.poses, loss), loss, max_iterations, tolerance)
    weights = np.zeros(len(rejected))
    weights[~rejected] = settled.weights
    return replace(
        settled,
        estimate=minimizer.evaluate(settled.estimate.poses, loss),
        weights=weights,
        iterations=minimum.iterations + settled.iterations,
    )


class _Focus:
    """Leaves out edges of weight zero, which fill in the factor for nothing: soon most of the wrong ones."""

    def __init__(self, minimizer: Minimizer) -> None:
        self._whole = self._chosen = minimizer
        self._kept = np.ones(len(minimizer.is_loop), np.bool_)
        problem = minimizer.problem
        self._is_free = is_connected(problem.edges[~minimizer.is_loop], problem.variable < 0)

    def on(self, weights: NDArray[np.float64]) -> Minimizer:
        """A minimizer of the edges with weight, (E,), and of hardly any other."""
        wanted = weights > 0.0
        wasted = 1.0 - wanted.sum() / self._kept.sum()
        if self._is_free and ((wanted & ~self._kept).any() or wasted > _WASTE):
            self._kept, self._chosen = wanted, self._whole.restricted(wanted)
        return self._chosen


def _judge(
    minimizer: Minimizer, now: Estimate, loss: RobustLoss, max_iterations: int, tolerance: float
) -> Minimum:
    """The minimum with the verdicts of now, and then with those that the other edges bear out."""
    kept, nominal = loss.weight(now.chi2[minimizer.loops]) > 0.5, loss.scale**2
    minimum = _settle(minimizer, now, Verdicts(kept, nominal), max_iterations, tolerance)
    problem = minimizer.problem
    if not is_connected(problem.edges[minimum.weights > 0.5], problem.variable < 0):
        return minimum
    against = _against(minimizer, minimum, nominal)
    price = fair_price(against[kept], nominal, problem.freedom)
    minimum = replace(minimum, estimate=minimizer.reweighed(minimum.estimate, Verdicts(kept, price)))
    share = 1.0
    for _ in range(_MOST_ROUNDS):
        gain = np.where(kept, against - price, price - against)
        if share < _FEWEST or not (gain > 0.0).any():
            break
        verdicts = Verdicts(kept ^ (gain > (1.0 - share) * gain.max()), price)
        trial = _settle(minimizer, minimum.estimate, verdicts, max_iterations, tolerance)
        used = minimum.iterations + trial.iterations
        if not trial.estimate.cost < minimum.estimate.cost:
            minimum, share = replace(minimum, iterations=used), _FEWER * share
            continue
        minimum, kept, share = replace(trial, iterations=used), verdicts.kept, 1.0
        against = _against(minimizer, minimum, price)
    return minimum


def _settle(
    minimizer: Minimizer, start: Estimate, verdicts: Verdicts, max_iterations: int, tolerance: float
) -> Minimum:
    """The minimum with these verdicts."""
    weights = minimizer.weights(start.chi2, verdicts)
    chosen = _Focus(minimizer).on(weights)
    kept = verdicts.kept
    inner = Verdicts(kept if chosen is minimizer else kept[kept], verdicts.price)
    minimum = chosen.descend(chosen.evaluate(start.poses, inner), inner, max_iterations, tolerance)
    return replace(minimum, estimate=minimizer.evaluate(minimum.estimate.poses, verdicts), weights=weights)


def _against(minimizer: Minimizer, minimum: Minimum, price: float) -> NDArray[np.float64]:
    """What every loop edge costs the others, (L,)."""
    kept = minimum.weights > 0.5
    return contradictions(minimizer.problem, minimum.estimate.poses, kept, price)[minimizer.loops]
