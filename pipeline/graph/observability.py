"""Poses that the edges in force leave free, with their directions: the null space of the normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.edge_checks import is_connected, listed, loose
from scanchain.graph.solvers.cholesky import SingularMatrixError
from scanchain.words import counted

_AXES = {3: ("x", "y", "yaw"), 6: ("x", "y", "z", "roll", "pitch", "yaw")}
_MOST = 100  # largest number of directions of the null space that are computed
_MOVES = 1e-6  # share of the largest component of a null vector below which a pose stays where it is
_NAMED = 1e-2  # component of a direction from which its axis is named
_NOTHING = 1e-20  # share of the largest entry of its kind up to which a diagonal entry is rounding noise
_FREE = 1e-18  # share of what a twist changes pose by pose up to which it changes nothing edge by edge
_WEAK = 1e-6  # share of the median information up to which an edge is a weak one
_LOST = 1e-10  # share up to which too few digits of an edge are left beside the others to determine a pose


@dataclass(frozen=True, slots=True)
class FreePose:
    """A pose that moves without any change of χ².

    Attributes
    ----------
    name : what the pose is called: its vertex id, or its index
    axes : the axes of its own frame, as "x" or "yaw", along which or about which it may move
    followers : the other poses that move with it as one rigid body
    """

    name: int
    axes: tuple[str, ...]
    followers: tuple[int, ...] = ()

    def __str__(self) -> str:
        names = listed(np.array([self.name, *self.followers]))
        return f"{names} ({', '.join(self.axes)}){' as one body' if self.followers else ''}"


def free_text(free: Sequence[FreePose]) -> str:
    """Number of free poses, and the directions of the first, as one line of text."""
    shown = ", ".join(map(str, free[:8])) + (", ..." if len(free) > 8 else "")
    count = sum(1 + len(pose.followers) for pose in free)
    return f"the edges leave {counted(count, 'pose')} free: {shown}"


def free_poses(
    problem: BetweenProblem,
    poses: Matrix,
    weights: NDArray[np.float64],
    ranks: NDArray[np.int64],
    names: NDArray[np.int64],
) -> tuple[FreePose, ...]:
    """Poses with directions of their own frames that no edge constrains, at these poses and weights (E,).

    ranks (E,) are those of the information matrices. Where edges of full rank, weak along no axis, join every pose
    to a fixed one, nothing is free. Else the normal equations, without the axes along which an edge says next to
    nothing, are factored, and every pivot that vanishes gets a prior: with H' = H + Σ h e eᵀ over
    these, the null space of H is spanned by the columns of H'⁻¹ e.
    """
    fixed = problem.variable < 0
    kept = weights > 0.0
    shares = _shares(problem.information)
    is_strong = kept & (ranks == problem.freedom) & (shares.min(axis=1) > _WEAK)
    if is_connected(problem.edges[is_strong], fixed):
        return ()
    apart = loose(problem.edges[kept & (ranks > 0)], fixed)
    measured = np.where(shares > _LOST, np.sqrt(weights * kept)[:, None], 0.0)
    information = measured[:, :, None] * problem.information * measured[:, None, :]
    null = _null_space(problem, poses, information, problem.variable[apart])
    bodies = _bodies(problem, poses, null)
    axes = {body[0]: _axes(null[problem.variable[body[0]]]) for body in bodies}
    axes |= {pose: _AXES[problem.freedom][: 2 if problem.is_point[pose] else None] for pose in apart}
    bodies += list(apart[:, None])
    bodies.sort(key=lambda body: body[0])
    return tuple(FreePose(int(names[b[0]]), axes[b[0]], tuple(names[b[1:]].tolist())) for b in bodies)


def _bodies(problem: BetweenProblem, poses: Matrix, null: Matrix) -> list[NDArray[np.int64]]:
    """The poses that move in the null space (n, k, m), those together that have the same twists in the world."""
    moving = np.flatnonzero((np.abs(null) > _MOVES).any(axis=(1, 2)))
    middle = poses[problem.free, :-1, -1].mean(axis=0)
    centered = poses[problem.free[moving]]
    centered[:, :-1, -1] -= middle
    twists = (lie.adjoint(centered) @ null[moving]).reshape(len(moving), null.shape[1] * null.shape[2])
    largest = np.abs(twists).max(initial=0.0) or 1.0
    _, body = np.unique(np.round(twists / largest, 6), axis=0, return_inverse=True)
    body = np.where(problem.is_point[problem.free[moving]], len(moving) + np.arange(len(moving)), body.reshape(-1))
    return [problem.free[moving[body == one]] for one in np.unique(body)]


def _axes(null: Matrix) -> tuple[str, ...]:
    """The axes along which twists of one pose (k, m) lie."""
    U, values, _ = np.linalg.svd(null, full_matrices=False)
    reach = np.abs(U[:, values > _MOVES]).max(axis=1, initial=0.0)
    return tuple(axis for axis, size in zip(_AXES[len(null)], reach, strict=True) if size > _NAMED)


def weakly_joined(edges: NDArray[np.int64], information: Matrix, fixed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Poses that hang on edges of less than a millionth of the median information of positions and rotations."""
    return _hanging(edges, information, fixed, _WEAK)


