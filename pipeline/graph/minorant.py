"""Lower bounds of a graph's χ², edge by edge: quadratic in rotations and positions, exact at the estimate.

Why each bound holds. Write Δ = φ − φ* for the change of an edge's rotational residual, δ for the angle between the
two rotations and P = n sin δ, n its axis. Let τ, κ be such that diag(τ I, κ I) ⪯ Ω; y = Ω e*. Then
    eᵀΩe ≥ e*ᵀΩe* + 2 yᵀ(e − e*) + τ‖ρ − ρ*‖² + κ‖Δ‖².
Translation: z = V(φ)(ρ − ρ*) is no longer than ρ − ρ*, and differs from the change u of the relative position by
(V(φ) − V(φ*))ρ*, at most ½‖ρ*‖‖Δ‖; the linear term changes with V⁻¹, whose slope is at most 0.9311 up to θ = π.
Rotation: κ‖φ‖² ≥ κ‖φ*‖² + 2κ φ*ᵀP + κ (2 − 0.72 θ*²)(1 − cos δ) for θ* ≤ 1; any other linear term changes from Δ
to P at a cost of ½‖·‖‖Δ‖². Every cost is paid from τ or from κ, by 2xy ≤ ε x² + y²/ε.

An edge that cannot pay, as one whose Ω is singular, borrows: its τ or κ becomes negative, and the sum over all
edges shows whether the others make up for it. For these it takes bounds from above as well, ‖ρ − ρ*‖ ≤ ½π‖z‖ and
‖Δ‖² ≤ ((π + θ*) / (2 cos ½θ*))² 2(1 − cos δ).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem

_SLOPE = 0.9311  # of V(φ)⁻¹, at most, for rotations up to π: (π²/16 + 1/4)^½
_BEND = 0.72  # loss of curvature of κ‖φ‖² at an angle θ*, in θ*², up to 1 rad
_FARTHEST = 1.0  # θ*, rad, up to which edges are bounded
_STRETCH = 0.25 * np.pi**2  # ‖ρ − ρ*‖² over ‖z‖², at most
_ROUNDING = 1e-9  # by which the isotropic information is kept below the smallest eigenvalue
_NOTHING = 1e-30  # in place of no information at all, so that nothing is divided by zero
_SHARES = (1.0, 2.0, 4.0)  # of what is paid from τ, tried one after the other


@dataclass(frozen=True, slots=True)
class Minorants:
    """Per edge, χ² ≥ χ²* + τ‖t_j − t_i − G_i l‖² + fᵀ(G_iᵀ(t_j − t_i) − l) + κ tr(I − G_iᵀG_j) + ½⟨[g]×, G_iᵀG_j⟩.

    G_i is the rotation of pose i against its estimate, G_i = R_i R_i*ᵀ, t_i its position, both in the world.

    Attributes
    ----------
    leap : (E, d) l, from pose i to pose j at the estimate, m
    force : (E, d) f, slope of χ² with the position of j
    torque : (E, d, d) [g]×, slope of χ² with the rotation of j, its position held
    tau : (E,) m⁻², negative where borrowed
    kappa : (E,) rad⁻², negative where borrowed; NaN where the edge is too far from its measurement for any bound
    """

    leap: Matrix
    force: Matrix
    torque: Matrix
    tau: NDArray[np.float64]
    kappa: NDArray[np.float64]


def minorize(problem: BetweenProblem, poses: Matrix, weights: NDArray[np.float64]) -> Minorants:
    """Bounds that touch the χ² of every edge, times its weight (E,), at these poses."""
    d = poses.shape[-1] - 1
    i, j = problem.edges.T
    errors = problem.errors(poses)
    information = weights[:, None, None] * problem.information
    pull = (information @ errors[..., None])[..., 0]
    slope = 2.0 * (np.swapaxes(problem.jacobians(poses, errors), 1, 2) @ pull[..., None])[..., 0]
    force = slope[:, :d]
    torque = slope[:, d:] - _moment(poses[j, :d, d], force)
    turned = errors[:, d:] if d == 2 else (poses[j, :3, :3] @ errors[:, 3:, None])[..., 0]
    tau, kappa = _isotropic(information, d)
    seen = problem.sightings  # of points: quadratic in the position of the point, and nothing else
    of_seen = np.linalg.eigvalsh(information[seen, :d, :d])[:, 0]
    tau[seen], kappa[seen] = np.maximum(of_seen, _NOTHING), _NOTHING
    excess = _length(torque - 2.0 * kappa[:, None] * turned)
    costs = _Costs(tau, kappa, _length(errors[:, :d]), _length(errors[:, d:]), _length(pull[:, :d]))
    tau, kappa = costs.paid(0.5 * _length(force), excess)
    short = np.setdiff1d(np.flatnonzero(~(kappa > 0.0) & (costs.theta < _FARTHEST)), seen)
    if len(short):
        parts = (information, errors, pull, force, torque, turned)
        tau[short], kappa[short] = _borrowed(*(part[short] for part in parts))
    kappa[costs.theta >= _FARTHEST] = np.nan
    tau[seen], kappa[seen] = of_seen, 0.0
    return Minorants(poses[j, :d, d] - poses[i, :d, d], force, _cross_matrix(torque), tau, kappa)


@dataclass(frozen=True, slots=True)
class _Costs:
    """What the bounds of the edges cost: isotropic information, residuals ‖ρ*‖ and θ*, and ‖y_t‖; each (E,)."""

    tau: NDArray[np.float64]
    kappa: NDArray[np.float64]
    rho: NDArray[np.float64]
    theta: NDArray[np.float64]
    pull: NDArray[np.float64]

    def paid(
        self, force: NDArray[np.float64], excess: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What is left of τ and κ; ``force`` is ‖V⁻ᵀy_t‖, ``excess`` the rotational slope beside 2κφ*."""
        best_tau, best_kappa = self._left(_SHARES[0], force, excess)
        for share in _SHARES[1:]:
            tau, kappa = self._left(share, force, excess)
            better = np.minimum(tau / self.tau, kappa / self.kappa) > np.minimum(
                best_tau / self.tau, best_kappa / self.kappa
            )
            best_tau, best_kappa = np.where(better, tau, best_tau), np.where(better, kappa, best_kappa)
        return best_tau, best_kappa

    def _left(
        self, share: float, force: NDArray[np.float64], excess: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        root = np.sqrt(self.tau * self.kappa)
        bent = share * 0.5 * self.rho * np.sqrt(self.tau / self.kappa) + 1e-12
        turned = np.minimum(share * _SLOPE * self.pull / root + 1e-12, 0.5)
        tau = self.tau * (1.0 - turned) / (1.0 + bent)
        cost = 0.25 * tau * (1.0 + 1.0 / bent) * self.rho**2 + (_SLOPE * self.pull) ** 2 / (turned * self.tau)
        cost += force * self.rho / 3.0 + 0.5 * excess
        kappa = self.kappa - cost / np.maximum(1.0 - self.theta, 1e-12)
        return tau, np.where(self.theta < 1.0, (1.0 - 0.5 * _BEND * self.theta**2) * kappa, -1.0)


def _borrowed(
    information: Matrix, errors: Matrix, pull: Matrix, force: Matrix, torque: Matrix, turned: Matrix
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """τ and κ, (E,), of edges that cannot pay for their bounds, negative as far as they borrow."""
    d = force.shape[1]
    rho, theta = _length(errors[:, :d]), _length(errors[:, d:])
    tau, kappa, tau_mean, kappa_mean = _isotropic_of_singular(information, d)
    rate = np.sqrt(tau_mean / kappa_mean)
    slope = _SLOPE * _length(pull[:, :d])
    loan = slope * rate + _NOTHING
    left = tau - loan
    bent = np.clip(0.5 * rho * rate, 1e-12, 1.0)
    has = left >= 0.0
    tau = left * np.where(has, 1.0 / (1.0 + bent), _STRETCH * (1.0 + bent))
    cost = 0.25 * rho**2 * left * np.where(has, 1.0, -_STRETCH * (1.0 + bent)) / bent
    cost += slope**2 / loan + 0.5 * _length(force) * rho / 3.0
    cost += 0.5 * _length(torque - 2.0 * np.maximum(kappa, 0.0)[:, None] * turned) + np.maximum(-kappa, 0.0)
    kappa = np.maximum(kappa, 0.0) - cost / (1.0 - theta)
    far = (0.5 * (np.pi + theta) / np.cos(0.5 * theta)) ** 2
    return tau, kappa * np.where(kappa > 0.0, 1.0 - 0.5 * _BEND * theta**2, (1.0 - theta) * far)


def _isotropic_of_singular(information: Matrix, d: int) -> tuple[NDArray[np.float64], ...]:
    """τ and κ, (E,), with diag(τ I, κ I) ⪯ Ω, one of them negative if need be; mean eigenvalues of both blocks."""
    k = information.shape[-1]
    translation, coupling, rotation = information[:, :d, :d], information[:, :d, d:], information[:, d:, d:]
    tau_mean = np.maximum(np.trace(translation, axis1=1, axis2=2) / d, _NOTHING)
    kappa_mean = np.maximum(np.trace(rotation, axis1=1, axis2=2) / (k - d), _NOTHING)
    least = np.linalg.eigvalsh(rotation)[:, 0]
    half = np.where(least > 1e-6 * kappa_mean, 0.5 * least, -1e-3 * kappa_mean)
    is_coupled = coupling.any(axis=(1, 2))
    kappa = np.where(is_coupled, half, least - _ROUNDING * kappa_mean)
    rest = rotation - np.where(is_coupled, kappa, -1.0)[:, None, None] * np.eye(k - d)
    schur = translation - coupling @ np.linalg.solve(rest, np.swapaxes(coupling, 1, 2))
    tau = np.linalg.eigvalsh(0.5 * (schur + np.swapaxes(schur, 1, 2)))[:, 0] - _ROUNDING * tau_mean
    return tau, kappa, tau_mean, kappa_mean


def _isotropic(information: Matrix, d: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """τ and κ, (E,), with diag(τ I, κ I) ⪯ Ω: the smallest eigenvalues, lowered as far as the coupling asks."""
    tau = np.linalg.eigvalsh(information[:, :d, :d])[:, 0]
    kappa = np.linalg.eigvalsh(information[:, d:, d:])[:, 0]
    k = information.shape[-1]
    scale = np.maximum(np.repeat(np.stack([tau, kappa], axis=1), (d, k - d), axis=1), _NOTHING) ** -0.5
    least = np.linalg.eigvalsh(scale[:, :, None] * information * scale[:, None, :])[:, 0]
    least = np.clip(least, 1e-12, 1.0) * (1.0 - _ROUNDING)
    return (least * np.maximum(tau, _NOTHING)).astype(np.float64), (least * np.maximum(kappa, _NOTHING)).astype(
        np.float64
    )


def _length(vectors: Matrix) -> NDArray[np.float64]:
    return np.sqrt((vectors * vectors).sum(axis=-1))


def _moment(arm: Matrix, force: Matrix) -> Matrix:
    """Moments (E, 1 or 3) of forces (E, d)."""
    if arm.shape[1] == 3:
        return np.cross(arm, force)
    return (arm[:, :1] * force[:, 1:] - arm[:, 1:] * force[:, :1]).astype(np.float64, copy=False)


def _cross_matrix(torque: Matrix) -> Matrix:
    """[g]× (E, d, d) of torques (E, 1 or 3)."""
    if torque.shape[1] == 3:
        return lie.hat(torque)
    return torque[:, :, None] * np.array([[0.0, -1.0], [1.0, 0.0]])
