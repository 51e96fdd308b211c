"""Consistency of single edges, and of groups of loop edges that agree, with all other edges."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import GraphState, Integers, Mask, Matrix, Vector
from scanchain.graph.covariance import difference_covariances, edge_covariances, inverse_blocks
from scanchain.graph.factors import ORIGIN
from scanchain.graph.losses import rejection_limit
from scanchain.graph.problem import GraphProblem


class Consistency:
    """Squared Mahalanobis distance between the measurement of edges and their prediction by all other kept edges.

    To first order it is the change of the χ² of the graph: the decrease when a kept edge is removed, the increase
    when a rejected edge is added. With the residual e at the minimum over the kept edges, the edge's information Ω
    and the covariance P of its prediction by all kept edges, it is
        eᵀ(Ω⁻¹ − P)⁻¹e of a kept edge,    eᵀ(Ω⁻¹ + P)⁻¹e of a rejected one.
    The own χ² of a kept edge, eᵀΩe, is less, since the edge pulls the poses toward its measurement.
    """

    def __init__(self, problem: GraphProblem, poses: Matrix, kept: Mask) -> None:
        """Kept (E,): the edges in force at these poses."""
        self._problem, self._kept = problem, kept
        self._errors = problem.errors(poses)
        self._jacobians = problem.jacobians(poses, self._errors)
        self._sparse = problem.factored(poses, self._errors, kept)

    def of_each(self, price: float) -> Vector:
        """Distance of every edge, (E,).

        Of rejected edges it is a lower bound, by Cov(a − b) ⪯ 2 Cov(a) + 2 Cov(b), where that is already above the
        price: only the others need a solve each.
        """
        problem, kept, every = self._problem, self._kept, np.arange(len(self._kept))
        blocks = inverse_blocks(self._sparse)
        i, j = problem.variable[problem.edges].T
        joint = 2.0 * (blocks[i] + blocks[j])
        joint[kept] = edge_covariances(self._sparse, blocks)
        result = self._distances(every, joint)
        near = np.flatnonzero(~kept & (result < price))
        for edge in near:
            joint[edge] = difference_covariances(self._sparse, problem.edges[[edge]])[0, 0]
        result[near] = self._distances(near, joint[near])
        return result

    def of_group(self, group: Integers) -> float:
        """Distance of a group of edges, all of them kept or all rejected, to their prediction by the others."""
        k, count = self._problem.freedom, len(group)
        J = self._jacobians[group]
        joint = difference_covariances(self._sparse, self._problem.edges[group])  # at [b, a]
        predicted = (J[None] @ joint @ np.swapaxes(J, 1, 2)[:, None]).transpose(1, 2, 0, 3)
        information = np.zeros((count, k, count, k))
        information[np.arange(count), :, np.arange(count)] = self._problem.information[group]
        size = k * count
        P, omega = predicted.reshape(1, size, size), information.reshape(1, size, size)
        return float(_distances(self._errors[group].reshape(1, size), omega, P, self._kept[group[:1]])[0])

    def _distances(self, edges: Integers, joint: Matrix) -> Vector:
        """Distances of single edges, (N,), by the covariances (N, k, k) of ξ_j − ξ_i from the kept edges."""
        J = self._jacobians[edges]
        predicted = J @ joint @ np.swapaxes(J, 1, 2)
        return _distances(self._errors[edges], self._problem.information[edges], predicted, self._kept[edges])


def _distances(e: Matrix, omega: Matrix, P: Matrix, kept: Mask) -> Vector:
    """eᵀ(Ω⁻¹ ∓ P)⁻¹e = eᵀΩ(I ∓ PΩ)⁻¹e, (N,), from residuals (N, m) of edges that are kept or not."""
    sign = np.where(kept, -1.0, 1.0)[:, None, None]
    # an edge that alone connects its poses to the graph must not lead to a division by zero
    matrix = (1.0 + 1e-9) * np.eye(e.shape[1]) + sign * (P @ omega)
    return (e[:, None] @ omega @ np.linalg.solve(matrix, e[..., None]))[:, 0, 0]


def is_bent(before: GraphState, after: GraphState, robust_scale: float) -> bool:
    """True if unary edges added since contradict those between poses by more than their standard deviations."""
    old, new = (each.edge_chi2[each.edges[:, 0] != ORIGIN] for each in (before, after))
    increase = (new - old)[~before.is_rejected[before.edges[:, 0] != ORIGIN]]
    k = lie.twist_size(before.poses)
    return bool(increase.max() > rejection_limit(robust_scale, k) or increase.mean() > k)


FEWEST = 3  # least number of loop edges that support a change of several; fewer may agree by chance
_REACH = 5  # largest difference between the pose indices of two agreeing edges, at either end
_MOST = 50  # largest number of edges of a group that is tested as one; larger groups are not


def agreeing_groups(problem: GraphProblem, poses: Matrix, chosen: Mask, limit: float) -> list[Integers]:
    """Groups of loop edges among those chosen (E,) that join the same two segments of the trajectory and agree.

    Two edges agree if one predicts the other along the poses between their ends: the squared Mahalanobis distance,
    with the noise of both and of an odometry edge for each of these poses, is below the limit.
    """
    loops = np.flatnonzero(chosen & problem.is_loop)
    if len(loops) < FEWEST:
        return []
    edges, Z = problem.edges[loops], problem.measurements[loops]
    noise = np.linalg.pinv(problem.information[loops], hermitian=True)
    odometry = problem.information[problem.is_odometry]
    step = np.linalg.pinv(np.median(odometry, axis=0), hermitian=True) if len(odometry) else 0.0

    def agree(a: Integers, b: Integers) -> Mask:
        errors = lie.log(lie.between(Z[b], carried(poses, edges[a], Z[a], edges[b])))
        steps = np.abs(edges[a] - edges[b]).sum(axis=1)
        covariance = noise[a] + noise[b] + steps[:, None, None] * step
        return np.einsum("ea,eab,eb->e", errors, np.linalg.pinv(covariance, hermitian=True), errors) < limit

    groups = connected(KDTree(edges).query_pairs(_REACH, p=np.inf, output_type="ndarray"), len(loops), agree)
    return [loops[each] for each in groups if len(each) <= _MOST]


def carried(poses: Matrix, edges: Integers, Z: Matrix, others: Integers) -> Matrix:
    """Relative poses of other pairs (P, 2), predicted by edges (P, 2) that measure Z and the poses between."""
    before = lie.between(poses[others[:, 0]], poses[edges[:, 0]])
    after = lie.between(poses[edges[:, 1]], poses[others[:, 1]])
    return before @ Z @ after


def connected(pairs: Integers, count: int, agree: Callable[..., Mask]) -> list[Integers]:
    """Connected groups, at least ``FEWEST`` of ``count`` items each, by the pairs (P, 2) for which agree(a, b)."""
    parts = np.array_split(pairs, 1 + len(pairs) // 10_000)  # pairs compared in one call
    a, b = pairs[np.concatenate([agree(*part.T) for part in parts])].T
    label = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)[1]
    order = np.argsort(label, kind="stable")
    members = np.split(order, 1 + np.flatnonzero(np.diff(label[order])))
    return [each for each in members if len(each) >= FEWEST]


def apart(ends: Integers, edges: Integers) -> Integers:
    """Edges without an earlier chosen one near both of their ends: a repeated mistake does not count twice."""
    is_chosen = np.zeros(len(edges), np.bool_)
    for place, near in enumerate(KDTree(ends[edges]).query_ball_point(ends[edges], _REACH, p=np.inf)):
        is_chosen[place] = not is_chosen[near].any()
    return edges[is_chosen]
