"""Optimization of a pose graph by graduated non-convexity that judges all robust edges or new ones; its result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scanchain.config import GraphConfig
from scanchain.data import REJECTED_WEIGHT, GraphState, Integers, Mask, Matrix, Vector, brief, fit_text
from scanchain.errors import counted
from scanchain.graph.consistency import Consistency, agreeing_groups
from scanchain.graph.edge_checks import has_loop, is_connected
from scanchain.graph.factors import ORIGIN
from scanchain.graph.initialize import Initialization, first_guess
from scanchain.graph.losses import InlierSet, RobustLoss, fair_price, limit_shares, rejection_limit, robust_loss
from scanchain.graph.minimizer import Evaluation, Limits, Loss, Minimizer, Minimum
from scanchain.graph.problem import GraphProblem

Rejection = Literal["update", "judge"]

LARGE = 2000  # number of poses from which a graph is not judged as a whole again and again
_WASTE = 0.1  # share of edges of zero weight above which a new symbolic analysis pays off
_FEWER, _FEWEST = 0.3, 1e-3  # factor on the share of changes tried after a round without success; least share
# a few steps per inlier set, until the poses have roughly settled; the next update continues
_LIMITS = Limits(max_iterations=3, tolerance=1e-3)


@dataclass(frozen=True, slots=True)
class Since:
    """Number of edges at the last GNC run, which judged all of them, and at the last update."""

    judged: int
    updated: int


@dataclass(frozen=True, slots=True)
class GraphChange:
    """A graph before and after a change, for plots and recordings, each with the edges then in force."""

    name: str
    before: GraphState
    after: GraphState


def fit(state: GraphState) -> str:
    """Fit of the edges in force as text."""
    count = int(state.is_rejected.sum())
    rejected = f"{counted(count, 'edge')} rejected" if count else ""
    return fit_text(state.chi2, state.degrees_of_freedom, rejected, has_loops=has_loops(state))


def has_loops(state: GraphState) -> bool:
    """True if an edge in force joins poses that the others already connect."""
    count, edges = len(state.poses), state.edges[~state.is_rejected]
    return has_loop(np.where(edges == ORIGIN, count, edges), count + 1)


@dataclass(frozen=True, slots=True)
class Optimization:
    """Result of ``PoseGraph.optimize``.

    state : the graph after the optimization
    chi2_before, chi2_after : Σ w eᵀΩe over the edges in force before and after, each at the poses of that time
    cost_after : what was minimized: Σ eᵀΩe of all edges, with the robust loss of loops and other robust edges
    iterations : linear solves
    converged, reason : whether and why the iteration stopped
    initialization : where the first guess came from
    time_s : wall time
    """

    __repr__ = brief
    state: GraphState
    chi2_before: float
    chi2_after: float
    cost_after: float
    iterations: int
    converged: bool
    reason: str
    initialization: Initialization | Literal["relaxation"]
    time_s: float

    @property
    def rejected(self) -> Mask:
        """Edges (E,), in the order of ``state.edges``, with a robust loss that contradict the rest.

        Such edges are loops, ``RobustPrior``, ``RobustPosition`` and custom factors with ``is_robust``.
        """
        return self.state.is_rejected


def solve(
    problem: GraphProblem,
    poses: Matrix,
    config: GraphConfig,
    initialize: Initialization,
    since: Since | None = None,
    *,
    groups: bool = True,
) -> Minimum:
    """Minimum from the chosen initialization; fixed poses stay the same bit for bit.

    since : for an update, under the truncated loss; groups : otherwise, as for ``minimize``
    Raises SingularMatrixError if the edges leave a pose free and the optimizer or initialization fails on that.
    """
    outlier_free = config.robust == "none" or not problem.is_robust.any()
    guess, source = first_guess(problem, poses, initialize, outlier_free=outlier_free)
    joined = np.unique(problem.edges) if len(problem.edges) else slice(None)
    shift = guess[joined, :-1, -1].mean(axis=0)  # left twists rotate about the origin: move it to the centroid
    guess[:, :-1, -1] -= shift
    loss = robust_loss(config.robust, config.robust_scale, problem.freedom)
    limits = _LIMITS if since is not None else Limits(config.max_iterations, config.tolerance)
    shares = limit_shares(config.robust_scale, problem.residuals, problem.freedom)
    minimizer = Minimizer(problem, config.optimizer, limits, shares)
    if since is not None:
        minimum = update(minimizer, guess, loss, since)
    else:
        minimum = minimize(minimizer, guess, loss, groups=groups)
    found = _orthonormal(minimum.estimate.poses)
    found[:, :-1, -1] += shift
    fixed = problem.variable < 0
    found[fixed] = poses[fixed]
    return replace(minimum, estimate=replace(minimum.estimate, poses=found), initialization=source)


def _orthonormal(poses: Matrix) -> Matrix:
    """Poses with their rotations orthonormalized by one Newton step, R (3 I − RᵀR) / 2."""
    result, d = poses.copy(), poses.shape[-1] - 1
    R = poses[:, :d, :d]
    result[:, :d, :d] = R @ (1.5 * np.eye(d) - 0.5 * np.swapaxes(R, 1, 2) @ R)
    return result


def minimize(minimizer: Minimizer, poses: Matrix, loss: RobustLoss, *, groups: bool) -> Minimum:
    """Minimum from these poses; a non-convex kernel is graduated first (Yang et al. 2020).

    Under the truncated loss each edge is judged by its consistency with the others, with ``groups`` also each
    group of agreeing edges.
    """
    now, used = minimizer.evaluate(poses, loss), 0
    if len(minimizer.robust):
        now, loss, used = _graduate(minimizer, now, loss)
    if loss.kernel == "truncated" and len(minimizer.robust):
        minimum = _refine(minimizer, now, loss, groups=groups)
    else:
        minimum = minimizer.descend(now, loss)
        if loss.kernel != "none":
            minimum = _settle_without_outliers(minimizer, minimum, loss)
    return replace(minimum, iterations=used + minimum.iterations)


def _graduate(minimizer: Minimizer, now: Evaluation, loss: RobustLoss) -> tuple[Evaluation, RobustLoss, int]:
    """Track the minimum from the convex loss to the loss itself, with one step for each loss in between.

    A loss whose control tends to infinity ends its schedule once all weights are 0 or 1.
    """
    used, focus, final = 0, Focus(minimizer), loss
    for loss in minimizer.graduated(now.chi2, final):
        weights = minimizer.weights(now.chi2, loss)
        is_crisp = np.isinf(final.control) and np.all(np.minimum(weights, 1.0 - weights) < REJECTED_WEIGHT)
        if loss == final or is_crisp:
            break
        minimum = focus.descend(now, loss, Limits(1, 0.0))
        now, used = minimum.estimate, used + minimum.iterations
    return minimizer.reweighted(now, loss), loss, used


def _settle_without_outliers(minimizer: Minimizer, minimum: Minimum, loss: RobustLoss) -> Minimum:
    """The minimum without the edges that this one shows to be outliers, whose weight becomes 0.

    A loss that does not truncate leaves outliers some weight. They keep it if poses would be disconnected without
    them.
    """
    problem, limit = minimizer.problem, rejection_limit(loss.scale, minimizer.problem.freedom) * minimizer.shares
    rejected = problem.is_robust & ((minimum.estimate.chi2 > limit) | (minimum.weights < REJECTED_WEIGHT))
    if not rejected.any() or not is_connected(problem.edges[~rejected], problem.variable < 0):
        return minimum
    rest = minimizer.restricted(~rejected)
    settled = rest.descend(rest.evaluate(minimum.estimate.poses, loss), loss)
    weights = np.zeros(len(rejected))
    weights[~rejected] = settled.weights
    return replace(
        settled,
        estimate=minimizer.evaluate(settled.estimate.poses, loss),
        weights=weights,
        iterations=minimum.iterations + settled.iterations,
    )


class Focus:
    """Descent without the edges of zero weight, soon most of the outliers, which would only cause fill-in."""

    def __init__(self, minimizer: Minimizer) -> None:
        self._whole = self._chosen = minimizer
        problem = minimizer.problem
        self._kept = np.ones(len(problem.edges), np.bool_)
        self._is_free = is_connected(problem.edges[~problem.is_robust], problem.variable < 0)

    def descend(self, start: Evaluation, loss: Loss, limits: Limits | None = None) -> Minimum:
        """The minimum near these poses, by the edges that have weight there and few others."""
        whole = self._whole
        wanted = whole.weights(start.chi2, loss) > 0.0
        wasted = 1.0 - wanted.sum() / self._kept.sum()
        if self._is_free and ((wanted & ~self._kept).any() or wasted > _WASTE):
            self._kept, self._chosen = wanted, whole.restricted(wanted)
        inner = loss
        if isinstance(loss, InlierSet):
            inner = InlierSet(loss.kept[self._kept[whole.robust]], loss.price)
        minimum = self._chosen.descend(self._chosen.evaluate(start.poses, inner), inner, limits)
        estimate = whole.evaluate(minimum.estimate.poses, loss)
        return replace(minimum, estimate=estimate, weights=whole.weights(estimate.chi2, loss))


def _refine(minimizer: Minimizer, now: Evaluation, loss: RobustLoss, *, groups: bool) -> Minimum:
    """The minimum with the present inliers, then with those that the other edges do not contradict."""
    kept, nominal = minimizer.weights(now.chi2, loss)[minimizer.robust] > 0.5, loss.scale**2
    minimum = Focus(minimizer).descend(now, InlierSet(kept, nominal))
    problem = minimizer.problem
    if not is_connected(problem.edges[minimum.weights > 0.5], problem.variable < 0):
        return minimum
    against = _against(minimizer, minimum, nominal)
    price = fair_price(against[kept], nominal, problem.residuals[minimizer.robust][kept])
    minimum = replace(minimum, estimate=minimizer.reweighted(minimum.estimate, InlierSet(kept, price)))
    minimum = _refine_edges(minimizer, minimum, against, price)
    if groups:
        minimum = _refine_groups(minimizer, minimum, price, nominal)
    return replace(minimum, price=price)


def _refine_edges(minimizer: Minimizer, minimum: Minimum, against: Vector, price: float) -> Minimum:
    """The minimum after rounds that accept or reject single edges, as long as the cost falls.

    against : (L,) as of ``_against``
    """
    kept, share = minimum.weights[minimizer.robust] > 0.5, 1.0
    prices = price * minimizer.shares[minimizer.robust]
    for _ in range(50):
        gain = np.where(kept, against - prices, prices - against)
        if share < _FEWEST or not (gain > 0.0).any():
            break
        inliers = InlierSet(kept ^ (gain > (1.0 - share) * gain.max()), price)
        trial = Focus(minimizer).descend(minimum.estimate, inliers)
        used = minimum.iterations + trial.iterations
        if not trial.estimate.cost < minimum.estimate.cost:
            minimum, share = replace(minimum, iterations=used), _FEWER * share
            continue
        minimum, kept, share = replace(trial, iterations=used), inliers.kept, 1.0
        against = _against(minimizer, minimum, price)
    return minimum


def _refine_groups(minimizer: Minimizer, minimum: Minimum, price: float, limit: float) -> Minimum:
    """The minimum after accepting or rejecting groups of agreeing edges, each followed by changes of single edges.

    Wrong edges that agree shield each other: if one is removed, the others still predict it. The same holds for
    the correct edges that they displace.
    """
    tried: set[tuple[int, ...]] = set()
    failed = 0
    while failed < 4:  # in a row
        group = _next_group(minimizer, minimum, price, limit, tried)
        if not len(group):
            break
        tried.add(tuple(group.tolist()))
        kept = minimum.weights > 0.5
        kept[group] ^= True
        inliers = InlierSet(kept[minimizer.robust], price)
        trial = Focus(minimizer).descend(minimum.estimate, inliers)
        against = _against(minimizer, trial, price)
        trial = _refine_edges(minimizer, trial, against, price)
        used = minimum.iterations + trial.iterations
        is_better = trial.estimate.cost < minimum.estimate.cost
        failed = 0 if is_better else failed + 1
        minimum = replace(trial if is_better else minimum, iterations=used)
    return minimum


def _next_group(
    minimizer: Minimizer, minimum: Minimum, price: float, limit: float, tried: set[tuple[int, ...]]
) -> Integers:
    """The group whose change promises the largest decrease of the cost; empty if no group of edges is rejected."""
    problem, poses = minimizer.problem, minimum.estimate.poses
    kept = minimum.weights > 0.5
    best, most = np.empty(0, np.int64), 0.0
    out = agreeing_groups(problem, poses, ~kept, limit)
    if not out:
        return best
    consistency = Consistency(problem, poses, kept)
    against = consistency.of_each(price)
    for group in (*out, *agreeing_groups(problem, poses, kept, limit)):
        is_kept, worth, rest = bool(kept[group[0]]), price * minimizer.shares[group].sum(), kept.copy()
        rest[group] = False
        if tuple(group.tolist()) in tried or (not is_kept and against[group].max() > worth):
            continue
        if is_kept and not is_connected(problem.edges[rest], problem.variable < 0):
            continue
        rise = worth - consistency.of_group(group)
        gain = -rise if is_kept else rise
        if gain > most:
            best, most = group, gain
    return best


def _against(minimizer: Minimizer, minimum: Minimum, price: float) -> Vector:
    """Distance of every robust edge from all other edges, (L,), as of ``Consistency``."""
    kept = minimum.weights > 0.5
    return Consistency(minimizer.problem, minimum.estimate.poses, kept).of_each(price)[minimizer.robust]


def update(minimizer: Minimizer, poses: Matrix, loss: RobustLoss, since: Since) -> Minimum:
    """The minimum of the truncated loss near these poses.

    The longer the path since the last revisit, the less certain is the graph's prediction of the next one: an edge
    with a large residual may be consistent with it. New edges and groups that are consistent are accepted if the
    cost falls.
    """
    minimum = Focus(minimizer).descend(minimizer.evaluate(poses, loss), loss)
    problem = minimizer.problem
    left_out = problem.is_robust & (minimum.weights < 0.5)
    if not left_out[since.updated :].any() or not is_connected(problem.edges[~left_out], problem.variable < 0):
        return minimum
    promising = _promising(minimizer, minimum, loss.scale**2, since)
    if not promising:
        return minimum
    kept = ~left_out
    kept[np.concatenate(promising)] = True
    inliers = InlierSet(kept[minimizer.robust], loss.scale**2)
    trial = Focus(minimizer).descend(minimum.estimate, inliers)
    used = minimum.iterations + trial.iterations
    trial = Focus(minimizer).descend(trial.estimate, loss)
    best = trial if trial.estimate.cost < minimum.estimate.cost else minimum
    return replace(best, iterations=used + trial.iterations)


def _promising(minimizer: Minimizer, minimum: Minimum, limit: float, since: Since) -> list[Integers]:
    """Rejected new edges that lower the cost to first order, alone or as groups that agree."""
    problem, poses, kept = minimizer.problem, minimum.estimate.poses, minimum.weights > 0.5
    left_out = problem.is_robust & ~kept
    left_out[: since.judged] = False
    groups = agreeing_groups(problem, poses, left_out, limit)
    for group in groups:
        left_out[group] = False
    consistency = Consistency(problem, poses, kept)
    return [
        group
        for group in (*groups, *np.flatnonzero(left_out)[:, None])
        if group.max() >= since.updated and consistency.of_group(group) < limit * minimizer.shares[group].sum()
    ]
