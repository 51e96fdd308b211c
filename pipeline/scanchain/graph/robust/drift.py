"""Systematic drift of odometry, its scale and turn a meter, as loop edges that agree with each other show it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.robust.left_out import LeftOut

Vector = NDArray[np.float64]

SCALE_SIGMA, TURN_SIGMA_RAD_M = 0.03, 0.01  # prior standard deviations, of the scale and of the turn a meter
FEWEST = 3  # least number of loop edges left out, none near another, that a drift must explain
_CURVATURE = 0.3  # share of a predicted change that its linearization may be off by
_ROUNDS = 5  # of the least squares over the edges that a drift explains


def size(freedom: int) -> int:
    """Entries of a drift: the scale, and the turn a meter about every axis."""
    return 2 if freedom == 3 else 4


def corrected(measurements: Matrix, drift: Vector, sign: Vector | float = 1.0) -> Matrix:
    """Motions (E, d+1, d+1) made longer by a share of themselves, drift[0], and turned by drift[1:] a meter.

    sign : (E,) −1 of a motion that is measured backward
    """
    if not drift.any():
        return measurements
    return lie.exp(_changed(lie.log(measurements), drift, sign))


def rescaled(information: Matrix, drift: Vector) -> Matrix:
    """Information (E, k, k) of corrected motions: their noise is longer by the same share.

    With the noise left as it was, a motion made shorter would fit better for its shorter noise alone.
    """
    if not drift[0]:
        return information
    scale = lie.by_component(information.shape[-1], 1.0 / (1.0 + drift[0]), 1.0)
    return information * np.outer(scale, scale)


def penalty(drift: Vector) -> float:
    """Squared Mahalanobis distance of a drift from none."""
    return float((drift**2 * _prior(len(drift))).sum())


def _prior(count: int) -> Vector:
    return np.array([SCALE_SIGMA] + (count - 1) * [TURN_SIGMA_RAD_M]) ** -2.0


def _changed(twists: Matrix, drift: Vector, sign: Vector | float) -> Matrix:
    turns = len(drift) - 1
    d = twists.shape[-1] - turns
    length_m = np.linalg.norm(twists[..., :d], axis=-1, keepdims=True) * np.asarray(sign)[..., None]
    return np.concatenate([(1.0 + drift[0]) * twists[..., :d], twists[..., d:] + length_m * drift[1:]], axis=-1)


def drift_step(left_out: LeftOut, sign: Vector, drift: Vector, price: float) -> tuple[float, Vector]:
    """The fall of the cost by a change of the drift, to first order, and this change.

    Every loop edge left out gives a candidate, refined by least squares over the edges that it explains; the one
    with the least cost Σ min(χ², price) is chosen.
    """
    odometry = left_out.odometry
    twists = lie.log(left_out.problem.measurements[odometry])
    B = np.stack([_changed(twists, unit, sign) - twists for unit in np.eye(len(drift))], axis=-1)  # ∂Z/∂drift
    d = twists.shape[1] - len(drift) + 1
    B[:, :d, 0] += left_out.errors[odometry, :d]  # the noise grows with the scale
    slope, curvature = left_out.quadratic(B)
    V = np.array([shift.sum(axis=0) for shift in left_out.shifts(B)])
    slope, curvature = slope - _prior(len(drift)) * drift, curvature + np.diag(_prior(len(drift)))
    errors, noise = left_out.errors[left_out.edges], left_out.covariances
    best, most = np.zeros(len(drift)), 0.0
    if drift.any():
        best = np.asarray(np.linalg.solve(curvature, slope), np.float64)
        most = float(slope @ best)

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

    for start in range(len(errors)):
        members = np.array([start])
        change = solved(members, np.asarray(np.linalg.inv(noise[[start]]), np.float64))
        for _ in range(_ROUNDS):
            chi2, weight = fitting(change)
            members = np.flatnonzero(chi2 < price)
            change = solved(members, weight[members])
        chi2, _ = fitting(change)
        explained = price - chi2[chi2 < price]
        gain = float(explained.sum() + 2.0 * slope @ change - change @ curvature @ change)
        if gain > most and (drift.any() or len(explained) >= FEWEST):
            best, most = change, gain
    return most, best


def _parts(k: int) -> list[int]:
    return [2, 1] if k == 3 else [3, 3]


def _squared_sizes(twists: Matrix) -> Matrix:
    """Squared lengths (E, 2) of translation and rotation."""
    d = 2 if twists.shape[1] == 3 else 3
    return np.stack([(twists[:, :d] ** 2).sum(axis=1), (twists[:, d:] ** 2).sum(axis=1)], axis=1)
