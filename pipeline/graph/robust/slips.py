"""Slips: odometry edges whose position is off by far more than they say, as groups of loop edges show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.robust.groups import apart

SIGMA_M = 1.0  # standard deviation of a slip
_MOST = 20  # largest number of loop edges left out that are looked at
_WEAKER = 2.0  # factor between the least and the largest information of a translation from which on one is weak
_PROBABILITY = 1e-3  # of a slip at an edge


@dataclass(frozen=True, slots=True)
class Slip:
    """An odometry edge, and the fall of the cost that a slip there promises; −1 for none."""

    edge: int
    gain: float


def directions(information: Matrix, measurements: Matrix) -> Matrix:
    """Twist (E, k) along which each edge may have slipped: its weakest translation, or its motion where none is."""
    d = measurements.shape[-1] - 1
    values, vectors = np.linalg.eigh(information[:, :d, :d])
    motion = measurements[:, :d, d]
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    is_even = (values[:, :1] * _WEAKER > values[:, -1:]) & (length > 0.0)
    result = np.zeros(information.shape[:2])
    result[:, :d] = np.where(is_even, motion / np.maximum(length, 1e-12), vectors[:, :, 0])
    return result


def relaxed(information: Matrix, direction: Matrix) -> Matrix:
    """Information (E, k, k) of edges that slipped: (Ω⁻¹ + σ²uuᵀ)⁻¹ = Ω − Ωu (1/σ² + uᵀΩu)⁻¹ uᵀΩ."""
    pull = np.einsum("eab,eb->ea", information, direction)
    own = 1.0 / SIGMA_M**2 + (direction * pull).sum(axis=1)
    return information - pull[:, :, None] * pull[:, None, :] / own[:, None, None]


def prices(information: Matrix, direction: Matrix) -> NDArray[np.float64]:
    """Price in χ² of a slip at edges (E, k, k), −2 log of its likelihood over that of none, but for the size.

    2 log(1/p) + log(1 + σ²uᵀΩu): the better the edge is measured, the less a slip is likely to have been missed.
    """
    own = np.einsum("ea,eab,eb->e", direction, information, direction)
    return np.log1p(SIGMA_M**2 * own) - 2.0 * np.log(_PROBABILITY)


def next_slip(
    problem: BetweenProblem,
    poses: Matrix,
    is_loop: NDArray[np.bool_],
    kept: NDArray[np.bool_],
    slipped: NDArray[np.bool_],
    price: float,
) -> Slip:
    """The odometry edge whose slip lowers the cost most, to first order.

    A slip s u of edge o moves the poses by H⁻¹JᵀΩu s, and the residual e of a loop edge left out by V s. The cost
    changes by A s² − 2 b s, A = uᵀ(Ω − ΩPΩ)u + 1/σ² and b = uᵀΩe_o, and by what each loop edge, predicted with
    covariance C, then costs less than its price, at most: min(price, (e + V s)ᵀC⁻¹(e + V s)). Each of them gives a
    candidate. Loop edges near each other count as one, for they may share a mistake.
    """
    best = Slip(-1, 0.0)
    odometry = np.flatnonzero(~is_loop & ~slipped)
    if not len(odometry):
        return best
    errors = problem.errors(poses)
    jacobians = problem.jacobians(poses, errors)
    sparse = problem.restricted(kept)
    sparse.cholesky.factorize(sparse.linearize(poses, errors[kept], np.ones(int(kept.sum()))).values)
    blocks = sparse.packing.blocks(sparse.cholesky.inverse_blocks())
    blocks = np.concatenate([blocks, np.zeros((1, *blocks.shape[1:]))])  # found by -1, a fixed pose
    i, j, pair = sparse.slots[(np.cumsum(kept) - 1)[odometry]].T
    J, information = jacobians[odometry], problem.information[odometry]
    u = directions(information, problem.measurements[odometry])
    pull = np.einsum("eab,eb->ea", information, u)
    moved = np.einsum("eab,ea->eb", J, pull)  # JᵀΩu
    P = blocks[i] + blocks[j] - blocks[pair] - np.swapaxes(blocks[pair], 1, 2)
    A = (u * pull).sum(axis=1) - np.einsum("ea,eab,eb->e", moved, P, moved) + 1.0 / SIGMA_M**2
    b = (pull * errors[odometry]).sum(axis=1)
    i, j = problem.edges[odometry].T
    out = apart(problem.edges, np.flatnonzero(is_loop & ~kept))
    loops: list[tuple[Matrix, Matrix, NDArray[np.float64]]] = []
    for edge in out[:: max(1, -(-len(out) // _MOST))]:
        response = _response(sparse, problem, jacobians[edge], edge)
        first, second = problem.edges[edge]
        joint = jacobians[edge] @ (response[second] - response[first])
        M = np.linalg.inv(np.linalg.pinv(problem.information[edge], hermitian=True) + joint)
        loops.append((np.einsum("eab,ea->eb", response[j] - response[i], moved), M, errors[edge]))
    candidates = [b / A]
    for V, M, e in loops:
        VM = V @ M
        candidates.append((b - VM @ e) / (A + (VM * V).sum(axis=1)))
    price_of_slip = prices(information, u)
    for s in candidates:
        gain = 2.0 * b * s - A * s**2 - price_of_slip
        for V, M, e in loops:
            left = e + V * s[:, None]
            gain += np.maximum(price - np.einsum("ea,ab,eb->e", left, M, left), 0.0)
        most = int(np.argmax(gain))
        if gain[most] > best.gain:
            best = Slip(int(odometry[most]), float(gain[most]))
    return best


def _response(sparse: BetweenProblem, problem: BetweenProblem, jacobian: Matrix, edge: int) -> Matrix:
    """H⁻¹Jᵀ of an edge, (K, k, k): covariance of every pose with the edge's residual."""
    k = problem.freedom
    selection = np.zeros((len(problem.variable), k, k))
    i, j = problem.edges[edge]
    selection[j], selection[i] = jacobian.T, -jacobian.T
    columns = sparse.packing.rows(selection[problem.free])
    moved = np.stack([sparse.cholesky.solve(np.ascontiguousarray(column)) for column in columns.T], axis=1)
    selection[:] = 0.0
    selection[problem.free] = sparse.packing.spread_rows(moved)
    return selection
