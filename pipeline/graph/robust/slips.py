"""Slips: stretches of odometry that are off by far more than their edges say, as loop edges show them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.robust.left_out import LeftOut

SIGMA_M = 1.0  # standard deviation of a slip
_FEWEST = 2  # least number of loop edges left out, none near another, that a slip must explain
_MOST = 100  # largest number of stretches whose information is worked out
_WEAKER = 2.0  # factor between the least and the largest information of a translation from which on one is weak
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
    """Twist (E, k) along which each edge may slip: its weakest translation, or its motion where none is weak."""
    d = measurements.shape[-1] - 1
    values, vectors = np.linalg.eigh(information[:, :d, :d])
    motion = measurements[:, :d, d]
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    is_even = (values[:, :1] * _WEAKER > values[:, -1:]) & (length > 0.0)
    weakest = vectors[:, :, 0] * np.where((vectors[:, :, 0] * motion).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    result = np.zeros(information.shape[:2])
    result[:, :d] = np.where(is_even, motion / np.maximum(length, 1e-12), weakest)
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
    than its price: min(price, (e + V s)ᵀC⁻¹(e + V s)). Each of them gives a candidate. Stretches are tried in the
    order of what this is with no information but the prior, as long as that is more than the best.
    """
    information = left_out.problem.information[left_out.odometry]
    u = directions(information, measured)
    tried = [*slips, *_stretches(len(u), slips)]
    first, count = np.array([(slip.first, slip.count) for slip in tried]).reshape(-1, 2).T

    def over(each: Matrix) -> Matrix:
        sums = np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])
        return (sums[first + count] - sums[first]) / count.reshape(-1, *(each.ndim - 1) * [1])

    claimed = over((u * (information @ u[..., None])[..., 0]).sum(axis=1)) / count
    V = over((left_out.shifts @ u[:, None, :, None])[..., 0])
    M = np.asarray(np.linalg.inv(left_out.covariances), np.float64)
    e = left_out.errors[left_out.edges]
    sizes = np.array([slip.size_m for slip in tried])
    worth = -_fixed_price(claimed)
    worth[: len(slips)] = 0.0

    def best_size(which: NDArray[np.int64] | slice, A: Vector, b: Vector) -> tuple[Vector, Vector]:
        """Largest fall of the cost, and the size that has it, of each of these stretches."""
        v = V[which]
        vM = np.einsum("sla,lab->slb", v, M)
        vMv, vMe = (vM * v).sum(axis=2), (vM * e).sum(axis=2)
        eMe = np.einsum("la,lab,lb->l", e, M, e)
        gain, size = np.full(len(v), -np.inf), np.zeros(len(v))
        for s in np.concatenate([b[None] / A, ((b[:, None] - vMe) / (A[:, None] + vMv)).T]):
            left = price - (eMe + 2.0 * s[:, None] * vMe + s[:, None] ** 2 * vMv)
            total = 2.0 * b * s - A * s**2 + np.maximum(left, 0.0).sum(axis=1) + worth[which]
            total[((left > 0.0).sum(axis=1) < _FEWEST) & (worth[which] < 0.0)] = -np.inf
            size, gain = np.where(total > gain, s, size), np.maximum(gain, total)
        return gain, size

    none = np.zeros(len(tried))
    hoped, _ = best_size(slice(None), none + 1.0 / SIGMA_M**2, none)
    hoped[: len(slips)] = np.inf
    best, most = slips, 0.0
    for index in np.argsort(-hoped)[:_MOST]:
        if not hoped[index] > most:
            break
        slip = tried[index]
        twists = np.zeros((*u.shape, 1))
        twists[slip.edges, :, 0] = u[slip.edges] / slip.count
        b, A, _ = left_out.quadratic(twists)
        prior = 1.0 / SIGMA_M**2
        (gain,), (size,) = best_size(np.array([index]), A[0] + prior, b - prior * sizes[index])
        if gain > most:
            others = tuple(each for each in slips if each is not slip)
            best, most = (*others, replace(slip, size_m=slip.size_m + float(size))), float(gain)
    return most, best


def _stretches(count: int, slips: tuple[Slip, ...]) -> list[Slip]:
    """Stretches of every length that overlap none of the slips, each half beside the last."""
    return [
        Slip(first, length)
        for length in _LENGTHS
        for first in range(0, count - length + 1, length // 2)
        if all(first >= slip.first + slip.count or slip.first >= first + length for slip in slips)
    ]
