"""First guesses for a pose graph from its measurements: odometry chain, spanning tree, chordal relaxation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

from pipeline.data import Matrix
from pipeline.graph.cholesky import BlockPattern, SparseCholesky
from pipeline.kernels.graph_tree import follow_tree


def follow_spanning_tree(poses: Matrix, fixed: NDArray[np.bool_], edges: NDArray[np.int64], Z: Matrix) -> Matrix:
    """Poses (K, d+1, d+1) chained from the fixed ones along the shortest paths; unreachable ones stay."""
    result, reached = poses.copy(), fixed.astype(np.int64)
    ends = edges.T.reshape(-1)
    order = np.argsort(ends, kind="stable")
    start = np.searchsorted(ends[order], np.arange(len(poses) + 1))
    follow_tree(start, order % max(len(edges), 1), edges, Z, result, reached)
    return result


def follow_odometry(poses: Matrix, fixed: NDArray[np.bool_], edges: NDArray[np.int64], Z: Matrix) -> Matrix:
    """Poses chained along the edges between successive poses, and where one is missing, the next shortest leap."""
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, first = np.unique(low * len(poses) + high, return_index=True)
    leaps = csr_matrix(((high - low)[first], (low[first], high[first])), shape=(len(poses), len(poses)))
    tree = minimum_spanning_tree(leaps).tocoo()
    kept = first[np.isin((low * len(poses) + high)[first], tree.row.astype(np.int64) * len(poses) + tree.col)]
    return follow_spanning_tree(poses, fixed, edges[kept], Z[kept])


def relax_chordally(
    poses: Matrix, fixed: NDArray[np.bool_], edges: NDArray[np.int64], Z: Matrix, information: Matrix
) -> Matrix:
    """Poses from two linear least-squares problems (Martinec & Pajdla 2007; Carlone et al. 2015).

    Rotations: minimise Σ κ ‖R_j − R_i R_z‖² over any matrices, then take the nearest rotation of each.
    Translations: minimise Σ τ ‖t_j − t_i − R_i t_z‖². κ and τ are the mean rotational and translational
    information of the edge. The fixed poses stay.
    """
    d = poses.shape[-1] - 1
    result = poses.copy()
    turned = np.ascontiguousarray(np.swapaxes(Z[:, :d, :d], 1, 2))
    kappa = np.trace(information[:, d:, d:], axis1=1, axis2=2)
    known = np.swapaxes(poses[:, :d, :d], 1, 2)
    transposed = _least_squares(fixed, edges, turned, kappa, np.zeros((len(edges), d, d)), known)
    result[:, :d, :d] = np.where(
        fixed[:, None, None], poses[:, :d, :d], _nearest_rotation(np.swapaxes(transposed, 1, 2))
    )
    tau = np.trace(information[:, :d, :d], axis1=1, axis2=2)
    leaps = (result[edges[:, 0], :d, :d] @ Z[:, :d, d, None])[:, None, :, 0]
    ones = np.ones((len(edges), 1, 1))
    result[:, :d, d] = _least_squares(fixed, edges, ones, tau, leaps, poses[:, None, :d, d])[:, 0]
    return result


def _least_squares(
    fixed: NDArray[np.bool_],
    edges: NDArray[np.int64],
    A: Matrix,
    weight: NDArray[np.float64],
    offset: Matrix,
    known: Matrix,
) -> Matrix:
    """X (K, b, m) that minimises Σ w ‖X_j − A X_i − c‖², with A (E, b, b) orthogonal and X given where fixed."""
    size, columns = known.shape[1:]
    free = np.flatnonzero(~fixed)
    variable = np.full(len(fixed), -1, np.int64)
    variable[free] = np.arange(len(free))
    ends = variable[edges].reshape(-1, 2)
    both = (ends >= 0).all(axis=1)
    later_first = ends[both, 1] > ends[both, 0]
    coupling = -weight[both, None, None] * A[both]
    coupling = np.where(later_first[:, None, None], coupling, np.swapaxes(coupling, 1, 2))
    pairs, which = np.unique(np.sort(ends[both], axis=1)[:, ::-1], axis=0, return_inverse=True)
    blocks = np.zeros((len(free) + len(pairs), size, size))
    right = np.zeros((len(free), size, columns))
    np.add.at(blocks, len(free) + which.reshape(-1), coupling)
    degree = np.zeros(len(free))
    A_t = np.swapaxes(A, 1, 2)
    given = np.where(fixed[:, None, None], known, 0.0)
    w = weight[:, None, None]
    for end, target in ((0, -w * (A_t @ (offset - given[edges[:, 1]]))), (1, w * (offset + A @ given[edges[:, 0]]))):
        here = ends[:, end] >= 0
        np.add.at(right, ends[here, end], target[here])
        np.add.at(degree, ends[here, end], weight[here])
    blocks[: len(free)] = degree[:, None, None] * np.eye(size)
    pattern = BlockPattern(np.full(len(free), size, np.int64), np.ascontiguousarray(pairs).reshape(-1, 2))
    factor = SparseCholesky(pattern)
    factor.factorise(blocks.reshape(-1))
    result = known.copy()
    result[free] = factor.solve(right.reshape(-1, columns)).reshape(-1, size, columns)
    return result


def _nearest_rotation(matrices: Matrix) -> Matrix:
    """The rotation nearest to each matrix (K, d, d): U diag(1, …, det U Vᵀ) Vᵀ (Umeyama 1991)."""
    U, _, Vt = np.linalg.svd(matrices)
    U[:, :, -1] *= np.linalg.det(U @ Vt)[:, None]
    return U @ Vt
