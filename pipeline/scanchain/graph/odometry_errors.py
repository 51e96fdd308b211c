"""Errors of odometry in a graph: drift that is the same all along, and stretches that are loosened."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.left_out import LeftOut

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


JUMP_FEWEST = 3  # number of loop edges that a jump must explain beyond its likelihood
_SLIP_SIGMA_M, _JUMP_SIGMAS = 1.0, (1.0, 0.2)  # standard deviations, m or (m, rad)
_SLIP_PROBABILITY, _JUMP_PROBABILITY = 1e-3, 1e-4  # of one that begins at an edge
_SLIP_LENGTHS = (4, 16, 64)  # number of edges of the stretches that are tried
_WEAKER = 2.0  # factor between the least and the largest information of a translation from which on one is weak
_MOVES = 3.0  # least length of a motion that may slip, in its standard deviations
_MOST = 100  # largest number of stretches that are looked at more closely
_STRETCH_ROUNDS = 3  # of the least squares over the loop edges that a stretch explains


@dataclass(frozen=True, slots=True)
class Slip:
    """So many odometry edges from the first on, by which odometry is too short all together, in meters."""

    first: int
    count: int
    size_m: float


@dataclass(frozen=True, slots=True)
class Loosened:
    """So many odometry edges from the first on, in the order of the poses, that are off by more than they say.

    In a slip they are off together, each along its weakest direction; in a jump one edge is wrong altogether.
    """

    first: int
    count: int
    is_jump: bool

    @property
    def edges(self) -> slice:
        """Its edges among those of odometry."""
        return slice(self.first, self.first + self.count)

    def spread(self, measured: Matrix, information: Matrix) -> Matrix:
        """Twists (count, k, p) of its edges by a standard deviation of each of its p errors; of all odometry."""
        return spread(measured[self.edges], information[self.edges], is_jump=self.is_jump) / self.count

    def slip(self, errors: Matrix, measured: Matrix, information: Matrix) -> Slip:
        """The slip that the residuals (O, k) of odometry show."""
        along = self.spread(measured, information)[..., 0] * (self.count / _SLIP_SIGMA_M)
        return Slip(self.first, self.count, float((along * errors[self.edges]).sum()))


def spread(measured: Matrix, information: Matrix, *, is_jump: bool) -> Matrix:
    """Twists (E, k, p) of edges by a standard deviation of each of p errors, all of it on that edge.

    A slip is along the weakest translation, or along the motion where none is weak; zero where the motion is no
    longer than its noise: its direction is then that of the noise, which a slip would seem to explain.
    """
    count, k = information.shape[:2]
    if is_jump:
        return np.tile(np.diag(lie.by_component(k, *_JUMP_SIGMAS)), (count, 1, 1))
    d = measured.shape[-1] - 1
    values, vectors = np.linalg.eigh(information[:, :d, :d])
    motion = measured[:, :d, d]
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    is_even = (values[:, :1] * _WEAKER > values[:, -1:]) & (length > 0.0)
    weakest = vectors[:, :, 0] * np.where((vectors[:, :, 0] * motion).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    moves = np.einsum("ea,eab,eb->e", motion, information[:, :d, :d], motion) > _MOVES**2
    result = np.zeros((count, k, 1))
    along = np.where(is_even, motion / np.maximum(length, 1e-12), weakest)
    result[:, :d, 0] = _SLIP_SIGMA_M * moves[:, None] * along
    return result


def loosened(information: Matrix, twists: Matrix) -> Matrix:
    """Information (n, k, k) of the edges of a stretch with its errors added to theirs, (Ω⁻¹ + n BBᵀ)⁻¹.

    twists : (n, k, p) B; n times its covariance on each edge make that of the whole stretch, as errors that are
        independent. By Woodbury's identity, Ω may be singular.
    """
    pull = np.sqrt(len(twists)) * information @ twists
    inner = np.eye(twists.shape[2]) + np.sqrt(len(twists)) * np.swapaxes(twists, 1, 2) @ pull
    return information - pull @ np.linalg.solve(inner, np.swapaxes(pull, 1, 2))


def cost_of(claimed: Matrix, *, is_jump: bool, price: float, nominal: float) -> Vector:
    """Cost of stretches in χ², −2 log of the likelihood over that of none: 2 log(1/p) + log |1 + Σ BᵀΩB|.

    The better the edges are measured, the less likely an error was missed. A jump also costs three loop edges left
    out, and its likelihood is scaled as their price is.

    claimed : (..., p, p) Σ BᵀΩB, what the edges say of the errors, in their standard deviations
    price, nominal : of a loop edge left out, and what it is where the noise model is right
    """
    log_ratio = np.linalg.slogdet(np.eye(claimed.shape[-1]) + claimed)[1]
    if not is_jump:
        return log_ratio - 2.0 * np.log(_SLIP_PROBABILITY)
    return JUMP_FEWEST * price + (price / nominal) * (log_ratio - 2.0 * np.log(_JUMP_PROBABILITY))


def next_loosened(
    left_out: LeftOut,
    measured: Matrix,
    others: tuple[Loosened, ...],
    *,
    is_jump: bool,
    price: float,
    nominal: float,
) -> tuple[float, Loosened, Matrix] | None:
    """The fall of the cost by one more slip or jump, to first order, it, and the twists (n, k) of its edges.

    measured : (O, d+1, d+1) as odometry has it, in the order of ``left_out.odometry``
    Errors t, in standard deviations, change the cost by tᵀA t − 2 bᵀt, prior included, and by what each loop edge
    left out then costs less than its price: min(price, (e + V t)ᵀC⁻¹(e + V t)). Each of them gives a candidate.

    A takes a solve, so that stretches are tried in the order of a bound, for which each loop edge has errors of
    its own at its share of that change, and A is estimated: along a chain whose ends are well known, the
    information on a slip of all edges is what they claim, that on a slip of one the share of its redundancy; these
    add up to one.
    """
    tried = _stretches(len(measured), others, is_jump=is_jump)
    if not tried:
        return None
    first, count = np.array([(stretch.first, stretch.count) for stretch in tried]).T
    information = left_out.problem.information[left_out.odometry]
    B = spread(measured, information, is_jump=is_jump)
    pull = information @ B
    pull_t, unit = np.swapaxes(pull, 1, 2), np.eye(B.shape[2])
    own = np.swapaxes(B, 1, 2) @ pull
    claimed = _means(own, first, count) / count[:, None, None]
    learned = _means(own - pull_t @ left_out.predicted @ pull, first, count)
    A = unit + (learned if is_jump else np.minimum(learned, claimed))
    b = _means(pull_t @ left_out.errors[left_out.odometry][..., None], first, count)[..., 0]
    costs = cost_of(claimed, is_jump=is_jump, price=price, nominal=nominal)
    e, price = left_out.errors[left_out.edges], left_out.stride * price
    M = np.asarray(left_out.stride * np.linalg.inv(left_out.covariances), np.float64)
    alone = (b * np.linalg.solve(A, b[..., None])[..., 0]).sum(axis=1) / len(e)  # without any of them explained
    hoped = -costs
    for error, weight, shift in zip(e, M, left_out.shifts(B), strict=True):
        V = _means(shift, first, count)
        g = b / len(e) - np.swapaxes(V, 1, 2) @ (weight @ error)
        H = A / len(e) + np.swapaxes(V, 1, 2) @ weight @ V
        fall = (g * np.linalg.solve(H, g[..., None])[..., 0]).sum(axis=1) + price - error @ weight @ error
        hoped += np.maximum(fall, alone)
    best, most = None, 0.0
    for index in np.argsort(-hoped, kind="stable")[:_MOST]:
        if not hoped[index] > most:
            break
        stretch, twists = tried[index], B[tried[index].edges] / count[index]
        slope, curvature = left_out.quadratic(twists, stretch.edges)
        V = np.stack([shift.sum(axis=0) for shift in left_out.shifts(twists, stretch.edges)])
        fall, t = _largest_fall(unit + curvature, slope, e, M, V, price)
        if fall - costs[index] > most:
            best, most = (stretch, twists @ t), fall - float(costs[index])
    return None if best is None else (most, *best)


def _largest_fall(A: Matrix, b: Vector, e: Matrix, M: Matrix, V: Matrix, price: float) -> tuple[float, Vector]:
    """Largest fall of the cost by errors (p,) of one stretch that explain a loop edge, and the errors.

    A (p, p), b (p,) : of the stretch; e, M, V : (L, ...) of the loop edges
    """
    VM = np.swapaxes(V, 1, 2) @ M
    VMV, VMe = VM @ V, (VM @ e[..., None])[..., 0]
    chosen, largest, best = np.eye(len(e)), 0.0, np.zeros(len(b))
    for _ in range(_STRETCH_ROUNDS):
        t = np.linalg.solve(A + np.einsum("cl,lab->cab", chosen, VMV), (b - chosen @ VMe)[..., None])[..., 0]
        left = e + np.einsum("lab,cb->cla", V, t)
        saved = np.maximum(price - np.einsum("cla,lab,clb->cl", left, M, left), 0.0)
        falls = 2.0 * t @ b - np.einsum("ca,ab,cb->c", t, A, t) + saved.sum(axis=1)
        falls[~saved.any(axis=1)] = 0.0
        if falls.max() > largest:
            largest, best = float(falls.max()), t[int(np.argmax(falls))]
        chosen = (saved > 0.0).astype(np.float64)
    return largest, best


def _means(each: Matrix, first: NDArray[np.int64], count: NDArray[np.int64]) -> Matrix:
    """Mean (S, ...) over the edges of each stretch, of values (O, ...)."""
    sums = np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])
    return (sums[first + count] - sums[first]) / count.reshape(-1, *(each.ndim - 1) * [1])


def _stretches(edges: int, others: tuple[Loosened, ...], *, is_jump: bool) -> list[Loosened]:
    """Stretches of every length, of so many edges, that overlap none of the others, each half beside the last."""
    return [
        Loosened(first, length, is_jump)
        for length in ((1,) if is_jump else _SLIP_LENGTHS)
        for first in range(0, edges - length + 1, max(length // 2, 1))
        if all(first >= other.edges.stop or other.first >= first + length for other in others)
    ]
