"""First guesses for a pose graph from its measurements: odometry chain, spanning tree, chordal relaxation."""

from __future__ import annotations

from contextlib import suppress
from typing import Literal

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from scanchain import lie
from scanchain.data import Integers, Mask, Matrix, Vector
from scanchain.graph.cholesky import BlockPattern, SingularMatrixError, SparseCholesky
from scanchain.graph.problem import GraphProblem

Initialization = Literal["auto", "given", "odometry", "spanning-tree", "chordal"]

_GOOD_GUESS = 2.0  # χ² per degree of freedom up to which the given poses need no other initialization


def first_guess(
    problem: GraphProblem, poses: Matrix, initialize: Initialization, *, outlier_free: bool
) -> tuple[Matrix, Initialization]:
    """Initial poses, and the method that they come from.

    "auto" keeps the given poses where they fit, else uses the better of them and the chordal relaxation. If there
    may be outliers it always keeps them, since the chordal relaxation is not robust to false loops.
    """
    to_point = problem.is_bounded & problem.is_point[problem.edges].any(axis=1)
    if initialize in ("odometry", "spanning-tree"):
        return _with_points(problem, _by(initialize, problem, poses), to_point), initialize
    if initialize == "chordal":
        return _by("chordal", problem, poses), initialize
    guess, chi2 = poses.copy(), problem.chi2(problem.errors(poses)).sum()
    if initialize == "given":
        return guess, "given"
    if to_point.any():
        placed = _with_points(problem, poses, to_point)
        chi2_placed = problem.chi2(problem.errors(placed)).sum()
        if chi2_placed < chi2:
            guess, chi2 = placed, chi2_placed
    redundancy = problem.freedom * max(len(problem.edges) - len(problem.free), 1)
    if outlier_free and chi2 > _GOOD_GUESS * redundancy:
        with suppress(SingularMatrixError):
            relaxed = _by("chordal", problem, poses)
            if problem.chi2(problem.errors(relaxed)).sum() < chi2:
                return relaxed, "chordal"
    return guess, "given"


def _by(method: Initialization, problem: GraphProblem, poses: Matrix) -> Matrix:
    """Poses by "odometry", "spanning-tree" or "chordal".

    Where no edge measures a rotation relative to a fixed pose, they are computed relative to the first pose and
    then moved rigidly to the positions that are measured relative to fixed ones.
    """
    fixed, d, local = problem.variable < 0, poses.shape[-1] - 1, problem
    from_fixed = np.asarray(fixed[problem.edges].any(axis=1))
    is_adrift = not problem.information[from_fixed & problem.is_bounded, d:].any()
    if is_adrift:
        fixed[problem.free[~problem.is_point[problem.free]][:1]] = True
        local = problem.restricted(~from_fixed, fixed)
    if method == "chordal":
        result = relax_chordally(local, poses)
    else:
        follow, whole = follow_odometry if method == "odometry" else follow_spanning_tree, local.is_whole
        result = follow(poses, fixed, local.edges[whole], local.measurements[whole])
    return _aligned(problem, result) if is_adrift else result


def _aligned(problem: GraphProblem, poses: Matrix) -> Matrix:
    """Free poses moved rigidly to the positions that are measured relative to fixed ones (Umeyama 1991)."""
    d, chosen = poses.shape[-1] - 1, (problem.variable[problem.edges[:, 0]] < 0) & problem.is_bounded
    i, j = problem.edges[chosen].T
    seen, found = (poses[i] @ problem.measurements[chosen])[:, :d, d], poses[j, :d, d]
    share = np.trace(problem.information[chosen, :d, :d], axis1=1, axis2=2)[:, None]
    share /= max(share.sum(), 1e-300)
    result, T = poses.copy(), lie.identity(d)
    T[:d, :d] = _nearest_rotation((share * (seen - (share * seen).sum(axis=0))).T[None] @ found)[0]
    T[:d, d] = (share * (seen - found @ T[:d, :d].T)).sum(axis=0)
    result[problem.free] = T @ poses[problem.free]
    result[problem.is_point, :d, :d] = np.eye(d)
    return result


def _with_points(problem: GraphProblem, poses: Matrix, to_point: Mask) -> Matrix:
    """Poses with every free point at the mean of its positions as seen from poses, by these edges (E,)."""
    i, j = problem.edges[to_point].T
    total = np.zeros(poses.shape)
    np.add.at(total, j, poses[i] @ problem.measurements[to_point])
    placed = (total[:, -1, -1] > 0.0) & (problem.variable >= 0)
    result = poses.copy()
    result[placed, :-1, -1] = total[placed, :-1, -1] / total[placed, -1:, -1]
    return result


def follow_odometry(poses: Matrix, fixed: Mask, edges: Integers, Z: Matrix) -> Matrix:
    """Poses chained along edges between successive poses or, where one is missing, the next closest indices."""
    pairs, first = _distinct_pairs(edges, len(poses))
    low, high = np.divmod(pairs, len(poses))
    tree = minimum_spanning_tree(csr_matrix((high - low, (low, high)), shape=(len(poses), len(poses)))).tocoo()
    kept = first[np.isin(pairs, tree.row.astype(np.int64) * len(poses) + tree.col)]
    return follow_spanning_tree(poses, fixed, edges[kept], Z[kept])


