"""Slips: stretches of odometry that are off by far more than their edges say, as loop edges show them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.robust.left_out import LeftOut

SIGMA_M = 1.0  # standard deviation of a slip
_MOST = 100  # largest number of stretches whose information is worked out
_WEAKER = 2.0  # factor between the least and the largest information of a translation from which on one is weak
_MOVES = 3.0  # least length of a motion that may slip, in its standard deviations
_PROBABILITY = 1e-3  # of a slip that begins at an edge
_LENGTHS = (4, 16, 64)  # number of edges of the stretches that are tried


Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Slip:
    """So many odometry edges from the first on, by which odometry is too short all together, in meters."""

    first: int
    count: int
    size_m: float = 0.0

    @property
    def edges(self) -> slice:
        """Its edges among those of odometry, in the order they were added."""
        return slice(self.first, self.first + self.count)


def directions(information: Matrix, measurements: Matrix) -> Matrix:
    """Twist (E, k) along which each edge may slip: its weakest translation, or its motion where none is weak.

    Zero where the motion is no longer than its noise: its direction is then that of the noise, which a slip would
    seem to explain.
    """
    d = measurements.shape[-1] - 1
    values, vectors = np.linalg.eigh(information[:, :d, :d])
    motion = measurements[:, :d, d]
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    is_even = (values[:, :1] * _WEAKER > values[:, -1:]) & (length > 0.0)
    weakest = vectors[:, :, 0] * np.where((vectors[:, :, 0] * motion).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    moves = np.einsum("ea,eab,eb->e", motion, information[:, :d, :d], motion) > _MOVES**2
    result = np.zeros(information.shape[:2])
    result[:, :d] = moves[:, None] * np.where(is_even, motion / np.maximum(length, 1e-12), weakest)
    return result


def without_slips(odometry: Matrix, information: Matrix, slips: tuple[Slip, ...]) -> Matrix:
    """Motions (O, d+1, d+1) of odometry with the slips added to them, evenly over their edges."""
    result = odometry.copy()
    for slip in slips:
        part = odometry[slip.edges]
        twist = directions(information[slip.edges], part) * (slip.size_m / slip.count)
        result[slip.edges] = result[slip.edges] @ lie.exp(twist)
    return result


def price_of(slip: Slip, odometry: Matrix, information: Matrix) -> float:
    """Cost of a slip in χ², −2 log of its likelihood over that of none: 2 log(1/p) + log(1 + σ²a) + (s/σ)².

    a = Σ uᵀΩu/n², what the edges say of a slip spread over them: the better they are measured, the less likely one
    was missed.
    """
    part = information[slip.edges]
    u = directions(part, odometry[slip.edges]) / slip.count
    return float(_fixed_price(np.einsum("ea,eab,eb->", u, part, u))) + (slip.size_m / SIGMA_M) ** 2


def _fixed_price(claimed: Vector) -> Vector:
    return np.log1p(SIGMA_M**2 * claimed) - 2.0 * np.log(_PROBABILITY)


def next_slip(
    left_out: LeftOut, measured: Matrix, slips: tuple[Slip, ...], price: float
) -> tuple[float, tuple[Slip, ...]]:
    """The fall of the cost by one more slip, or the change of one, to first order, and the slips with it.

    measured : (O, d+1, d+1) as odometry has it, in the order of ``left_out.odometry``
    A slip s changes the cost by A s² − 2 b s, prior included, and by what each loop edge left out then costs less
    than its price: min(price, (e + V s)ᵀC⁻¹(e + V s)). Each of them gives a candidate. A takes a solve, so that
    stretches are tried in the order of an estimate: along a chain whose ends are well known, the information on a
    slip of all edges is what they claim, that on a slip of one the share of its redundancy; these add up to one.
    """
    u = directions(left_out.problem.information[left_out.odometry], measured)
    tried = [*slips, *_stretches(len(u), slips)]
    own, redundancy, bent = (_means(each, tried) for each in _edge_by_edge(left_out, u))
    V = np.stack([_means(shift[..., 0], tried) for shift in left_out.shifts(u[..., None])], axis=1)
    count = np.array([slip.count for slip in tried])
    claimed = own / count
    sizes = np.array([slip.size_m for slip in tried])
    worth, prior = -_fixed_price(claimed), SIGMA_M**-2.0
    worth[: len(slips)] = 0.0
    information = prior + np.minimum(redundancy * count, 1.0) * claimed
    hoped, _ = _largest_falls(left_out, V, information, bent - prior * sizes, worth, price)
    hoped[: len(slips)] = np.inf
    best, most = slips, 0.0
    for index in np.argsort(-hoped, kind="stable")[:_MOST]:
        if not hoped[index] > most:
            break
        slip, one = tried[index], slice(index, index + 1)
        twists = np.zeros((*u.shape, 1))
        twists[slip.edges, :, 0] = u[slip.edges] / slip.count
        b, A = left_out.quadratic(twists)
        falls = _largest_falls(left_out, V[one], prior + A[0], b - prior * sizes[one], worth[one], price)
        gain, size_m = float(falls[0][0]), float(falls[1][0])
        if gain > most:
            others = tuple(each for each in slips if each is not slip)
            best, most = (*others, replace(slip, size_m=slip.size_m + size_m)), gain
    return most, best


def _edge_by_edge(left_out: LeftOut, u: Matrix) -> tuple[Vector, Vector, Vector]:
    """Of each edge along its twist u (O, k): uᵀΩu (O,), redundancy (O,) and uᵀΩe (O,)."""
    pull = (left_out.problem.information[left_out.odometry] @ u[..., None])[..., 0]
    own = (u * pull).sum(axis=1)
    known = (pull * (left_out.predicted @ pull[..., None])[..., 0]).sum(axis=1)
    redundancy = 1.0 - known / np.maximum(own, np.finfo(np.float64).tiny)
    bent = (pull * left_out.errors[left_out.odometry]).sum(axis=1)
    return own, redundancy, bent


def _means(each: Matrix, stretches: list[Slip]) -> Matrix:
    """Mean (S, ...) over the edges of each stretch, of values (O, ...)."""
    sums = np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])
    first, count = np.array([(slip.first, slip.count) for slip in stretches], np.int64).reshape(-1, 2).T
    return (sums[first + count] - sums[first]) / count.reshape(-1, *(each.ndim - 1) * [1])


def _largest_falls(
    left_out: LeftOut, V: Matrix, A: Vector, b: Vector, worth: Vector, price: float
) -> tuple[Vector, Vector]:
    """Largest fall of the cost by each stretch (S,), and the change of its slip that does it.

    worth : (S,) minus the price of a new slip, which must explain a loop edge; 0 for one that is there
    """
    e, M = left_out.errors[left_out.edges], np.linalg.inv(left_out.covariances)
    VM = np.einsum("sla,lab->slb", V, M)
    VMV, VMe = (VM * V).sum(axis=2), (VM * e).sum(axis=2)
    eMe = np.einsum("la,lab,lb->l", e, M, e)
    fall, size_m = np.full(len(V), -np.inf), np.zeros(len(V))
    for s in np.concatenate([b[None] / A, ((b[:, None] - VMe) / (A[:, None] + VMV)).T]):
        explained = np.maximum(price - (eMe + 2.0 * s[:, None] * VMe + s[:, None] ** 2 * VMV), 0.0)
        total = 2.0 * b * s - A * s**2 + explained.sum(axis=1) + worth
        total[(worth < 0.0) & ~explained.any(axis=1)] = -np.inf
        fall, size_m = np.maximum(fall, total), np.where(total > fall, s, size_m)
    return fall, size_m


def _stretches(count: int, slips: tuple[Slip, ...]) -> list[Slip]:
    """Stretches of every length that overlap none of the slips, each half beside the last."""
    return [
        Slip(first, length)
        for length in _LENGTHS
        for first in range(0, count - length + 1, length // 2)
        if all(first >= slip.first + slip.count or slip.first >= first + length for slip in slips)
    ]
