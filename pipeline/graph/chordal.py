"""First guess for a pose graph by chordal relaxation: two linear problems, rotations and then translations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.solvers.cholesky import BlockPattern, SparseCholesky


def relax_chordally(problem: BetweenProblem, poses: Matrix) -> Matrix:
    """Poses (K, d+1, d+1) from two linear least-squares problems (Martinec & Pajdla 2007; Carlone et al. 2015).

    Rotations: minimize Σ κ ‖R_j − R_i R_z‖² over any matrices, then take the nearest rotation of each.
    Translations: minimize Σ τ ‖t_j − t_i − R_i t_z‖². κ and τ are the mean rotational and translational
    information of the edge. The problem's fixed poses stay where ``poses`` has them.
    """
    d = poses.shape[-1] - 1
    Z, information = problem.measurements, problem.information
    result = poses.copy()
    kappa = np.trace(information[:, d:, d:], axis1=1, axis2=2)
    R_z_t = np.swapaxes(Z[:, :d, :d], 1, 2)
    known = np.swapaxes(poses[:, :d, :d], 1, 2)
    rotations = _least_squares(problem, R_z_t, kappa, np.zeros((len(Z), d, d)), known)
    result[problem.free, :d, :d] = _nearest_rotation(np.swapaxes(rotations[problem.free], 1, 2))
    tau = np.trace(information[:, :d, :d], axis1=1, axis2=2)
    leaps = (result[problem.edges[:, 0], :d, :d] @ Z[:, :d, d, None])[:, None, :, 0]
    ones = np.ones((len(Z), 1, 1))
    result[:, :d, d] = _least_squares(problem, ones, tau, leaps, poses[:, None, :d, d])[:, 0]
    return result


def _least_squares(
    problem: BetweenProblem, A: Matrix, weight: NDArray[np.float64], offset: Matrix, known: Matrix
) -> Matrix:
    """X (K, b, m) that minimizes Σ w ‖X_j − A X_i − c‖², with A (E, b, b) orthogonal and X given where fixed."""
    size, columns = known.shape[1:]
    n = len(problem.free)
    blocks = np.zeros((n + len(problem.pattern.pairs), size, size))
    right = np.zeros((n, size, columns))
    i, j = problem.slots[:, 0], problem.slots[:, 1]
    pair = problem.slots[:, 2]
    w = weight[:, None, None]
    joined = pair >= 0
    coupling = np.where((j > i)[:, None, None], -w * A, -w * np.swapaxes(A, 1, 2))
    np.add.at(blocks, pair[joined], coupling[joined])
    held = np.where((problem.variable < 0)[:, None, None], known, 0.0)
    for_i = w * (np.swapaxes(A, 1, 2) @ (held[problem.edges[:, 1]] - offset))
    for_j = w * (A @ held[problem.edges[:, 0]] + offset)
    degree = np.zeros(n)
    for end, target in ((i, for_i), (j, for_j)):
        np.add.at(right, end[end >= 0], target[end >= 0])
        np.add.at(degree, end[end >= 0], weight[end >= 0])
    blocks[:n] = degree[:, None, None] * np.eye(size)
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