def follow_spanning_tree(poses: Matrix, fixed: Mask, edges: Integers, Z: Matrix) -> Matrix:
    """Poses (K, d+1, d+1) chained from the fixed ones along the fewest edges; unreachable ones stay."""
    count, fixed_poses = len(poses), np.flatnonzero(fixed)
    from_root = np.stack([np.full(len(fixed_poses), count), fixed_poses])  # an extra root with all fixed poses
    ends = np.concatenate([edges.T, from_root], axis=1)
    links = csr_matrix((np.ones(ends.shape[1]), (ends[0], ends[1])), shape=(count + 1, count + 1))
    _, parent = breadth_first_order(links, count, directed=False)
    parent = np.where((parent[:-1] >= 0) & (parent[:-1] < count), parent[:-1], np.arange(count)).astype(np.int64)
    child = np.flatnonzero(parent != np.arange(count))
    pairs, first = _distinct_pairs(edges, count)
    edge = first[np.searchsorted(pairs, _pairs(parent[child], child, count))]
    is_forward = (edges[edge, 1] == child)[:, None, None]
    motion = np.tile(lie.identity(poses.shape[-1] - 1), (count, 1, 1))
    motion[child] = np.where(is_forward, Z[edge], lie.inverse(Z[edge]))
    while (parent[parent] != parent).any():  # each round doubles the edges that a motion spans
        motion, parent = motion[parent] @ motion, parent[parent]
    return poses[parent] @ motion


def _distinct_pairs(edges: Integers, count: int) -> tuple[Integers, Integers]:
    """Integer key of every pair of poses that edges (E, 2) join, ascending, and the first edge of each."""
    return np.unique(_pairs(edges[:, 0], edges[:, 1], count), return_index=True)


def _pairs(i: Integers, j: Integers, count: int) -> Integers:
    """Integer key of each unordered pair of ``count`` poses."""
    return np.minimum(i, j) * count + np.maximum(i, j)


def relax_chordally(problem: GraphProblem, poses: Matrix) -> Matrix:
    """Poses (K, d+1, d+1) from two linear least-squares problems (Martinec & Pajdla 2007; Carlone et al. 2015).

    Rotations: minimize Σ κ ‖R_j − R_i R_z‖² over any matrices, then take the nearest rotation of each.
    Translations: minimize Σ τ ‖t_j − t_i − R_i t_z‖². κ and τ are the traces of the rotational and translational
    information of the edge, zero for custom factors. The problem's fixed poses keep their values in ``poses``.
    """
    d = poses.shape[-1] - 1
    Z, information = problem.measurements, problem.is_bounded[:, None, None] * problem.information
    result = poses.copy()
    kappa = np.trace(information[:, d:, d:], axis1=1, axis2=2)
    R_z_t = np.swapaxes(Z[:, :d, :d], 1, 2)
    known = np.swapaxes(poses[:, :d, :d], 1, 2)
    rotations = _least_squares(problem, R_z_t, kappa, np.zeros((len(Z), d, d)), known)
    result[problem.free, :d, :d] = _nearest_rotation(np.swapaxes(rotations[problem.free], 1, 2))
    result[problem.is_point, :d, :d] = np.eye(d)
    tau = np.trace(information[:, :d, :d], axis1=1, axis2=2)
    leaps = (result[problem.edges[:, 0], :d, :d] @ Z[:, :d, d, None])[:, None, :, 0]
    ones = np.ones((len(Z), 1, 1))
    result[:, :d, d] = _least_squares(problem, ones, tau, leaps, poses[:, None, :d, d])[:, 0]
    return result


def _least_squares(problem: GraphProblem, A: Matrix, weight: Vector, offset: Matrix, known: Matrix) -> Matrix:
    """X (K, b, m) that minimizes Σ w ‖X_j − A X_i − c‖², with A (E, b, b) orthogonal and X given where fixed.

    Points, which have no rotation, get a unit prior on it.
    """
    size, columns = known.shape[1:]
    n, w = len(problem.free), weight[:, None, None]
    A_t = np.swapaxes(A, 1, 2)
    held = np.where((problem.variable < 0)[:, None, None], known, 0.0)
    for_i = w * (A_t @ (held[problem.edges[:, 1]] - offset))
    for_j = w * (A @ held[problem.edges[:, 0]] + offset)
    right = np.zeros((n, size, columns))
    for end, target in ((problem.slots[:, 0], for_i), (problem.slots[:, 1], for_j)):
        np.add.at(right, end[end >= 0], target[end >= 0])
    blocks = problem.scattered(w * np.eye(size), w * np.eye(size), -w * A_t)
    if size > 1:
        blocks[:n][problem.is_point[problem.free]] += np.eye(size)
    pattern = BlockPattern(np.full(n, size, np.int64), problem.pattern.pairs)
    factor = SparseCholesky(pattern, problem.cholesky.analysis)
    factor.factorize(blocks.reshape(-1))
    result = known.copy()
    result[problem.free] = factor.solve(right.reshape(-1, columns)).reshape(-1, size, columns)
    return result


def _nearest_rotation(matrices: Matrix) -> Matrix:
    """The rotation nearest to each matrix (K, d, d): U diag(1, …, det U Vᵀ) Vᵀ (Umeyama 1991)."""
    if matrices.shape[-1] == 2:
        cosine, sine = matrices[:, 0, 0] + matrices[:, 1, 1], matrices[:, 1, 0] - matrices[:, 0, 1]
        angle = np.arctan2(sine, cosine)
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
    U, _, Vt = np.linalg.svd(matrices)
    U[:, :, -1] *= np.linalg.det(U @ Vt)[:, None]
    return U @ Vt
