"""Groups of loop edges that agree with each other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem

FEWEST = 3  # least number of edges of a group; fewer may agree by chance
_REACH = 5  # largest difference of the poses of two agreeing edges, at either end, in the order of the poses
_MOST = 50  # largest number of edges of a group that is looked at as one
_AT_ONCE = 10_000  # pairs of edges that are compared at once, of many


def agreeing_groups(
    problem: BetweenProblem, poses: Matrix, is_loop: NDArray[np.bool_], chosen: NDArray[np.bool_], limit: float
) -> list[NDArray[np.int64]]:
    """Edges of each group among those chosen (E,): they join the same two stretches of poses and agree there.

    Two agree where one predicts the other along the poses between their ends: the squared Mahalanobis distance,
    with the noise of both and of an odometry edge for each of these poses, is below the limit.
    """
    loops = np.flatnonzero(chosen & is_loop)
    if len(loops) < FEWEST:
        return []
    edges, Z = problem.edges[loops], problem.measurements[loops]
    noise = np.linalg.pinv(problem.information[loops], hermitian=True)
    odometry = problem.information[~is_loop]
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
    pairs: NDArray[np.int64],
    count: int,
    agree: Callable[..., NDArray[np.bool_]],
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
