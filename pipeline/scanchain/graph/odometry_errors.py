"""Odometry errors inferred from loop edges: constant drift, and segments of inflated covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanchain import lie
from scanchain.data import Integers, Mask, Matrix, Vector
from scanchain.graph.consistency import FEWEST

_DRIFT_SIGMAS = (0.03, 0.01)  # prior standard deviations of the scale, and of the turn in rad/m
_SLIP_SIGMA_M, JUMP_SIGMAS = 1.0, (1.0, 0.2)  # m or (m, rad), standard deviations of an unknown motion
_SLIP_PROBABILITY, _JUMP_PROBABILITY = 1e-3, 1e-4  # that one begins at an edge
_WEAKER = 2.0  # ratio of the largest to the least information on a translation at which one direction is weak
_MOVES = 3.0  # least length of a motion that may slip, in its standard deviations


@dataclass(frozen=True, slots=True)
class InflatedSegment:
    """A segment of ``count`` odometry edges, in the order of the poses, whose errors exceed their covariance.

    In a slip the edges share an error, each along its weakest direction; in a jump one edge is entirely wrong.
    """

    first: int
    count: int
    is_jump: bool

    @property
    def edges(self) -> slice:
        """Its edges among those of odometry, in the order of the poses."""
        return slice(self.first, self.first + self.count)

    def error_twists(self, measured: Matrix, information: Matrix) -> Matrix:
        """Twists (count, k, p) of its edges by one standard deviation of each of p errors, from all odometry."""
        return error_twists(measured[self.edges], information[self.edges], is_jump=self.is_jump) / self.count


@dataclass(frozen=True, slots=True)
class Explanation:
    """Odometry errors that explain rejected loop edges.

    drift : (2,) or (4,) share of the path by which odometry is too short, and radians per meter that it turns too
        little
    inflated : slips and jumps, segments of odometry with inflated covariance
    """

    drift: Vector
    inflated: tuple[InflatedSegment, ...] = ()

    @classmethod
    def none(cls, freedom: int) -> Explanation:
        """No errors: odometry as measured."""
        return cls(np.zeros(2 if freedom == 3 else 4))

    def applied(
        self, edges: Integers, measured: Matrix, information: Matrix, is_odometry: Mask
    ) -> tuple[Matrix, Matrix]:
        """Measurements (E, d+1, d+1) without drift, and their information (E, k, k), reduced in slips and jumps.

        The noise of a motion scales with its corrected length: with unscaled noise, a shortened motion would fit
        better merely because its noise is shortened as well.
        """
        if not self.drift.any() and not self.inflated:
            return measured, information
        odometry = odometry_of(edges, is_odometry)
        of_odometry, Z = information[odometry], measured[odometry]
        for segment in self.inflated:
            twists = segment.error_twists(Z, information[odometry])
            of_odometry[segment.edges] = _inflated(of_odometry[segment.edges], twists)
        if self.drift[0]:
            scale = lie.by_component(information.shape[-1], 1.0 / (1.0 + self.drift[0]), 1.0)
            of_odometry = of_odometry * np.outer(scale, scale)
        measured, information = measured.copy(), information.copy()
        measured[odometry] = corrected(Z, self.drift, direction(edges[odometry]))
        information[odometry] = of_odometry
        return measured, information

    def with_later(self, other: Explanation, before: int) -> Explanation:
        """The same plus the slips and jumps of another, whose odometry edges follow the first ``before`` ones."""
        later = (replace(segment, first=segment.first + before) for segment in other.inflated)
        return replace(self, inflated=(*self.inflated, *later))

    def cost(self, measured: Matrix, information: Matrix, price: float, nominal: float) -> float:
        """Cost of the explanation itself, where a rejected loop edge costs this price; the arrays are of odometry.

        nominal : price if the noise model is right
        """
        result = float((self.drift**2 * prior(len(self.drift))).sum())
        result += FEWEST * price if self.drift.any() else 0.0
        for segment in self.inflated:
            B = segment.error_twists(measured, information)
            claimed = (np.swapaxes(B, 1, 2) @ information[segment.edges] @ B).sum(axis=0)
            result += float(cost_of(claimed, is_jump=segment.is_jump, price=price, nominal=nominal))
        return result

    def lines(self, ends: Integers, noun: str, errors: Matrix, measured: Matrix, information: Matrix) -> list[str]:
        """The corrections as text, one line each.

        ends (O, 2), noun : displayed numbers of the poses that odometry joins, and the noun for them, as "scans"
        errors (O, k), measured, information : of odometry, in the order of the poses
        """
        found = []
        if self.drift.any():
            scale, *turns = self.drift.tolist()
            turn = ", ".join(f"{1e3 * rad_per_m:+.1f}" for rad_per_m in turns)
            found.append(f"length {100.0 * scale:+.1f} %, turn {turn} mrad/m")
        for segment in sorted(self.inflated, key=lambda each: each.is_jump):
            along = segment.error_twists(measured, information)[..., 0] * (segment.count / _SLIP_SIGMA_M)
            size_m = float((along * errors[segment.edges]).sum())
            what = "a jump" if segment.is_jump else f"a slip of {size_m:+.1f} m"
            poses = ends[segment.edges]
            found.append(f"{what} between {noun} {poses.min():,} and {poses.max():,}")
        return [f"corrected by loop closures: {what}" for what in found]


def odometry_of(edges: Integers, is_odometry: Mask) -> Integers:
    """Edges of odometry (O,), in the order of the poses."""
    odometry = np.flatnonzero(is_odometry)
    return odometry[np.argsort(edges[odometry].min(axis=1), kind="stable")]


def direction(edges: Integers) -> Vector:
    """1 for edges (O, 2) to a later pose, −1 for those to an earlier one."""
    return np.sign(edges[:, 1] - edges[:, 0]).astype(np.float64)


def corrected(measurements: Matrix, drift: Vector, sign: Vector | float = 1.0) -> Matrix:
    """Motions (E, d+1, d+1) lengthened by the share drift[0] and turned by drift[1:] per meter.

    sign : (E,) −1 for a motion that is measured backward
    """
    return lie.exp(changed(lie.log(measurements), drift, sign)) if drift.any() else measurements


def changed(twists: Matrix, drift: Vector, sign: Vector | float) -> Matrix:
    """The same for twists (E, k)."""
    d = twists.shape[-1] - len(drift) + 1
    length_m = np.linalg.norm(twists[..., :d], axis=-1, keepdims=True) * np.asarray(sign)[..., None]
    return np.concatenate([(1.0 + drift[0]) * twists[..., :d], twists[..., d:] + length_m * drift[1:]], axis=-1)


def prior(count: int) -> Vector:
    """Prior information (count,) of a drift."""
    return np.array([_DRIFT_SIGMAS[0]] + (count - 1) * [_DRIFT_SIGMAS[1]]) ** -2.0


def error_twists(measured: Matrix, information: Matrix, *, is_jump: bool) -> Matrix:
    """Twists (E, k, p) of edges by one standard deviation of each of p errors, all of it on that edge.

    A slip is along the weakest direction of translation, or along the motion where none is weak. It is zero where
    the motion is not clearly longer than its noise: its direction is then that of the noise, which a slip would
    appear to explain.
    """
    count, k = information.shape[:2]
    if is_jump:
        return np.tile(np.diag(lie.by_component(k, *JUMP_SIGMAS)), (count, 1, 1))
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


def _inflated(information: Matrix, twists: Matrix) -> Matrix:
    """Information (n, k, k) of the edges of a segment with its errors added to their covariance, (Ω⁻¹ + n BBᵀ)⁻¹.

    twists : (n, k, p) B; as independent errors, n BBᵀ on each of the n edges add up to the covariance of the whole
        segment. With Woodbury's identity, Ω may be singular.
    """
    pull = np.sqrt(len(twists)) * information @ twists
    inner = np.eye(twists.shape[2]) + np.sqrt(len(twists)) * np.swapaxes(twists, 1, 2) @ pull
    return information - pull @ np.linalg.solve(inner, np.swapaxes(pull, 1, 2))


def cost_of(claimed: Matrix, *, is_jump: bool, price: float, nominal: float) -> Vector:
    """Cost of segments in χ², −2 log of the likelihood ratio to none: 2 log(1/p) + log |1 + Σ BᵀΩB|.

    The more accurate the edges, the less likely it is that they missed an error. A jump also costs three rejected
    loop edges, and its likelihood term is scaled with their price.

    claimed : (..., p, p) Σ BᵀΩB, information of the edges on the errors, in standard deviations of these
    price, nominal : price of a rejected loop edge, and its value if the noise model is right
    """
    log_ratio = np.linalg.slogdet(np.eye(claimed.shape[-1]) + claimed)[1]
    if not is_jump:
        return log_ratio - 2.0 * np.log(_SLIP_PROBABILITY)
    return FEWEST * price + (price / nominal) * (log_ratio - 2.0 * np.log(_JUMP_PROBABILITY))
