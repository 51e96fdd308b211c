"""Certificate that a minimum of a pose graph is global: a lower bound of χ² by Lagrangian duality."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from scanchain import lie
from scanchain.clock import working_s
from scanchain.data import Integers, Mask, Matrix, Vector
from scanchain.errors import counted
from scanchain.graph.cholesky import BlockPattern, Packing, SingularMatrixError, SparseCholesky
from scanchain.graph.edge_checks import first_of_unjoined, is_connected
from scanchain.graph.factors import turns
from scanchain.graph.problem import GraphProblem

_ZERO_CHI2 = 1e-9  # share of the largest information, or of 1 if that is less, up to which χ² is rounding noise
_EXACT = 1e-12  # share of χ² that rounding alone may amount to
_LOWERED = (0.0, 1e-6, 1e-4, 1e-2)  # shares of χ² by which the bound is lowered, tried one after the other
_SLOPE = 0.9311  # largest norm of V(φ)⁻¹ for rotations up to π: (π²/16 + 1/4)^½
_BEND = 0.72  # loss of curvature of κ‖φ‖² at an angle θ*, as a factor of θ*², up to 1 rad
_FARTHEST = 1.0  # largest θ*, rad, of an edge that is bounded
_ROUNDING = 1e-9  # share by which the isotropic information stays below the smallest eigenvalue
_TINY = 1e-30  # replaces zero information, to avoid a division by zero
_PAID_FROM_TAU = 2.0  # factor on the part of the cost that is taken from τ: a larger one leaves more of κ


@dataclass(frozen=True, slots=True)
class Certificate:
    """Bound of the distance to the global minimum.

    certified : whether no poses have a χ² lower than this one by more than ``gap``
    gap : χ² minus its lower bound, 0 or more; χ² itself where no bound is known
    chi2 : Σ w eᵀΩe that was certified
    reason : why there is no certificate; empty where there is one
    time_s : wall time
    is_zero : whether χ² is zero up to rounding
    left_out : constraints that are not part of χ², as text; empty where there are none
    """

    certified: bool
    gap: float
    chi2: float
    reason: str
    time_s: float
    is_zero: bool = False
    left_out: str = ""

    @property
    def relative_gap(self) -> float:
        """The gap as a share of χ², 0 to 1; 0 where χ² is zero."""
        return 0.0 if self.is_zero else self.gap / self.chi2

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


def certify(
    problem: GraphProblem, poses: Matrix, weights: Vector, undetermined: str, names: Integers
) -> Certificate:
    """Certificate by a lower bound of the global minimum of Σ w eᵀΩe, for fixed weights w (E,) and any Ω.

    Every edge's χ² is replaced by a quadratic function of rotations and positions that is nowhere above it and
    touches it at these poses (``minorize``). The Lagrangian dual of that problem (Carlone et al. 2015; Rosen et
    al. 2019, theorem 1) bounds it in turn: if S, with the gauge fixed, is positive definite, then for all poses
        χ² ≥ χ²* − tr(rᵀ S⁻¹ r),   r = S X*, which vanishes where X* is a minimum to machine precision.
    Where S is not, μ I is added to its rotation blocks, which lowers the bound. Positive definite means that the
    Cholesky factorization succeeds, so the claim holds up to its rounding. Edges too far from their measurements
    for such a function, or without information in some direction, are bounded by zero if their χ² is a small
    share: it is then part of the gap. Poses that are ``undetermined``, as text, preclude a certificate.
    ``names`` (K,) are the names of the poses in messages, without the origin, the last vertex of some problems.
    """
    begin = working_s()
    kept = weights > 0.0
    if not kept.all():
        problem, weights = problem.restricted(kept), weights[kept]
    of_edges = weights * problem.chi2(problem.errors(poses))
    chi2 = float(of_edges.sum())
    is_zero = chi2 <= _ZERO_CHI2 * min(float(problem.information.max(initial=0.0)), 1.0)
    gap, reason = chi2, undetermined
    if not undetermined and not is_zero:
        gap, reason = _gap(problem, poses, weights, of_edges, names)
    return Certificate(not reason, gap, chi2, reason, working_s() - begin, is_zero)


def _gap(
    problem: GraphProblem, poses: Matrix, weights: Vector, of_edges: Vector, names: Integers
) -> tuple[float, str]:
    """χ² minus its lower bound; without a bound, all of χ² and the reason. ``of_edges`` (E,) sum to χ²."""
    chi2, n, d = float(of_edges.sum()), len(problem.free), poses.shape[-1] - 1
    unknown = ~problem.is_bounded
    if unknown.any():
        what = sorted({problem.factors[kind].name for kind in problem.kind[unknown].tolist()})
        return chi2, f"there is no bound for {counted(int(unknown.sum()), 'edge')} of {' and '.join(what)}"
    fixed = np.unique(problem.edges[problem.variable[problem.edges] < 0])
    parts = np.isin(first_of_unjoined(problem.edges, np.zeros(len(poses), np.bool_)), problem.edges)
    if len(fixed) > parts.sum():  # one in each part of the graph is only its gauge
        held = counted(int((fixed < len(names)).sum()), "pose")
        what = f"the origin and {held}" if fixed[-1] == len(names) else held
        return chi2, f"{what} are fixed; the bound is for one"
    centered = poses.copy()
    centered[:, :-1, -1] -= centered[:, :-1, -1].mean(axis=0)
    minorants = minorize(problem, centered, weights)
    loose = np.isnan(minorants.kappa)
    unbounded = float(of_edges[loose].sum())
    is_apart = not is_connected(problem.edges[~loose], problem.variable < 0)
    if loose.any() and (unbounded > _LOWERED[-1] * chi2 or is_apart):
        i, j = problem.edges[loose][0]
        first = f"{names[i]}-{names[j]}" if i < len(names) else f"the prior of {names[j]}"
        far = f"{counted(int(loose.sum()), 'edge')} too far from what was measured, or too little informative"
        return chi2, f"{far}, to be bounded, first {first}"
    blocks, residual = dual_matrix(problem, minorants, ~loose)
    pattern = BlockPattern(np.where(problem.is_point[problem.free], 1, d + 1), problem.pattern.pairs)
    packing = Packing(pattern, d + 1, at_end=True)
    factor = SparseCholesky(pattern, problem.cholesky.analysis)
    rotation = np.diag([1.0] * d + [0.0])
    for share in _LOWERED:
        shift = share * chi2 / (d * max(n, 1))
        shifted = blocks.copy()
        shifted[:n] += shift * rotation
        try:
            factor.factorize(packing.values(shifted))
        except SingularMatrixError:
            continue
        right = packing.packed(residual + shift * rotation[:, :d])
        return min(float((right * factor.solve(right)).sum()) + unbounded, chi2), ""
    return chi2, "the dual matrix is not positive definite, as at a local minimum"


def dual_matrix(problem: GraphProblem, bound: Minorants, kept: Mask) -> tuple[Matrix, Matrix]:
    """S = Q − Λ of the bounds of the edges kept (E,), as blocks of the problem's pattern, and S X* (n, d+1, d).

    Unknowns are G_i, the rotation of pose i relative to its estimate, in the world frame, and t_i, its position;
    at the estimate X* every G is I. An edge contributes
        q = τ‖t_j − t_i − G_i l‖² + fᵀG_iᵀ(t_j − t_i) + ½ κ‖G_i − G_j‖² + ½ ⟨[g]×, G_iᵀG_j⟩
    and, by the multiplier Λ_i of G_iᵀG_i = I that makes X* stationary, −½ sym(f lᵀ) at G_i
    (Carlone et al. 2015, eq. 26; Rosen et al. 2019, eq. 22). A row of S belongs to one row of each G and of t.
    """
    parts = (bound.leap, bound.force, bound.torque, bound.tau, bound.kappa)
    leap, force, torque, tau, kappa = (np.where(kept.reshape(-1, *(x.ndim - 1) * [1]), x, 0.0) for x in parts)
    d = leap.shape[1]
    R, t = slice(0, d), d
    of_i, of_j, coupling = (np.zeros((len(kept), d + 1, d + 1)) for _ in range(3))
    bent, tau_leap = force[:, :, None] * leap[:, None], tau[:, None] * leap
    even = 0.5 * kappa[:, None, None] * np.eye(d)
    of_i[:, R, R] = tau_leap[:, :, None] * leap[:, None] - 0.25 * (bent + np.swapaxes(bent, 1, 2)) + even
    of_i[:, R, t] = of_i[:, t, R] = tau_leap - 0.5 * force
    of_j[:, R, R] = even
    of_i[:, t, t] = of_j[:, t, t] = tau
    coupling[:, R, R], coupling[:, R, t], coupling[:, t, t] = 0.25 * torque - even, 0.5 * force - tau_leap, -tau
    residual = np.zeros((len(problem.free) + 1, d + 1, d))  # the last one is for the fixed poses
    i, j, _ = problem.slots.T
    np.add.at(residual[:, R], i, 0.25 * (bent - np.swapaxes(bent, 1, 2) + torque))
    np.add.at(residual[:, R], j, -0.25 * torque)
    np.add.at(residual[:, t], i, -0.5 * force)
    np.add.at(residual[:, t], j, 0.5 * force)
    return problem.scattered(of_i, of_j, coupling), residual[:-1]


@dataclass(frozen=True, slots=True)
class Minorants:
    """Per edge, χ² ≥ χ²* + τ‖t_j − t_i − G_i l‖² + fᵀ(G_iᵀ(t_j − t_i) − l) + κ tr(I − G_iᵀG_j) + ½⟨[g]×, G_iᵀG_j⟩.

    G_i is the rotation of pose i relative to its estimate, G_i = R_i R_i*ᵀ, t_i its position, both in the world.

    leap : (E, d) l, from pose i to pose j at the estimate, m
    force : (E, d) f, slope of χ² with the position of j
    torque : (E, d, d) [g]×, slope of χ² with the rotation of j at a fixed position
    tau : (E,) m⁻²
    kappa : (E,) rad⁻²; NaN for an edge too far from its measurement, or with too little information, for any bound
    """

    leap: Matrix
    force: Matrix
    torque: Matrix
    tau: Vector
    kappa: Vector


def minorize(problem: GraphProblem, poses: Matrix, weights: Vector) -> Minorants:
    """Bounds that touch the χ² of every edge, times its weight (E,), at these poses.

    They use up a part of its isotropic information, mostly of κ.
    """
    d = poses.shape[-1] - 1
    i, j = problem.edges.T
    errors, norm = problem.errors(poses), partial(np.linalg.norm, axis=-1)
    information = weights[:, None, None] * problem.information
    pull = (information @ errors[..., None])[..., 0]  # y
    slope = 2.0 * (np.swapaxes(problem.jacobians(poses, errors), 1, 2) @ pull[..., None])[..., 0]
    force = slope[:, :d]
    torque = slope[:, d:] - (force[:, None] @ turns(poses[j, :d, d]))[:, 0]
    turned = errors[:, d:] if d == 2 else (poses[j, :3, :3] @ errors[:, 3:, None])[..., 0]
    tau, kappa = _isotropic(information, d)
    rho, theta = norm(errors[:, :d]), norm(errors[:, d:])
    slide = _SLOPE * norm(pull[:, :d])
    bent = _PAID_FROM_TAU * 0.5 * rho * np.sqrt(tau / kappa) + 1e-12
    paid = np.minimum(_PAID_FROM_TAU * slide / np.sqrt(tau * kappa) + 1e-12, 0.5)
    left = tau * (1.0 - paid) / (1.0 + bent)
    cost = 0.25 * left * (1.0 + 1.0 / bent) * rho**2 + slide**2 / (paid * tau) + norm(force) * rho / 6.0
    cost += 0.5 * norm(torque - 2.0 * kappa[:, None] * turned)
    kappa = (1.0 - 0.5 * _BEND * theta**2) * (kappa - cost / np.maximum(1.0 - theta, 1e-12))
    kappa[~(kappa > 0.0) | (theta >= _FARTHEST)] = np.nan
    seen = ~problem.is_whole  # position factors: quadratic in the position of j, independent of its rotation
    left[seen], kappa[seen] = np.linalg.eigvalsh(information[seen, :d, :d])[:, 0], 0.0
    crossed = lie.hat(torque) if d == 3 else torque[:, :, None] * np.array([[0.0, -1.0], [1.0, 0.0]])
    return Minorants(poses[j, :d, d] - poses[i, :d, d], force, crossed, left, kappa)


def _isotropic(information: Matrix, d: int) -> tuple[Vector, Vector]:
    """τ and κ, (E,), with diag(τ I, κ I) ⪯ Ω: the smallest eigenvalues, lowered for the coupling."""
    tau = np.linalg.eigvalsh(information[:, :d, :d])[:, 0]
    kappa = np.linalg.eigvalsh(information[:, d:, d:])[:, 0]
    k = information.shape[-1]
    scale = np.maximum(np.repeat(np.stack([tau, kappa], axis=1), (d, k - d), axis=1), _TINY) ** -0.5
    least = np.linalg.eigvalsh(scale[:, :, None] * information * scale[:, None, :])[:, 0]
    share = np.asarray(np.clip(least, 1e-12, 1.0) * (1.0 - _ROUNDING), np.float64)
    tau, kappa = (np.asarray(np.maximum(each, _TINY), np.float64) for each in (tau, kappa))
    return share * tau, share * kappa