def lost(edges: NDArray[np.int64], information: Matrix, fixed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Those of them whose edges have too little information to compute a position."""
    return _hanging(edges, information, fixed, _LOST)


def weak_text(names: NDArray[np.int64]) -> str:
    """The weakly joined poses as one line of text."""
    return f"{_group(names)} by edges of less than a millionth of the usual information"


def lost_text(names: NDArray[np.int64]) -> str:
    """The lost poses as one line of text."""
    hang = "hangs" if len(names) == 1 else "hang"
    return f"{_group(names)} {hang} on edges of next to no information, {_LOST:.0e} of the usual or less"


def _group(names: NDArray[np.int64]) -> str:
    return f"pose {names[0]}" if len(names) == 1 else f"poses {listed(names)} ({len(names):,})"


def _hanging(
    edges: NDArray[np.int64], information: Matrix, fixed: NDArray[np.bool_], share: float
) -> NDArray[np.int64]:
    """Poses joined to a fixed one only by edges of at most this share of the usual information."""
    return loose(edges[_shares(information).max(axis=1, initial=0.0) > share], fixed)


def _shares(information: Matrix) -> Matrix:
    """Diagonals of information matrices (E, k), over the medians for positions and rotations."""
    d = 2 if information.shape[-1] == 3 else 3
    result = np.einsum("eaa->ea", information).copy()
    for part in (result[:, :d], result[:, d:]):
        known = part[part > 0.0]
        part /= np.median(known) if len(known) else 1.0
    return result


def _null_space(problem: BetweenProblem, poses: Matrix, information: Matrix, apart: NDArray[np.int64]) -> Matrix:
    """Own-frame twists (n, k, m), at most 1, of all variables that change no edge; those ``apart`` are fixed."""
    pattern, k = problem.pattern, problem.freedom
    values = own_equations(problem, poses, information)
    is_turn = (np.arange(k) >= poses.shape[-1] - 1).astype(np.float64)
    is_rotation = problem.packing.rows(np.tile(is_turn, (len(problem.free), 1))) > 0.0
    diagonal = values[pattern.diagonal]
    largest = np.where(is_rotation, *(diagonal[kind].max(initial=0.0) for kind in (is_rotation, ~is_rotation)))
    is_nothing = diagonal <= _NOTHING * largest
    values[pattern.diagonal[is_nothing]] = 0.0
    prior = np.where(is_nothing, np.maximum(largest, 1.0), diagonal)
    is_apart = np.zeros(len(problem.free), np.bool_)
    is_apart[apart] = True
    held = np.where(np.repeat(is_apart, pattern.sizes), prior, 0.0)
    bare, vanished = values.copy(), list[int]()
    while len(vanished) <= _MOST:
        values[pattern.diagonal] = bare[pattern.diagonal] + held
        try:
            problem.cholesky.factorize(values)
            scalar = _overlooked(problem, poses, information, held, prior)
        except SingularMatrixError as error:
            scalar = error.scalar
        if scalar is None:
            break
        vanished.append(scalar)
        held = held + (
            prior if len(vanished) == _MOST else np.where(np.arange(pattern.scalars) == scalar, prior, 0.0)
        )
    if not vanished:
        return np.zeros((len(problem.free), k, 0))
    ends = np.zeros((pattern.scalars, len(vanished)))
    ends[vanished, np.arange(len(vanished))] = 1.0
    null = problem.packing.spread_rows(problem.cholesky.solve(ends))
    return null / np.abs(null).max(axis=(0, 1))


def _overlooked(
    problem: BetweenProblem,
    poses: Matrix,
    information: Matrix,
    held: NDArray[np.float64],
    prior: NDArray[np.float64],
) -> int | None:
    """The scalar that moves most in a direction that is free though no pivot vanished, from rounding; or none.

    The direction is the one that inverse iteration finds. What it changes is summed up edge by edge, where a free
    one leaves but the square of the rounding.
    """
    z = np.random.default_rng(0).normal(size=len(prior)) * np.sqrt(prior)
    for _ in range(3):
        z = problem.cholesky.solve(z / np.abs(z).max())
    blocks = np.concatenate([problem.packing.spread_rows(z), np.zeros((1, problem.freedom))])  # last: a fixed pose
    moved = [
        (J @ blocks[problem.variable[end], :, None])[..., 0]
        for J, end in zip(_own_jacobians(problem, poses), problem.edges.T, strict=True)
    ]
    change = np.einsum("ea,eab,eb->", sum(moved), information, sum(moved)) + (held * z**2).sum()
    if change > _FREE * (prior * z**2).sum():
        return None
    return int(np.argmax(prior * z**2))


def own_equations(problem: BetweenProblem, poses: Matrix, information: Matrix) -> NDArray[np.float64]:
    """Block values of H = Σ JᵀΩJ, with Ω (E, k, k), over twists of every pose in its own frame, T exp(ξ)."""
    k = problem.freedom
    J_i, J_j = _own_jacobians(problem, poses)
    blocks = np.zeros((len(problem.pattern.rows), k, k))
    slot_i, slot_j, pair = problem.slots.T
    for slot, J in ((slot_i, J_i), (slot_j, J_j)):
        np.add.at(blocks, slot[slot >= 0], (np.swapaxes(J, 1, 2) @ information @ J)[slot >= 0])
    coupling = np.swapaxes(J_i, 1, 2) @ information @ J_j
    coupling = np.where((slot_i > slot_j)[:, None, None], coupling, np.swapaxes(coupling, 1, 2))
    np.add.at(blocks, pair[pair >= 0], coupling[pair >= 0])
    return problem.packing.values(blocks)


def _own_jacobians(problem: BetweenProblem, poses: Matrix) -> tuple[Matrix, Matrix]:
    """Of the errors of all edges, (E, k, k), by own-frame twists of pose i and of pose j."""
    jacobian, adjoint = problem.jacobians(poses, problem.errors(poses)), lie.adjoint(poses)
    i, j = problem.edges.T
    return -jacobian @ adjoint[i], jacobian @ adjoint[j]
