"""Certificate that a minimum of a pose graph is global: a lower bound of χ² by Lagrangian duality."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np

from scanchain import lie
from scanchain.clock import working_s
from scanchain.data import Mask, Matrix, Vector
from scanchain.errors import counted
from scanchain.graph.edge_checks import is_connected
from scanchain.graph.factors import turns
from scanchain.graph.problem import GraphProblem
from scanchain.graph.relaxation import Relaxation

_ZERO_CHI2 = 1e-9  # share of the largest information, or of 1 if that is less, up to which χ² is rounding noise
_EXACT = 1e-12  # share of χ² that rounding alone may amount to
_LARGEST_GAP = 0.01  # share of χ², of a certificate
_SLOPE = 0.9311  # largest slope of V(φ)⁻¹ for rotations up to π: (π²/16 + 1/4)^½
_BEND = 0.72  # loss of curvature of κ‖φ‖² at an angle θ*, as a factor of θ*², up to 1 rad
_FARTHEST = 1.0  # largest θ*, rad, of an edge whose bound touches
_ROUNDING = 1e-9  # share by which the isotropic information stays below the smallest eigenvalue
_TINY = 1e-30  # replaces zero information, to avoid a division by zero
_PAID_FROM_TAU = 2.0  # factor on the part of the cost that is taken from τ: a larger one leaves more of κ


@dataclass(frozen=True, slots=True)
class Certificate:
    """Bound of the distance to the global minimum.

    certified : whether no poses have a χ² lower than this one by more than ``gap``, and that is at most 1 %
    gap : χ² minus its lower bound, 0 or more; χ² itself where no bound is known
    chi2 : Σ w eᵀΩe that was certified
    reason : why there is no certificate; empty where there is one
    time_s : wall time
    is_zero : whether χ² is zero up to rounding
    left_out : constraints that are not part of χ², as text; empty where there are none
    relaxed : (K, d+1, d+1) poses near the minimum of the relaxation, an initial guess that may lead to a lower χ²;
        None where the estimate is the relaxation's minimum itself, or where that is unknown
    """

    certified: bool
    gap: float
    chi2: float
    reason: str
    time_s: float
    is_zero: bool = False
    left_out: str = ""
    relaxed: Matrix | None = field(default=None, repr=False)

    @property
    def relative_gap(self) -> float:
        """The gap as a share of χ², 0 to 1; 0 where χ² is zero."""
        return 0.0 if self.is_zero else self.gap / self.chi2

    @property
    def lower_bound(self) -> float:
        """No poses have a χ² below this."""
        return self.chi2 - self.gap

    @property
    def verdict(self) -> str:
        """The certificate as one line of text."""
        without = f" of the problem without {self.left_out}," if self.left_out else ""
        if self.certified and self.is_zero:
            return f"globally optimal{without or ':'} χ² is zero"
        if self.certified:
            if self.relative_gap < _EXACT:
                return f"globally optimal{without} to rounding"
            share = f"{self.gap:.2g} of χ² ({100.0 * self.relative_gap:.1g} %)"
            return f"globally optimal{without} to within {share}"
        return f"not certified: {self.reason}"


def certify(problem: GraphProblem, poses: Matrix, weights: Vector, undetermined: str) -> Certificate:
    """Certificate by a lower bound of the global minimum of Σ w eᵀΩe, for fixed weights w (E,) and any Ω.

    Every edge's χ² is replaced by a quadratic function of rotations and positions that is nowhere above it
    (``minorize``). The Lagrangian dual of that problem (Carlone et al. 2015; Rosen et al. 2019, theorem 1) bounds
    it in turn: if S, with the gauge fixed, is positive definite, then for all poses
        χ² ≥ q* − tr(rᵀ S⁻¹ r),   r = S X*,
    with q* the sum of the functions at these poses, and r zero where X* is their minimum. Functions that touch
    χ², q* = χ²*, are tried first. Where S is indefinite, the minimum of the semidefinite relaxation is searched
    (``Relaxation``), whose dual bounds χ² as far as possible. Edges of unknown factors, and those without
    information in some direction, are bounded by zero. Poses that are ``undetermined``, as text, preclude a
    certificate.
    """
    begin = working_s()
    kept = weights > 0.0
    if not kept.all():
        problem, weights = problem.restricted(kept), weights[kept]
    chi2 = float((weights * problem.chi2(problem.errors(poses))).sum())
    is_zero = chi2 <= _ZERO_CHI2 * min(float(problem.information.max(initial=0.0)), 1.0)
    gap, reason, relaxed = chi2, undetermined, None
    if not undetermined and not is_zero:
        gap, relaxed = _gap(problem, poses, weights, chi2)
        if gap > _LARGEST_GAP * chi2:
            reason = "no lower bound of χ² but zero is known"
            if gap < chi2:
                reason = f"other poses may have a χ² lower by up to {gap:.3g} ({100.0 * gap / chi2:.2g} %)"
            unknown = problem.kind[~problem.is_bounded]
            if len(unknown):
                names = sorted({problem.factors[kind].name for kind in unknown.tolist()})
                reason += f"; bounded by zero: {counted(len(unknown), 'edge')} of {' and '.join(names)}"
    return Certificate(not reason, gap, chi2, reason, working_s() - begin, is_zero, relaxed=relaxed)


def _gap(problem: GraphProblem, poses: Matrix, weights: Vector, chi2: float) -> tuple[float, Matrix | None]:
    """χ² minus its lower bound, at most χ²; and the poses that the relaxation suggests."""
    center = poses[:, :-1, -1].mean(axis=0)
    centered = poses.copy()
    centered[:, :-1, -1] -= center
    gap, relaxed, free = chi2, None, problem.free
    for touching in (True, False):
        minorants = minorize(problem, centered, weights, touching=touching)
        kept = problem.is_bounded & ~np.isnan(minorants.tau)
        if not is_connected(problem.edges[kept], problem.variable < 0):
            continue
        relaxation = Relaxation(problem, *dual_matrix(problem, minorants, kept), centered[free, :-1, -1], chi2)
        bound = relaxation.dual(relaxation.estimate)
        lost = chi2 - float(minorants.value[kept].sum())
        if not touching and not bound.is_minimum:
            X, bound = relaxation.minimize(relaxation.estimate, bound)
            G, positions = relaxation.rounded(X)
            relaxed = poses.copy()
            relaxed[free, :-1, :-1], relaxed[free, :-1, -1] = G @ poses[free, :-1, :-1], positions + center
        gap = min(gap, max(lost - bound.value, 0.0))
        if gap <= _LARGEST_GAP * chi2:
            break
    return gap, relaxed


def dual_matrix(problem: GraphProblem, bound: Minorants, kept: Mask) -> tuple[Matrix, Matrix]:
    """S = Q − Λ of the bounds of the edges kept (E,), as blocks of the problem's pattern, and S X* (n, d+1, d).

    Unknowns are G_i, the rotation of pose i relative to its estimate, in the world frame, and t_i, its position;
    at the estimate X* every G is I. An edge contributes
        q = τ‖t_j − t_i − G_i l‖² + fᵀG_iᵀ(t_j − t_i) − ⟨M, G_iᵀG_j⟩
    and, by the multiplier Λ_i of G_iᵀG_i = I that makes X* stationary, ½ sym(M − f lᵀ) at G_i and ½ sym(M) at G_j
    (Carlone et al. 2015, eq. 26; Rosen et al. 2019, eq. 22). A row of S belongs to one row of each G and of t.
    """
    parts = (bound.leap, bound.force, bound.coupling, bound.tau)
    leap, force, M, tau = (np.where(kept.reshape(-1, *(x.ndim - 1) * [1]), x, 0.0) for x in parts)
    d = leap.shape[1]
    R, t = slice(0, d), d
    of_i, of_j, coupling = (np.zeros((len(kept), d + 1, d + 1)) for _ in range(3))
    bent, tau_leap = force[:, :, None] * leap[:, None], tau[:, None] * leap
    even = 0.25 * (M + np.swapaxes(M, 1, 2))
    of_i[:, R, R] = tau_leap[:, :, None] * leap[:, None] - 0.25 * (bent + np.swapaxes(bent, 1, 2)) + even
    of_i[:, R, t] = of_i[:, t, R] = tau_leap - 0.5 * force
    of_j[:, R, R] = even
    of_i[:, t, t] = of_j[:, t, t] = tau
    coupling[:, R, R], coupling[:, R, t], coupling[:, t, t] = -0.5 * M, 0.5 * force - tau_leap, -tau
    residual = np.zeros((len(problem.free) + 1, d + 1, d))  # the last one is for the fixed poses
    i, j, _ = problem.slots.T
    np.add.at(residual[:, R], i, 0.25 * (bent - np.swapaxes(bent, 1, 2)) - (0.5 * M - even))
    np.add.at(residual[:, R], j, 0.5 * M - even)
    np.add.at(residual[:, t], i, -0.5 * force)
    np.add.at(residual[:, t], j, 0.5 * force)
    return problem.scattered(of_i, of_j, coupling), residual[:-1]


@dataclass(frozen=True, slots=True)
class Minorants:
    """Per edge, χ² ≥ v + τ‖t_j − t_i − G_i l‖² + fᵀ(G_iᵀ(t_j − t_i) − l) + ⟨M, I − G_iᵀG_j⟩.

    G_i is the rotation of pose i relative to its estimate, G_i = R_i R_i*ᵀ, t_i its position, both in the world.

    value : (E,) v, the bound at the estimate; χ²* where it touches
    leap : (E, d) l, from pose i to pose j at the estimate, m
    force : (E, d) f, slope of the bound with the position of j
    coupling : (E, d, d) M, rad⁻²; its antisymmetric part is the slope with the rotation of j at a fixed position
    tau : (E,) m⁻²; NaN for an edge too far from its measurement, or with too little information, for any bound
    """

    value: Vector
    leap: Matrix
    force: Matrix
    coupling: Matrix
    tau: Vector


def minorize(problem: GraphProblem, poses: Matrix, weights: Vector, *, touching: bool) -> Minorants:
    """Bounds of the χ² of every edge, times its weight (E,).

    With p and φ the errors of position and rotation, e = (V(φ)⁻¹p, φ), they rest on ‖V⁻¹p‖ ≥ ‖p‖, and on
    diag(τI, K) ⪯ Ω. What Ω has above that, or all of χ² where the bounds shall touch it, is replaced by its
    tangent, of which a share may be used. Its curvature is paid from τ and from the smallest eigenvalue κ of K.
    """
    d = poses.shape[-1] - 1
    i, j = problem.edges.T
    errors, norm = problem.errors(poses), partial(np.linalg.norm, axis=-1)
    rho, theta = norm(errors[:, :d]), norm(errors[:, d:])
    information, seen = weights[:, None, None] * problem.information, ~problem.is_whole
    tau, K = _separated(information, d)
    tau[seen], K[seen] = np.linalg.eigvalsh(information[seen, :d, :d])[:, 0], 0.0
    kappa = np.where(theta < _FARTHEST, np.linalg.eigvalsh(K)[:, 0], 0.0)
    if not touching:
        information[:, :d, :d] -= tau[:, None, None] * np.eye(d)
        information[:, d:, d:] -= K
    pull = (information @ errors[..., None])[..., 0]  # y
    slope = 2.0 * (np.swapaxes(problem.jacobians(poses, errors), 1, 2) @ pull[..., None])[..., 0]
    force, leap = slope[:, :d], poses[j, :d, d] - poses[i, :d, d]
    torque = slope[:, d:] - (force[:, None] @ turns(poses[j, :d, d]))[:, 0]
    turned = 2.0 * kappa[:, None] * (errors[:, d:] if d == 2 else (poses[j, :3, :3] @ errors[:, 3:, None])[..., 0])
    stiff_tau, stiff_kappa = np.maximum(tau, _TINY), np.maximum(kappa, _TINY)
    slide = _SLOPE * norm(pull[:, :d])
    paid = np.minimum(_PAID_FROM_TAU * slide / np.sqrt(stiff_tau * stiff_kappa) + 1e-12, 0.5)
    left = tau * (1.0 - paid)
    cost = slide**2 / (paid * stiff_tau) + norm(force) * rho / 6.0 + 0.5 * norm(torque - touching * turned)
    if touching:
        bent = _PAID_FROM_TAU * 0.5 * rho * np.sqrt(stiff_tau / stiff_kappa) + 1e-12
        left /= 1.0 + bent
        cost += 0.25 * left * (1.0 + 1.0 / bent) * rho**2
    cost /= np.maximum(1.0 - theta, 1e-12)
    used = np.ones_like(tau) if touching else np.minimum(0.5 * kappa / np.maximum(cost, _TINY), 1.0)
    left, rigid = np.where(used > 0.0, left, tau), kappa - used * cost
    left[touching & ~(rigid > 0.0)] = np.nan
    left[seen], used[seen], rigid[seen] = tau[seen], 1.0, 0.0  # quadratic in the position of j
    coupling = ((1.0 - 0.5 * _BEND * theta**2) * rigid)[:, None, None] * np.eye(d)
    value = used * (2.0 - used) * (pull * errors).sum(axis=1)
    force, torque = used[:, None] * force, used[:, None] * torque
    if not touching:
        K -= kappa[:, None, None] * np.eye(K.shape[1])
        more, of_position, of_rotation = _chordal(problem, poses, tau, K)
        value, force, torque = value + more + kappa * theta**2, force + of_position, torque + turned
        coupling += of_rotation
    crossed = lie.hat(torque) if d == 3 else torque[:, :, None] * np.array([[0.0, -1.0], [1.0, 0.0]])
    return Minorants(value, leap, force, coupling - 0.5 * crossed, left)


def _chordal(problem: GraphProblem, poses: Matrix, tau: Vector, K: Matrix) -> tuple[Vector, Matrix, Matrix]:
    """Value (E,), force and coupling of τ‖p‖² + ⟨M, I − exp φ⟩, M = tr(K) I − 2K or K I in 2D, below φᵀKφ."""
    d = poses.shape[-1] - 1
    i, j = problem.edges.T
    measured = poses[i] @ problem.measurements
    off = poses[j, :d, d] - measured[:, :d, d]
    M = K * np.eye(d) if d == 2 else np.trace(K, axis1=1, axis2=2)[:, None, None] * np.eye(d) - 2.0 * K
    turned = np.swapaxes(measured[:, :d, :d], 1, 2) @ poses[j, :d, :d]
    value = tau * (off**2).sum(axis=1) + (M * (np.eye(d) - turned)).sum(axis=(1, 2))
    return value, 2.0 * tau[:, None] * off, measured[:, :d, :d] @ M @ np.swapaxes(poses[j, :d, :d], 1, 2)


def _separated(information: Matrix, d: int) -> tuple[Vector, Matrix]:
    """τ (E,) and K (E, k − d, k − d) with diag(τI, K) ⪯ Ω: eigenvalue and block of Ω, lowered for the coupling."""
    tau = np.maximum(np.linalg.eigvalsh(information[:, :d, :d])[:, 0], _TINY)
    values, axes = np.linalg.eigh(information[:, d:, d:])
    root = np.zeros_like(information)
    root[:, :d, :d] = tau[:, None, None] ** -0.5 * np.eye(d)
    root[:, d:, d:] = np.maximum(values, _TINY)[:, None] ** -0.5 * axes
    least = np.linalg.eigvalsh(np.swapaxes(root, 1, 2) @ information @ root)[:, 0]
    share = np.asarray(np.clip(least, 1e-12, 1.0) * (1.0 - _ROUNDING), np.float64)
    return share * np.asarray(tau, np.float64), share[:, None, None] * information[:, d:, d:]
