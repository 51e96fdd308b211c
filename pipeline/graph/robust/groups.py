"""Groups of loop edges that agree with each other."""

from __future__ import annotations

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
    pairs = KDTree(problem.edges[loops]).query_pairs(_REACH, p=np.inf, output_type="ndarray")
    noise = np.linalg.pinv(problem.information[loops], hermitian=True)
    odometry = problem.information[~is_loop]
    step = np.linalg.pinv(np.median(odometry, axis=0), hermitian=True) if len(odometry) else 0.0
    parts = np.array_split(pairs, 1 + len(pairs) // _AT_ONCE)
    agree = np.concatenate([_distances(problem, poses, loops, each, noise, step) < limit for each in parts])
    a, b = pairs[agree].T
    links = coo_array((np.ones(len(a)), (a, b)), shape=(len(loops), len(loops)))
    label = connected_components(links, directed=False)[1]
    order = np.argsort(label, kind="stable")
    members = np.split(loops[order], 1 + np.flatnonzero(np.diff(label[order])))
    return [each for each in members if FEWEST <= len(each) <= _MOST]


def _distances(
    problem: BetweenProblem,
    poses: Matrix,
    loops: NDArray[np.int64],
    pairs: NDArray[np.int64],
    noise: Matrix,
    step: Matrix | float,
) -> NDArray[np.float64]:
    """Squared Mahalanobis distance (P,) of one loop edge of each pair (P, 2) from what the other predicts.

    noise : (L, k, k) covariances of the loop edges (L,); step : of an edge of odometry
    """
    a, b = pairs.T
    (i, j), (k, m) = problem.edges[loops[a]].T, problem.edges[loops[b]].T
    before, after = lie.between(poses[k], poses[i]), lie.between(poses[j], poses[m])
    predicted = before @ problem.measurements[loops[a]] @ after
    errors = lie.log(lie.between(problem.measurements[loops[b]], predicted))
    steps = np.abs(i - k) + np.abs(j - m)
    covariance = noise[a] + noise[b] + steps[:, None, None] * step
    return np.einsum("ea,eab,eb->e", errors, np.linalg.pinv(covariance, hermitian=True), errors)


def apart(ends: NDArray[np.int64], edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Those of the edges that join other poses than the ones before: a mistake repeated does not count twice."""
    is_chosen = np.zeros(len(edges), np.bool_)
    for place, near in enumerate(KDTree(ends[edges]).query_ball_point(ends[edges], _REACH, p=np.inf)):
        is_chosen[place] = not is_chosen[near].any()
    return edges[is_chosen]
