"""Normalized estimation error squared of poses and landmarks against motion capture, per degree of freedom.

Errors and covariance are those after the rigid alignment of the positions, x ← x − G (BᵀG)⁻¹ Bᵀ x with G the rigid
motions of everything and B those of the aligned positions alone, so that they do not depend on the first pose.
"""

from typing import NamedTuple

import numpy as np

from scanchain import lie

HEADING_RAD = 0.017
"""Of motion capture in UTIAS MRCLAM 6: where robot 1 drives straight on, its course differs by 0.021 rad from the
captured heading and by 0.019 rad from the estimated one, which differ by 0.023 rad."""


class Nees(NamedTuple):
    """ATE in m; NEES of positions, headings, poses (both), landmarks one by one and as a whole."""

    ate_m: float
    position: float
    heading: float
    poses: float
    landmarks: float
    map: float


def wrapped(angle):
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def truth_at(log, nodes_s):
    """True poses (K, 3)."""
    x, y, heading = log.true_poses.T
    return np.stack([np.interp(nodes_s, log.true_s, each) for each in (x, y, np.unwrap(heading))], axis=1)


def truth_of(logs, solution):
    """True poses (K, 3) of several robots."""
    times = np.split(solution.nodes_s, solution.problem.measurements.starts[1:])
    return np.concatenate([truth_at(log, times_s) for log, times_s in zip(logs, times, strict=True)])


def nees(solution, truth, landmarks, heading_rad=HEADING_RAD):
    """Of a solution with true poses (K, 3) and landmarks (L, 2), of which NaN are unknown."""
    state, evaluation = solution.minimum.estimate.state, solution.minimum.estimate
    weights = solution.loss.efficiency(evaluation.at.chi2) * evaluation.weights
    A = solution.problem.system(evaluation.at, weights).A
    C = np.linalg.inv((A.T @ A).toarray())
    split, count = state.poses.size, len(state.calibration)
    place = np.arange(split).reshape(-1, 3)
    spot = np.arange(split + count, len(C)).reshape(-1, 2)
    G = np.zeros((len(C), 3))
    for columns, points in ((place[:, :2], state.poses[:, :2]), (spot, state.landmarks)):
        G[columns[:, 0], 0] = G[columns[:, 1], 1] = 1.0
        G[columns[:, 0], 2], G[columns[:, 1], 2] = -points[:, 1], points[:, 0]
    G[place[:, 2], 2] = 1.0
    B = np.zeros_like(G)
    B[place[:, :2].ravel()] = G[place[:, :2].ravel()]
    S = np.eye(len(C)) - G @ np.linalg.solve(B.T @ G, B.T)
    C = S @ C @ S.T
    T = aligned(truth[:, :2], state.poses[:, :2])
    turn = np.arctan2(T[1, 0], T[0, 0])
    off = state.poses[:, :2] - lie.transform(T, truth[:, :2])
    turned = wrapped(state.poses[:, 2] - truth[:, 2] - turn)
    variance = C[place[:, 2], place[:, 2]] + heading_rad**2
    heading, position = float(np.mean(turned**2 / variance)), distances(off, C, place[:, :2])
    known = np.isfinite(landmarks[:, 0])
    if not known.any():
        return Nees(ate_of(off), position, heading, (2.0 * position + heading) / 3.0, np.nan, np.nan)
    of_landmarks = distances((state.landmarks - lie.transform(T, landmarks))[known], C, spot[known])
    values, vectors = np.linalg.eigh(C[np.ix_(spot[known].ravel(), spot[known].ravel())])
    whole = vectors.T @ (state.landmarks - lie.transform(T, landmarks))[known].ravel()
    kept = values > 1e-9 * values[-1]
    of_map = float(np.mean(whole[kept] ** 2 / values[kept]))
    return Nees(ate_of(off), position, heading, (2.0 * position + heading) / 3.0, of_landmarks, of_map)


def ate_of(off):
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def aligned(points, others):
    """The rigid motion (3, 3) of points (N, 2) that brings them closest to others."""
    center, other = points.mean(axis=0), others.mean(axis=0)
    H = (points - center).T @ (others - other)
    turn = np.arctan2(H[0, 1] - H[1, 0], H[0, 0] + H[1, 1])
    c, s = np.cos(turn), np.sin(turn)
    return lie.pose_2d(*(other - np.array([[c, -s], [s, c]]) @ center), turn)


def distances(off, C, columns):
    """Mean squared Mahalanobis distance per dimension."""
    blocks = C[columns[:, :, None], columns[:, None]] + 1e-12 * np.eye(columns.shape[1])
    return float(np.einsum("ki,kij,kj->k", off, np.linalg.inv(blocks), off).mean() / columns.shape[1])
