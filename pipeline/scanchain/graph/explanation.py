"""Greedy search for odometry errors that explain rejected loop closures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.data import REJECTED_WEIGHT, Integers, Mask, Matrix, Vector
from scanchain.graph.consistency import FEWEST, apart
from scanchain.graph.covariance import difference_covariances, edge_covariances, inverse_blocks, responses
from scanchain.graph.initialize import Initialization
from scanchain.graph.losses import limit_shares, rejection_limit
from scanchain.graph.minimizer import Minimum
from scanchain.graph.odometry_errors import (
    Explanation,
    InflatedSegment,
    changed,
    cost_of,
    direction,
    error_twists,
    odometry_of,
    prior,
)
from scanchain.graph.optimization import LARGE, Since, solve
from scanchain.graph.problem import GraphProblem

_FEWEST = 2  # least number of rejected loop edges, none near another, for which an explanation is searched
_SETTLED = 0.1  # share of the price of a loop edge below which a change gains nothing
_MOST_REJECTED = 30  # largest number of rejected loop edges that are evaluated
_MOST_ENTRIES = 4_000_000  # largest number of entries of the covariances between these and odometry, 32 MB
_SLIP_LENGTHS = (4, 16, 64)  # numbers of edges of the segments that are tried
_MOST_SEGMENTS = 100  # largest number of segments that are evaluated without the estimates of the bound
_CURVATURE = 0.3  # standard deviation of the linearization error of a drift, as a share of the change by it
_ROUNDS = 3  # of the estimate of that error, and of least squares over the loop edges that an error explains


@dataclass(frozen=True, slots=True)
class Explained:
    """The minimum of the problem under an explanation."""

    problem: GraphProblem
    minimum: Minimum
    explanation: Explanation


@dataclass(frozen=True, slots=True)
class Explainer:
    """Optimizes a graph; accepts odometry errors (explanations) that save more cost than their own penalty.

    problem_of : the problem under an explanation
    measured, information : (E, ...) of all edges, as added
    jumps : whether to search for jumps instead of a drift, which is common to all odometry
    """

    problem_of: Callable[[Explanation], GraphProblem]
    measured: Matrix
    information: Matrix
    config: GraphConfig
    jumps: bool

    def solve(
        self, explanation: Explanation, poses: Matrix, initialize: Initialization, since: Since | None
    ) -> Explained:
        """The minimum, from these poses and this explanation.

        since : for an update, which under the truncated loss leaves the explanation as it is; else None
        """
        if since is not None and self.config.robust == "truncated":
            return self._solved(explanation, poses, initialize, since=since)
        best = first = self._solved(explanation, poses, initialize)
        explains = not best.problem.is_sighting.any()
        for _ in range(20):
            better = self._better(best) if explains and best.minimum.price else best
            if better is best:
                break
            best = better
        if best is not first and self._is_large(best):
            best = self._solved(best.explanation, best.minimum.estimate.poses, "given")
        return best

    def _better(self, best: Explained) -> Explained:
        """Minimum under the most promising explanation that lowers the cost; ``best`` itself if none does."""
        price, poses = best.minimum.price, best.minimum.estimate.poses
        for explanation in self._candidates(best):
            trial = self._solved(explanation, poses, "given", groups=not self._is_large(best))
            if self._cost(trial, price) < self._cost(best, price) - _SETTLED * price:
                return trial
        return best

    def _candidates(self, best: Explained) -> list[Explanation]:
        """Explanations that may lower the cost, the most promising first."""
        problem, now, price = best.problem, best.explanation, best.minimum.price
        kept = best.minimum.weights > REJECTED_WEIGHT
        rejected = np.flatnonzero(problem.is_loop & ~kept)
        if len(rejected) < _FEWEST or len(apart(problem.edges, rejected)) < _FEWEST:
            return []
        odometry = odometry_of(problem.edges, problem.is_odometry)
        loops = RejectedLoops(problem, best.minimum.estimate.poses, odometry, kept)
        found: list[tuple[float, Explanation]] = []
        if not self.jumps and (now.drift.any() or len(rejected) > FEWEST):
            gain, change = drift_step(loops, direction(problem.edges[odometry]), now.drift, price)
            gain -= 0.0 if now.drift.any() else FEWEST * price
            found.append((gain, replace(now, drift=now.drift + change)))
        for is_jump in (False, True)[: 1 + self.jumps]:
            measured, costs = self.measured[odometry], (price, self._nominal)
            gain, segment = next_segment(loops, measured, now.inflated, *costs, is_jump=is_jump)
            if segment is not None:
                found.append((gain, replace(now, inflated=(*now.inflated, segment))))
        found.sort(key=lambda each: -each[0])
        return [explanation for gain, explanation in found if gain > _SETTLED * price]

    def _solved(
        self,
        explanation: Explanation,
        poses: Matrix,
        initialize: Initialization,
        *,
        since: Since | None = None,
        groups: bool = True,
    ) -> Explained:
        problem = self.problem_of(explanation)
        minimum = solve(problem, poses, self.config, initialize, since, groups=groups)
        return Explained(problem, minimum, explanation)

    def _cost(self, explained: Explained, price: float) -> float:
        """Cost of a minimum at this price of a loop edge, and of its explanation."""
        minimum, problem = explained.minimum, explained.problem
        odometry = odometry_of(problem.edges, problem.is_odometry)
        kept = minimum.weights > REJECTED_WEIGHT
        rejected = limit_shares(self.config.robust_scale, problem.residuals[~kept], problem.freedom).sum()
        own = explained.explanation.cost(self.measured[odometry], self.information[odometry], price, self._nominal)
        return float(minimum.estimate.chi2[kept].sum() + price * rejected) + own

    @staticmethod
    def _is_large(explained: Explained) -> bool:
        return int(explained.problem.is_odometry.sum()) >= LARGE

    @property
    def _nominal(self) -> float:
        """Price of a rejected loop edge if the noise model is right."""
        d = self.measured.shape[-1] - 1
        return rejection_limit(self.config.robust_scale, d * (d + 1) // 2)


class RejectedLoops:
    """Loop edges that a minimum rejects, and the first-order change of their residuals by errors of odometry.

    Of edges near each other, which may share a mistake, only the first counts.

    problem, factored : all edges, and those kept with H factored at the poses
    edges : (L,) these loop edges; where they are too many, every ``stride``-th of them, weighted accordingly
    odometry : (O,) the edges of odometry in the order of the poses
    errors, jacobians : (E, k), (E, k, k) residuals e and ∂e/∂ξ_j of all edges
    covariances : (L, k, k) of their residuals, from their own noise and from the graph without them
    predicted : (O, k, k) covariances of odometry as predicted by the graph
    joint : (L, O, k, k) cross-covariances of the left twists of both, Cov(ξ_end − ξ_begin, ξ_j − ξ_i)
    """

    def __init__(self, problem: GraphProblem, poses: Matrix, odometry: Integers, kept: Mask) -> None:
        """Rejected loop edges of a minimum with the edges kept (E,)."""
        edges = apart(problem.edges, np.flatnonzero(problem.is_loop & ~kept))
        most = min(_MOST_REJECTED, _MOST_ENTRIES // (max(len(odometry), 1) * problem.freedom**2))
        self.stride = max(1, -(-len(edges) // max(most, 1)))
        self.problem, self.odometry, self.edges = problem, odometry, edges[:: self.stride]
        self.errors = problem.errors(poses)
        self.jacobians = problem.jacobians(poses, self.errors)
        self.factored = problem.factored(poses, self.errors, kept)
        of_odometry = edge_covariances(self.factored, inverse_blocks(self.factored))[np.cumsum(kept)[odometry] - 1]
        J = self.jacobians[odometry]
        self.predicted = J @ of_odometry @ np.swapaxes(J, 1, 2)
        begin, end = problem.edges[odometry].T
        self.covariances = np.linalg.pinv(problem.information[self.edges], hermitian=True)
        self.joint = np.empty((len(self.edges), len(odometry), *J.shape[1:]))
        for place, edge in enumerate(self.edges):
            of_edge = difference_covariances(self.factored, problem.edges[[edge]])[0, 0]
            self.covariances[place] += self.jacobians[edge] @ of_edge @ self.jacobians[edge].T
            moved = responses(self.factored, *problem.edges[edge])
            self.joint[place] = moved[end] - moved[begin]

    def weighted(self, sigma: Matrix | float = 0.0) -> tuple[Matrix, Matrix]:
        """Residuals (L, k) of these loop edges, and their information (L, k, k), multiplied by ``stride``.

        sigma : additional standard deviations (L, k)
        """
        k = self.errors.shape[1]
        noise = self.covariances + np.square(sigma)[..., None] * np.eye(k)
        information = np.asarray(self.stride * np.linalg.inv(noise), np.float64)
        return self.errors[self.edges], information

    def shifts(self, twists: Matrix, among: slice = slice(None)) -> Iterator[Matrix]:
        """Changes ∂e (n, k, p) of the residual of each of these loop edges by right twists (n, k, p) of edges."""
        problem, odometry = self.problem, self.odometry[among]
        pull = np.swapaxes(self.jacobians[odometry], 1, 2) @ (problem.information[odometry] @ twists)
        for edge, joint in zip(self.edges, self.joint[:, among], strict=True):
            yield self.jacobians[edge] @ (np.swapaxes(joint, 1, 2) @ pull)

    def quadratic(self, twists: Matrix, among: slice = slice(None)) -> tuple[Vector, Matrix]:
        """Slope b (p,) and curvature A (p, p) of the cost along right twists τ (n, k, p) of odometry edges.

        With g = Σ JᵀΩτ, twists τδ move the poses by H⁻¹gδ; the cost of the kept edges changes by δᵀAδ − 2 bᵀδ,
        where A = Σ τᵀΩτ − gᵀH⁻¹g and b = Σ τᵀΩe.
        """
        odometry = self.odometry[among]
        weighted = self.problem.information[odometry] @ twists
        g = self._pull(weighted, odometry)
        A = np.einsum("oap,oaq->pq", twists, weighted) - g.T @ self.factored.cholesky.solve(g)
        b = np.einsum("oap,oa->p", weighted, self.errors[odometry])
        return b, A

    def _pull(self, weighted: Matrix, edges: Integers) -> Matrix:
        """Σ JᵀΩτ of the poses, (scalars, p), of Ωτ (n, k, p) of some edges."""
        problem = self.problem
        forces = np.swapaxes(self.jacobians[edges], 1, 2) @ weighted
        whole = np.zeros((len(problem.variable), *forces.shape[1:]))
        begin, end = problem.edges[edges].T
        np.add.at(whole, end, forces)
        np.add.at(whole, begin, -forces)
        return self.factored.packing.packed(whole[problem.free])


def drift_step(loops: RejectedLoops, sign: Vector, drift: Vector, price: float) -> tuple[float, Vector]:
    """First-order decrease of the cost by the best change of the drift, and this change.

    Each round treats the error of the linearization, a share of the change found in the last round, as noise.
    """
    odometry = loops.odometry
    twists = lie.log(loops.problem.measurements[odometry])
    B = np.stack([changed(twists, unit, sign) - twists for unit in np.eye(len(drift))], axis=-1)  # ∂Z/∂drift
    d = twists.shape[1] - len(drift) + 1
    B[:, :d, 0] += loops.errors[odometry, :d]  # the noise grows with the scale
    slope, curvature = loops.quadratic(B)
    V, own = np.array([shift.sum(axis=0) for shift in loops.shifts(B)]), prior(len(drift))
    A, b, price = curvature + np.diag(own), slope - own * drift, loops.stride * price
    alone = np.asarray(np.linalg.solve(A, b), np.float64)
    fall, change = float(b @ alone) * drift.any(), alone * drift.any()
    for _ in range(_ROUNDS):
        moved = V @ change
        lengths = [np.linalg.norm(part, axis=1) for part in (moved[:, :d], moved[:, d:])]
        sigma = _CURVATURE * np.repeat(np.stack(lengths, axis=1), (d, moved.shape[1] - d), axis=1)
        found = _largest_fall(A, b, *loops.weighted(sigma), V, price)
        fall, change = max((fall, change), found, key=lambda each: each[0])
    return fall, change


def next_segment(
    loops: RejectedLoops,
    measured: Matrix,
    others: tuple[InflatedSegment, ...],
    price: float,
    nominal: float,
    *,
    is_jump: bool,
) -> tuple[float, InflatedSegment | None]:
    """First-order decrease of the cost by the best additional slip or jump, and this; None if none lowers it.

    measured : (O, d+1, d+1) measurements of odometry, in the order of ``loops.odometry``
    Odometry errors t of a segment, in standard deviations, change the cost of the kept edges and the prior of t by
    tᵀA t − 2 bᵀt. A rejected loop edge then costs min(price, (e + V t)ᵀC⁻¹(e + V t)) instead of its price. The
    candidates for t are the least-squares solutions for each of these edges.

    Segments of every length that overlap no others are tried, in steps of half their length. Since A takes a
    linear solve, the order is that of an upper bound of the decrease, and ends where that is below the best one
    found. In the bound, each loop edge has errors t of its own at 1/L of the change above, and A is estimated: if
    the ends of a chain are accurate, the information on a slip of all edges is that of the edges themselves, and
    that on a slip of one edge its share by redundancy; these shares add up to one.
    """
    tried = [
        InflatedSegment(first, length, is_jump)
        for length in ((1,) if is_jump else _SLIP_LENGTHS)
        for first in range(0, len(measured) - length + 1, max(length // 2, 1))
        if all(first >= other.edges.stop or other.first >= first + length for other in others)
    ]
    if not tried:
        return 0.0, None
    first, count = np.array([(segment.first, segment.count) for segment in tried]).T
    information = loops.problem.information[loops.odometry]
    B = error_twists(measured, information, is_jump=is_jump)
    pull = information @ B
    pull_t, unit = np.swapaxes(pull, 1, 2), np.eye(B.shape[2])
    own = np.swapaxes(B, 1, 2) @ pull
    claimed = _means(own, first, count) / count[:, None, None]
    learned = _means(own - pull_t @ loops.predicted @ pull, first, count)
    A = unit + (learned if is_jump else np.minimum(learned, claimed))
    b = _means(pull_t @ loops.errors[loops.odometry][..., None], first, count)[..., 0]
    costs = cost_of(claimed, is_jump=is_jump, price=price, nominal=nominal)
    e, M, price = *loops.weighted(), loops.stride * price
    alone = (b * np.linalg.solve(A, b[..., None])[..., 0]).sum(axis=1) / len(e)  # without explaining any of them
    bound = -costs
    for error, weight, shift in zip(e, M, loops.shifts(B), strict=True):
        V = _means(shift, first, count)
        g = b / len(e) - np.swapaxes(V, 1, 2) @ (weight @ error)
        H = A / len(e) + np.swapaxes(V, 1, 2) @ weight @ V
        fall = (g * np.linalg.solve(H, g[..., None])[..., 0]).sum(axis=1) + price - error @ weight @ error
        bound += np.maximum(fall, alone)
    most, best = 0.0, None
    for index in np.argsort(-bound, kind="stable")[:_MOST_SEGMENTS]:
        if not bound[index] > most:
            break
        segment, twists = tried[index], B[tried[index].edges] / count[index]
        slope, curvature = loops.quadratic(twists, segment.edges)
        V = np.stack([shift.sum(axis=0) for shift in loops.shifts(twists, segment.edges)])
        fall, _ = _largest_fall(unit + curvature, slope, e, M, V, price)
        if fall - costs[index] > most:
            most, best = fall - float(costs[index]), segment
    return most, best


def _largest_fall(A: Matrix, b: Vector, e: Matrix, M: Matrix, V: Matrix, price: float) -> tuple[float, Vector]:
    """Largest decrease of the cost by odometry errors (p,) that explain at least one loop edge, and these errors.

    A (p, p), b (p,) : of these errors, prior included; e, M, V : (L, ...) of the loop edges
    """
    VM = np.swapaxes(V, 1, 2) @ M
    VMV, VMe = VM @ V, (VM @ e[..., None])[..., 0]
    chosen, largest, best = np.eye(len(e)), 0.0, np.zeros(len(b))
    for _ in range(_ROUNDS):
        t = np.linalg.solve(A + np.einsum("cl,lab->cab", chosen, VMV), (b - chosen @ VMe)[..., None])[..., 0]
        left = e + np.einsum("lab,cb->cla", V, t)
        saved = np.maximum(price - np.einsum("cla,lab,clb->cl", left, M, left), 0.0)
        falls = 2.0 * t @ b - np.einsum("ca,ab,cb->c", t, A, t) + saved.sum(axis=1)
        falls[~saved.any(axis=1)] = 0.0
        if falls.max() > largest:
            largest, best = float(falls.max()), t[int(np.argmax(falls))]
        chosen = (saved > 0.0).astype(np.float64)
    return largest, best


def _means(each: Matrix, first: Integers, count: Integers) -> Matrix:
    """Mean (S, ...) over the edges of each segment, of values (O, ...)."""
    sums = np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])
    return (sums[first + count] - sums[first]) / count.reshape(-1, *(each.ndim - 1) * [1])
