"""Update of a robust minimum to which edges were added: from the poses and inliers at hand, without graduation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.edge_checks import is_connected
from scanchain.graph.robust.consistency import Consistency
from scanchain.graph.robust.graduation import Focus, settle
from scanchain.graph.robust.groups import agreeing_groups
from scanchain.graph.robust.inliers import InlierSet
from scanchain.graph.robust.losses import RobustLoss
from scanchain.graph.solvers.minimizer import Evaluation, Limits, Minimizer, Minimum

# a few steps with one set of edges, until the poses have settled roughly; the next update goes on
LIMITS = Limits(max_iterations=3, tolerance=1e-3)


@dataclass(frozen=True, slots=True)
class Since:
    """Number of edges at the last graduation, which judged all of them, and at the last update."""

    judged: int
    updated: int


def update(minimizer: Minimizer, poses: Matrix, loss: RobustLoss, since: Since) -> Minimum:
    """The minimum of the truncated loss near these poses.

    The graph predicts a revisit the less surely, the longer the path since the last: an edge with a large residual
    may agree with it all the same. New ones and groups of them that do are taken in where the cost falls.
    """
    minimum = _descend(minimizer, minimizer.evaluate(poses, loss), loss)
    left_out = minimizer.is_loop & (minimum.weights < 0.5)
    problem = minimizer.problem
    if not left_out[since.updated :].any() or not is_connected(problem.edges[~left_out], problem.variable < 0):
        return minimum
    promising = _promising(minimizer, minimum, loss.scale**2, since)
    if not promising:
        return minimum
    kept = ~left_out
    kept[np.concatenate(promising)] = True
    inliers = InlierSet(kept[minimizer.loops], loss.scale**2)
    trial = settle(minimizer, minimum.estimate, inliers)
    used = minimum.iterations + trial.iterations
    trial = _descend(minimizer, minimizer.reweighed(trial.estimate, loss), loss)
    best = trial if trial.estimate.cost < minimum.estimate.cost else minimum
    return replace(best, iterations=used + trial.iterations)


def _descend(minimizer: Minimizer, now: Evaluation, loss: RobustLoss) -> Minimum:
    """The minimum near these poses."""
    chosen = Focus(minimizer).on(minimizer.weights(now.chi2, loss))
    minimum = chosen.descend(chosen.evaluate(now.poses, loss), loss)
    estimate = minimizer.evaluate(minimum.estimate.poses, loss)
    return replace(minimum, estimate=estimate, weights=minimizer.weights(estimate.chi2, loss))


def _promising(minimizer: Minimizer, minimum: Minimum, limit: float, since: Since) -> list[NDArray[np.int64]]:
    """New edges left out with which the cost falls to first order, alone or as groups that agree."""
    problem, poses, kept = minimizer.problem, minimum.estimate.poses, minimum.weights > 0.5
    left_out = minimizer.is_loop & ~kept
    left_out[: since.judged] = False
    groups = agreeing_groups(problem, poses, minimizer.is_loop, left_out, limit)
    for group in groups:
        left_out[group] = False
    consistency = Consistency(problem, poses, kept)
    return [
        group
        for group in (*groups, *np.flatnonzero(left_out)[:, None])
        if group.max() >= since.updated and consistency.of_group(group) < limit * len(group)
    ]
