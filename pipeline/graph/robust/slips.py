"""Slips: stretches of odometry that are off by far more than their edges say, as loop edges show them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.covariance import residual_covariances
from scanchain.graph.robust.groups import apart

SIGMA_M = 1.0  # standard deviation of a slip
_MOST = 20  # largest number of loop edges left out that are looked at
_WEAKER = 2.0  # factor between the least and the largest information of a translation from which on one is weak
_PROBABILITY = 1e-3  # of a slip that begins at an edge
_LENGTHS = (4, 16, 64)  # number of edges of the stretches that are tried


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
    own = float(np.einsum("ea,eab,eb->", u, part, u))
    return float(np.log1p(SIGMA_M**2 * own) - 2.0 * np.log(_PROBABILITY)) + (slip.size_m / SIGMA_M) ** 2


def next_slip(
    problem: BetweenProblem,
    measured: Matrix,
    poses: Matrix,
    is_loop: NDArray[np.bool_],
    kept: NDArray[np.bool_],
    slips: tuple[Slip, ...],
    price: float,
) -> tuple[float, tuple[Slip, ...]]:
    """The fall of the cost by one more slip, or the change of one, to first order, and the slips with it.

    measured : (E, d+1, d+1) as odometry has it
    With g = Σ JᵀΩu/n, a slip s moves the poses by H⁻¹g s, and the residual e of a loop edge left out by V s. The
    cost changes by A s² − 2 b s, A = Σ uᵀΩu/n² − gᵀH⁻¹g + 1/σ² and b = Σ uᵀΩe/n, and by what each loop edge,
    predicted with covariance C, then costs less than its price: min(price, (e + V s)ᵀC⁻¹(e + V s)). Each of them
    gives a candidate. Loop edges near each other count as one, for they may share a mistake.
    """
    odometry = np.flatnonzero(~is_loop)
    errors = problem.errors(poses)
    jacobians = problem.jacobians(poses, errors)
    sparse = problem.factored(poses, errors, kept)
    information = problem.information[odometry]
    u = directions(information, measured[odometry])
    pull = np.einsum("eab,eb->ea", information, u)
    moved = np.einsum("eab,ea->eb", jacobians[odometry], pull)
    claimed, bent = (u * pull).sum(axis=1), (pull * errors[odometry]).sum(axis=1)
    out = apart(problem.edges, np.flatnonzero(is_loop & ~kept))
    out = out[:: max(1, -(-len(out) // _MOST))]
    M = np.asarray(np.linalg.inv(residual_covariances(problem, sparse, jacobians, out)), np.float64)
    i, j = problem.edges[out].T
    left_out = errors[out]
    best, most = slips, 0.0
    for slip in _stretches(len(odometry), slips):
        n = slip.count
        whole = np.zeros((len(problem.variable), problem.freedom))
        begin, end = problem.edges[odometry[slip.edges]].T
        np.add.at(whole, end, moved[slip.edges] / n)
        np.add.at(whole, begin, -moved[slip.edges] / n)
        g = sparse.packing.rows(whole[problem.free])
        x = sparse.cholesky.solve(g)
        A = claimed[slip.edges].sum() / n**2 - g @ x + 1.0 / SIGMA_M**2
        b = bent[slip.edges].sum() / n - slip.size_m / SIGMA_M**2
        whole[:] = 0.0
        whole[problem.free] = sparse.packing.spread_rows(x)
        V = np.einsum("eab,eb->ea", jacobians[out], whole[j] - whole[i])
        VM = np.einsum("ea,eab->eb", V, M)
        s = np.append(b / A, (b - (VM * left_out).sum(axis=1)) / (A + (VM * V).sum(axis=1)))
        left = left_out + s[:, None, None] * V  # (candidates, loop edges, k)
        explained = np.maximum(price - np.einsum("cea,eab,ceb->ce", left, M, left), 0.0).sum(axis=1)
        gain = 2.0 * b * s - A * s**2 + explained
        if slip not in slips:
            gain -= price_of(slip, measured[odometry], information)
        which = int(np.argmax(gain))
        if gain[which] > most:
            others = tuple(each for each in slips if each is not slip)
            best, most = (*others, replace(slip, size_m=slip.size_m + float(s[which]))), float(gain[which])
    return most, best


def _stretches(count: int, slips: tuple[Slip, ...]) -> Iterator[Slip]:
    """Slips known already, and stretches of every length that overlap none of them, each half beside the last."""
    yield from slips
    for length in _LENGTHS:
        for first in range(0, count - length + 1, max(1, length // 2)):
            if all(first >= slip.first + slip.count or slip.first >= first + length for slip in slips):
                yield Slip(first, length)
