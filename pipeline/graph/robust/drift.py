"""Systematic drift of odometry, its scale and turn a meter, as loop edges that agree with each other show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.covariance import residual_covariances
from scanchain.graph.robust.groups import apart

Vector = NDArray[np.float64]

SCALE_SIGMA, TURN_SIGMA_RAD_M = 0.03, 0.01  # prior standard deviations, of the scale and of the turn a meter
_CURVATURE = 0.3  # share of a predicted change that its linearization may be off by
_MOST = 100  # largest number of contradicting loop edges that are looked at
_ROUNDS = 5  # of the least squares over the edges that a drift explains


def size(freedom: int) -> int:
    """Entries of a drift: the scale, and the turn a meter about every axis."""
    return 2 if freedom == 3 else 4


def corrected(measurements: Matrix, drift: Vector) -> Matrix:
    """Motions (E, d+1, d+1) made longer by a share of themselves, drift[0], and turned by drift[1:] a meter."""
    if not drift.any():
        return measurements
    return lie.exp(_changed(lie.log(measurements), drift))


def penalty(drift: Vector) -> float:
    """Squared Mahalanobis distance of a drift from none."""
    return float((drift**2 * _prior(len(drift))).sum())


def _prior(count: int) -> Vector:
    return np.array([SCALE_SIGMA] + (count - 1) * [TURN_SIGMA_RAD_M]) ** -2.0


def _changed(twists: Matrix, drift: Vector) -> Matrix:
    turns = len(drift) - 1
    d = twists.shape[-1] - turns
    length_m = np.linalg.norm(twists[..., :d], axis=-1, keepdims=True)
    return np.concatenate([(1.0 + drift[0]) * twists[..., :d], twists[..., d:] + length_m * drift[1:]], axis=-1)


@dataclass(frozen=True, slots=True)
class DriftStep:
    """A change of the drift, the loop edges that it would make inliers, and the fall of the cost it promises."""

    change: Vector
    explained: NDArray[np.int64]
    gain: float


def drift_step(
    problem: BetweenProblem,
    poses: Matrix,
    is_loop: NDArray[np.bool_],
    kept: NDArray[np.bool_],
    drift: Vector,
    price: float,
) -> DriftStep:
    """The change of the drift that explains most of the loop edges left out, to first order.

    With B = ∂Z/∂drift of the odometry edges, poses follow a change δ by H⁻¹ Σ JᵀΩB δ, and a loop edge's residual
    by V δ. Every edge alone gives a candidate; the one with the least cost Σ min(χ², price) is chosen and refined
    by least squares over the edges that it explains.
    """
    k, p = problem.freedom, len(drift)
    errors = problem.errors(poses)
    jacobians = problem.jacobians(poses, errors)
    sparse = problem.factored(poses, errors, kept)
    odometry = np.flatnonzero(~is_loop)
    twists = lie.log(problem.measurements[odometry])
    B = np.stack([_changed(twists, unit) - twists for unit in np.eye(p)], axis=-1)  # (O, k, p)
    omega_B = problem.information[odometry] @ B
    pull = np.swapaxes(jacobians[odometry], 1, 2) @ omega_B
    whole = np.zeros((len(problem.variable), k, p))
    i, j = problem.edges[odometry].T
    np.add.at(whole, j, pull)
    np.add.at(whole, i, -pull)
    flat = sparse.packing.rows(whole[problem.free])
    moved = np.stack([sparse.cholesky.solve(np.ascontiguousarray(column)) for column in flat.T], axis=1)
    curvature = np.einsum("eap,eaq->pq", B, omega_B) - flat.T @ moved + np.diag(_prior(p))
    slope = np.einsum("eap,ea->p", omega_B, errors[odometry]) - _prior(p) * drift
    response = np.zeros((len(problem.variable), k, p))
    response[problem.free] = sparse.packing.spread_rows(moved)
    out = apart(problem.edges, np.flatnonzero(is_loop & ~kept))
    out = out[:: max(1, -(-len(out) // _MOST))]
    i, j = problem.edges[out].T
    V = jacobians[out] @ (response[j] - response[i])
    noise = residual_covariances(problem, sparse, jacobians, out)
    return _consensus(errors[out], V, noise, curvature, slope, out, price)


def _consensus(
    errors: Matrix,
    V: Matrix,
    noise: Matrix,
    curvature: Matrix,
    slope: Vector,
    edges: NDArray[np.int64],
    price: float,
) -> DriftStep:
    """Best change of the drift, of those that single edges ask for."""
    own = np.asarray(np.linalg.solve(curvature, slope), np.float64)
    best, most = DriftStep(own, edges[:0], 0.0), float(slope @ own)

    def solved(members: NDArray[np.int64], weight: Matrix) -> Vector:
        A = curvature + np.einsum("eap,eab,ebq->pq", V[members], weight, V[members])
        return np.asarray(
            np.linalg.solve(A, slope - np.einsum("eap,eab,eb->p", V[members], weight, errors[members])), np.float64
        )

    def fitting(change: Vector) -> tuple[Vector, Matrix]:
        size_2 = np.repeat(_squared_sizes(V @ change), _parts(errors.shape[1]), axis=1)
        spread = _CURVATURE**2 * size_2[:, :, None] * np.eye(errors.shape[1])
        weight = np.asarray(np.linalg.inv(noise + spread), np.float64)
        left = errors + V @ change
        return np.einsum("ea,eab,eb->e", left, weight, left), weight

    for start in range(len(edges)):
        members = np.array([start])
        change = solved(members, np.asarray(np.linalg.inv(noise[[start]]), np.float64))
        for _ in range(_ROUNDS):
            chi2, weight = fitting(change)
            members = np.flatnonzero(chi2 < price)
            change = solved(members, weight[members])
        chi2, _ = fitting(change)
        gain = float((price - chi2[chi2 < price]).sum() + 2.0 * slope @ change - change @ curvature @ change)
        if gain > most:
            best, most = DriftStep(change, edges[chi2 < price], gain), gain
    return best


def _parts(k: int) -> list[int]:
    return [2, 1] if k == 3 else [3, 3]


def _squared_sizes(twists: Matrix) -> Matrix:
    """Squared lengths (E, 2) of translation and rotation."""
    d = 2 if twists.shape[1] == 3 else 3
    return np.stack([(twists[:, :d] ** 2).sum(axis=1), (twists[:, d:] ** 2).sum(axis=1)], axis=1)
