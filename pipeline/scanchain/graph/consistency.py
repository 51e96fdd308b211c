"""The consistency of loop edges with all others: edges that agree, taken or dropped one by one or as a group."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.covariance import difference_covariances, edge_covariances, inverse_blocks
from scanchain.graph.problem import GraphProblem

_ROUNDING = 1e-9  # keeps edges without which their poses would be loose from a division by zero


class Consistency:
    """Squared Mahalanobis distance between what edges measure and what all the other kept edges predict.

    To first order it is what the χ² of the whole graph falls by without edges that are kept, and rises by with
    others. With P the covariance of the prediction, given all kept edges, it is
        eᵀ(Ω⁻¹ − P)⁻¹e of kept edges,    eᵀ(Ω⁻¹ + P)⁻¹e of others.
    The residual alone is too small: a kept edge bends the graph toward itself.
    """

    def __init__(self, problem: GraphProblem, poses: Matrix, kept: NDArray[np.bool_]) -> None:
        """Kept (E,): the edges in force at these poses."""
        self._problem, self._kept = problem, kept
        self._errors = problem.errors(poses)
        self._jacobians = problem.jacobians(poses, self._errors)
        self._sparse = problem.factored(poses, self._errors, kept)

    def of_each(self, price: float) -> NDArray[np.float64]:
        """The distance of every edge, (E,), from all others.

        Where a lower bound of that of an edge left out, by Cov(a − b) ⪯ 2 Cov(a) + 2 Cov(b), is above the price
        already, the bound is given.
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

    def of_group(self, group: NDArray[np.int64]) -> float:
        """The distance of the edges of a group, all of them kept or none, from all others."""
        k, count = self._problem.freedom, len(group)
        J = self._jacobians[group]
        joint = difference_covariances(self._sparse, self._problem.edges[group])  # at [b, a]
        predicted = (J[None] @ joint @ np.swapaxes(J, 1, 2)[:, None]).transpose(1, 2, 0, 3)
        information = np.zeros((count, k, count, k))
        information[np.arange(count), :, np.arange(count)] = self._problem.information[group]
        size = k * count
        P, omega = predicted.reshape(1, size, size), information.reshape(1, size, size)
        return float(_distances(self._errors[group].reshape(1, size), omega, P, self._kept[group[:1]])[0])

    def _distances(self, edges: NDArray[np.int64], joint: Matrix) -> NDArray[np.float64]:
        """Those of single edges (N,), from the covariances (N, k, k) of ξ_j − ξ_i."""
        J = self._jacobians[edges]
        predicted = J @ joint @ np.swapaxes(J, 1, 2)
        return _distances(self._errors[edges], self._problem.information[edges], predicted, self._kept[edges])


def _distances(e: Matrix, omega: Matrix, P: Matrix, kept: NDArray[np.bool_]) -> NDArray[np.float64]:
    """eᵀ(Ω⁻¹ ∓ P)⁻¹e = eᵀΩ(I ∓ PΩ)⁻¹e, (N,), of residuals (N, m) that are kept or not."""
    sign = np.where(kept, -1.0, 1.0)[:, None, None]
    matrix = (1.0 + _ROUNDING) * np.eye(e.shape[1]) + sign * (P @ omega)
    return (e[:, None] @ omega @ np.linalg.solve(matrix, e[..., None]))[:, 0, 0]


FEWEST = 3  # least number of edges of a group; fewer may agree by chance
_REACH = 5  # largest difference of the poses of two agreeing edges, at either end, in the order of the poses
_MOST = 50  # largest number of edges of a group that is looked at as one
_AT_ONCE = 10_000  # pairs of edges that are compared at once, of many


def agreeing_groups(
    problem: GraphProblem, poses: Matrix, chosen: NDArray[np.bool_], limit: float
) -> list[NDArray[np.int64]]:
    """Loop edges of each group among those chosen (E,): they join the same two segments of poses and agree there.

    Two agree where one predicts the other along the poses between their ends: the squared Mahalanobis distance,
    with the noise of both and of an odometry edge for each of these poses, is below the limit.
    """
    loops = np.flatnonzero(chosen & problem.is_loop)
    if len(loops) < FEWEST:
        return []
    edges, Z = problem.edges[loops], problem.measurements[loops]
    noise = np.linalg.pinv(problem.information[loops], hermitian=True)
    odometry = problem.information[problem.is_odometry]
    step = np.linalg.pinv(np.median(odometry, axis=0), hermitian=True) if len(odometry) else 0.0

    def agree(a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.bool_]:
        errors = lie.log(lie.between(Z[b], carried(poses, edges[a], Z[a], edges[b])))
        steps = np.abs(edges[a] - edges[b]).sum(axis=1)
        covariance = noise[a] + noise[b] + steps[:, None, None] * step
        return np.einsum("ea,eab,eb->e", errors, np.linalg.pinv(covariance, hermitian=True), errors) < limit

    groups = connected(KDTree(edges).query_pairs(_REACH, p=np.inf, output_type="ndarray"), len(loops), agree)
    return [loops[each] for each in groups if len(each) <= _MOST]


def carried(poses: Matrix, edges: NDArray[np.int64], Z: Matrix, others: NDArray[np.int64]) -> Matrix:
    """What edges (P, 2) that measure Z predict of other pairs (P, 2), along the poses between their ends."""
    before = lie.between(poses[others[:, 0]], poses[edges[:, 0]])
    after = lie.between(poses[edges[:, 1]], poses[others[:, 1]])
    return before @ Z @ after


def connected(
    pairs: NDArray[np.int64], count: int, agree: Callable[..., NDArray[np.bool_]]
) -> list[NDArray[np.int64]]:
    """Groups of at least ``FEWEST`` of so many, connected by pairs (P, 2) that agree: a (P,) and b (P,), bool."""
    parts = np.array_split(pairs, 1 + len(pairs) // _AT_ONCE)
    a, b = pairs[np.concatenate([agree(*part.T) for part in parts])].T
    label = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)[1]
    order = np.argsort(label, kind="stable")
    members = np.split(order, 1 + np.flatnonzero(np.diff(label[order])))
    return [each for each in members if len(each) >= FEWEST]


def apart(ends: NDArray[np.int64], edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Those of the edges that join other poses than the ones before: a mistake repeated does not count twice."""
    is_chosen = np.zeros(len(edges), np.bool_)
    for place, near in enumerate(KDTree(ends[edges]).query_ball_point(ends[edges], _REACH, p=np.inf)):
        is_chosen[place] = not is_chosen[near].any()
    return edges[is_chosen]
