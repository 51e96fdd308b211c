"""Robust minimisation: from a convex loss to the loss itself, then verdicts that the other edges bear out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.data import Matrix
from pipeline.graph.estimate import Estimate, Minimum
from pipeline.graph.optimiser import Minimiser
from pipeline.graph.robust import GRADUATED, RobustLoss
from pipeline.graph.verdicts import Verdicts, contradictions, fair_price

_MOST_ROUNDS = 50  # of mending verdicts
_FEWER, _FEWEST = 0.3, 1e-3  # after changes that do not help, of those that promise the most


def minimise(
    minimiser: Minimiser, poses: Matrix, loss: RobustLoss, max_iterations: int, tolerance: float
) -> Minimum:
    """Minimise from these poses; a kernel that is not convex is graduated first (Yang et al. 2020)."""
    now, used = minimiser.evaluate(poses, loss), 0
    if loss.kernel in GRADUATED and len(minimiser.loops):
        now, loss, used = _graduate(minimiser, now, loss)
    minimum = minimiser.descend(now, loss, max_iterations, tolerance)
    minimum = replace(minimum, iterations=used + minimum.iterations)
    if loss.kernel == "truncated" and len(minimiser.loops):
        return _mend(minimiser, minimum, loss.scale**2, max_iterations, tolerance)
    return minimum


def _graduate(minimiser: Minimiser, now: Estimate, loss: RobustLoss) -> tuple[Estimate, RobustLoss, int]:
    """Follow the minimum from the convex loss to the loss itself, one step for each level."""
    used = 0
    loss = loss.started(now.chi2[minimiser.loops])
    while not loss.settled(now.chi2[minimiser.loops]):
        minimum = minimiser.descend(minimiser.reweighed(now, loss), loss, 1, 0.0)
        now, used = minimum.estimate, used + minimum.iterations
        loss = loss.tightened()
    return minimiser.reweighed(now, loss), loss, used


def _mend(
    minimiser: Minimiser, minimum: Minimum, nominal: float, max_iterations: int, tolerance: float
) -> Minimum:
    """Change the verdicts that the other edges contradict, many at a time, as long as the truncated cost falls."""
    against = _against(minimiser, minimum)
    kept = minimum.weights[minimiser.loops] > 0.5
    price = fair_price(against[kept], nominal, minimiser.problem.freedom)
    minimum = replace(minimum, estimate=minimiser.reweighed(minimum.estimate, Verdicts(kept, price)))
    share = 1.0
    for _ in range(_MOST_ROUNDS):
        gain = np.where(kept, against - price, price - against)
        if share < _FEWEST or not (gain > 0.0).any():
            break
        verdicts = Verdicts(kept ^ (gain > (1.0 - share) * gain.max()), price)
        start = minimiser.reweighed(minimum.estimate, verdicts)
        trial = minimiser.descend(start, verdicts, max_iterations, tolerance)
        used = minimum.iterations + trial.iterations
        if not trial.estimate.cost < minimum.estimate.cost:
            minimum, share = replace(minimum, iterations=used), _FEWER * share
            continue
        minimum, kept, share = replace(trial, iterations=used), verdicts.kept, 1.0
        against = _against(minimiser, minimum)
    return minimum


def _against(minimiser: Minimiser, minimum: Minimum) -> np.ndarray:
    """What every loop edge costs the others, (L,)."""
    poses, weights = minimum.estimate.poses, minimum.weights
    return contradictions(minimiser.problem, poses, weights)[minimiser.loops]
