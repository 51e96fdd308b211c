"""Which poses the edges in force leave free, and in which directions: the null space of the normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.data import Matrix
from pipeline.graph.between import BetweenProblem
from pipeline.graph.cholesky import SingularMatrixError
from pipeline.graph.soundness import is_connected, listed, loose

_AXES = {3: ("x", "y", "yaw"), 6: ("x", "y", "z", "roll", "pitch", "yaw")}
_MOST = 100  # directions of the null space that are looked for
_MOVES = 1e-6  # share of the largest component of a null vector below which a pose stays where it is
_NAMED = 1e-2  # component of a direction from which its axis is named
_NOTHING = 1e-20  # share of the largest entry of its kind up to which a diagonal entry is rounding noise
_WEAK = 1e-6  # share of the median information up to which an edge is a weak one


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
        more = f" and {len(self.followers):,} that move with it" if self.followers else ""
        return f"{self.name} ({', '.join(self.axes)}){more}"


def free_text(free: Sequence[FreePose]) -> str:
    """One line for people: how many poses are free, and which in what."""
    shown = ", ".join(map(str, free[:8])) + (", ..." if len(free) > 8 else "")
    count = sum(1 + len(pose.followers) for pose in free)
    return f"the edges leave {count:,} pose{'s' * (count != 1)} free: {shown}"


def free_poses(
    problem: BetweenProblem,
    poses: Matrix,
    weights: NDArray[np.float64],
    ranks: NDArray[np.int64],
    names: NDArray[np.int64],
) -> tuple[FreePose, ...]:
    """Poses with directions of their own frames in which no edge holds them, at these poses and weights (E,).

    ranks (E,) are those of the information matrices. Where edges of full rank join every pose to a fixed one,
    nothing is free. Else the normal equations are factored, and every pivot that vanishes gets a prior: with
    H' = H + Σ h e eᵀ over these, the null space of H is spanned by the columns of H'⁻¹ e.
    """
    fixed = problem.variable < 0
    kept = weights > 0.0
    is_full = kept & (ranks == problem.freedom)
    if is_connected(problem.edges[is_full], fixed):
        return ()
    apart = loose(problem.edges[kept & (ranks > 0)], fixed)
    null = _null_space(problem, poses, weights * kept, problem.variable[apart])
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
    centred = poses[problem.free[moving]]
    centred[:, :-1, -1] -= middle
    twists = (lie.adjoint(centred) @ null[moving]).reshape(len(moving), null.shape[1] * null.shape[2])
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
    d = 2 if information.shape[-1] == 3 else 3
    diagonal = np.einsum("eaa->ea", information)
    share = np.zeros(len(edges))
    for part in (diagonal[:, :d].sum(axis=1), diagonal[:, d:].sum(axis=1)):
        if (part > 0.0).any():
            share = np.maximum(share, part / np.median(part[part > 0.0]))
    return loose(edges[share > _WEAK], fixed)


def weak_text(names: NDArray[np.int64]) -> str:
    """One line for people."""
    return f"by edges of less than a millionth of the usual information: {len(names):,} poses, {listed(names)}"


def _null_space(
    problem: BetweenProblem, poses: Matrix, weights: NDArray[np.float64], apart: NDArray[np.int64]
) -> Matrix:
    """Own-frame twists (n, k, m), at most 1, of all variables that change no edge; those ``apart`` are held."""
    pattern, k = problem.pattern, problem.freedom
    values = problem.packing.values(_own_blocks(problem, poses, weights))
    is_turn = (np.arange(k) >= poses.shape[-1] - 1).astype(np.float64)
    is_rotation = problem.packing.rows(np.tile(is_turn, (len(problem.free), 1))) > 0.0
    diagonal = values[pattern.diagonal]
    largest = np.where(is_rotation, *(diagonal[kind].max(initial=0.0) for kind in (is_rotation, ~is_rotation)))
    is_nothing = diagonal <= _NOTHING * largest
    values[pattern.diagonal[is_nothing]] = 0.0
    prior = np.where(is_nothing, np.maximum(largest, 1.0), diagonal)
    is_apart = np.zeros(len(problem.free), np.bool_)
    is_apart[apart] = True
    values[pattern.diagonal] += np.where(np.repeat(is_apart, pattern.sizes), prior, 0.0)
    vanished: list[int] = []
    while len(vanished) < _MOST:
        try:
            problem.cholesky.factorise(values)
            break
        except SingularMatrixError as error:
            vanished.append(error.scalar)
            values[pattern.diagonal[error.scalar]] += prior[error.scalar]
    else:
        values[pattern.diagonal] += prior
        problem.cholesky.factorise(values)
    if not vanished:
        return np.zeros((len(problem.free), k, 0))
    ends = np.zeros((pattern.scalars, len(vanished)))
    ends[vanished, np.arange(len(vanished))] = 1.0
    null = problem.packing.spread_rows(problem.cholesky.solve(ends))
    return null / np.abs(null).max(axis=(0, 1))


def _own_blocks(problem: BetweenProblem, poses: Matrix, weights: NDArray[np.float64]) -> Matrix:
    """Blocks of H = Σ w JᵀΩJ over twists of every pose in its own frame, T exp(ξ)."""
    k, (i, j) = problem.freedom, problem.edges.T
    jacobian, adjoint = problem.jacobians(poses, problem.errors(poses)), lie.adjoint(poses)
    J_i, J_j = -jacobian @ adjoint[i], jacobian @ adjoint[j]
    weighed = weights[:, None, None] * problem.information
    blocks = np.zeros((len(problem.pattern.rows), k, k))
    slot_i, slot_j, pair = problem.slots.T
    for slot, J in ((slot_i, J_i), (slot_j, J_j)):
        np.add.at(blocks, slot[slot >= 0], (np.swapaxes(J, 1, 2) @ weighed @ J)[slot >= 0])
    coupling = np.swapaxes(J_i, 1, 2) @ weighed @ J_j
    coupling = np.where((slot_i > slot_j)[:, None, None], coupling, np.swapaxes(coupling, 1, 2))
    np.add.at(blocks, pair[pair >= 0], coupling[pair >= 0])
    return blocks
