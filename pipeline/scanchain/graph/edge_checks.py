"""Checks of the edges of a graph: valid numbers, connectivity, and poses that the edges leave free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from scanchain import lie
from scanchain.checks import LARGEST
from scanchain.data import Integers, Mask, Matrix, Vector
from scanchain.errors import InputError, counted
from scanchain.graph.cholesky import SingularMatrixError
from scanchain.graph.factors import ORIGIN
from scanchain.graph.problem import GraphProblem
from scanchain.kernels.geometry import largest_magnitude

_MOST = 100  # largest number of directions of the null space that are computed
_FREE = 1e-11  # share of a diagonal entry of H up to which its pivot in the factorization counts as zero
_WEAK = 1e-6  # share of the median information up to which an edge is weak
_LOST = 1e-10  # share of the median information up to which an axis of an edge is lost to rounding in H


def free_text(names: Integers) -> str:
    """Number and names of free poses as one line of text."""
    return f"the edges leave {counted(len(names), 'pose')} free: {listed(names)}"


def free_poses(
    problem: GraphProblem, poses: Matrix, weights: Vector, ranks: Integers, names: Integers
) -> Integers:
    """Names of the poses that move in some direction without any change of χ², at these poses and weights (E,).

    ranks (E,) are those of the information matrices. If edges of full rank, weak along no axis, join every pose to
    a fixed one, no pose is free. Otherwise the free poses are those that move in the null space of H, which is
    computed without the axes along which an edge has almost no information. Every vanishing pivot of H gets a
    prior; with H' = H + Σ h e eᵀ over these, the null space is spanned by the columns of H'⁻¹ e, each of which
    moves only one of these scalars.
    """
    pattern, kept, shares = problem.pattern, weights > 0.0, _shares(problem.information)
    is_strong = kept & (ranks == problem.freedom) & (shares.min(axis=1) > _WEAK)
    if is_connected(problem.edges[is_strong], problem.variable < 0):
        return names[:0]
    measured = np.where(shares > _LOST, np.sqrt(weights * kept)[:, None], 0.0)
    values = own_equations(problem, poses, measured[:, :, None] * problem.information * measured[:, None, :])
    diagonal = values[pattern.diagonal]
    largest = diagonal.max(initial=0.0)
    diagonal[diagonal <= 1e-20 * largest] = 0.0  # rounding noise
    prior = np.where(diagonal > 0.0, diagonal, max(largest, 1.0))
    held, vanished = np.zeros(pattern.scalars), list[int]()
    while len(vanished) <= _MOST:
        values[pattern.diagonal] = diagonal + held
        try:
            problem.cholesky.factorize(values, _FREE)
            break
        except SingularMatrixError as error:
            vanished.append(error.scalar)
        which = vanished[-1] if len(vanished) < _MOST else slice(None)
        held[which] = prior[which]
    ends = np.zeros((pattern.scalars, len(vanished)))
    ends[vanished, np.arange(len(vanished))] = 1.0
    null = np.abs(problem.packing.unpacked(problem.cholesky.solve(ends)))
    # a pose with a smaller component does not move
    return names[problem.free[(null > 1e-6 * null.max(axis=(0, 1), initial=0.0)).any(axis=(1, 2))]]


def weakly_joined(edges: Integers, information: Matrix, fixed: Mask) -> Integers:
    """Poses joined to a fixed one only by edges of less than a millionth of the median information."""
    return loose(edges[_shares(information).max(axis=1, initial=0.0) > _WEAK], fixed)


def weak_text(names: Integers) -> str:
    """Poses constrained only by weak edges, as one line of text."""
    group = f"pose {names[0]}" if len(names) == 1 else f"poses {listed(names)} ({len(names):,})"
    return f"{group} by edges of less than a millionth of the usual information"


def _shares(information: Matrix) -> Matrix:
    """Diagonals (E, k) of information matrices, divided by the medians for positions and rotations."""
    d = 2 if information.shape[-1] == 3 else 3
    result = np.einsum("eaa->ea", information).copy()
    for part in (result[:, :d], result[:, d:]):
        known = part[part > 0.0]
        part /= np.median(known) if len(known) else 1.0
    return result


def own_equations(problem: GraphProblem, poses: Matrix, information: Matrix) -> Vector:
    """Block values of H = Σ JᵀΩJ, with Ω (E, k, k), over twists of every pose in its own frame, T exp(ξ)."""
    jacobian, adjoint = problem.jacobians(poses, problem.errors(poses)), lie.adjoint(poses)
    i, j = problem.edges.T
    J_i, J_j = -jacobian @ adjoint[i], jacobian @ adjoint[j]
    J_i_t, J_j_t = np.swapaxes(J_i, 1, 2), np.swapaxes(J_j, 1, 2)
    blocks = problem.scattered(J_i_t @ information @ J_i, J_j_t @ information @ J_j, J_i_t @ information @ J_j)
    return problem.packing.values(blocks)


def check_edges(
    edges: Integers, measurements: Matrix, information: Matrix, pose_count: int, *, with_origin: bool = False
) -> None:
    """Raise InputError for edges to unknown poses, from a pose to itself, or with invalid numbers.

    with_origin : whether edges may begin at the origin of the world
    """
    least = np.array([ORIGIN if with_origin else 0, 0])
    is_known = ((edges >= least) & (edges < pose_count)).all(axis=1)
    is_sound = positive_semidefinite(information)
    largest = max(largest_magnitude(each.reshape(-1, each.shape[-1])) for each in (measurements, information))
    if is_known.all() and is_sound.all() and largest <= LARGEST and (edges[:, 0] != edges[:, 1]).all():
        return
    faults = [
        (~is_known, f" joins a pose that is not there: the graph has {pose_count}; add it first"),
        (edges[:, 0] == edges[:, 1], " joins a pose to itself; remove it"),
    ]
    limit = f"over {LARGEST:g}; give meters and radians, and an inverse covariance of these"
    for what, matrices in (("measurement", measurements), ("information", information)):
        size = np.abs(matrices).max(axis=(1, 2), initial=0.0)
        largest = size.max(initial=LARGEST)
        faults.append(((size > LARGEST) & (size == largest), f": {what} of {largest:g}, {limit}"))
    text = ": information matrix is not symmetric positive semidefinite; give an inverse covariance"
    for is_bad, words in [*faults, (~is_sound, text)]:
        for i, j in edges[is_bad][:1].tolist():
            raise InputError(f"{f'factor of pose {j}' if with_origin and i == ORIGIN else f'edge {i}-{j}'}{words}")


def positive_semidefinite(information: Matrix) -> Mask:
    """True for each of the finite matrices (E, k, k) that is symmetric and positive semidefinite, (E,)."""
    margin = 1e-6 * np.abs(information).max(axis=(1, 2), initial=0.0)  # of printed digits
    asymmetry = np.abs(information - np.swapaxes(information, 1, 2)).max(axis=(1, 2), initial=0.0)
    return (asymmetry <= margin) & (np.linalg.eigvalsh(information)[:, 0] >= -margin)


def nearest_semidefinite(information: Matrix) -> Matrix:
    """The positive semidefinite matrix nearest to each symmetric one (E, k, k), V max(Λ, 0) Vᵀ (Higham 1988)."""
    values, vectors = np.linalg.eigh(information)
    projected = (vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return 0.5 * (projected + np.swapaxes(projected, 1, 2))


def ranks(information: Matrix) -> Integers:
    """Rank of each of the positive semidefinite matrices (E, k, k), whatever their units, (E,)."""
    diagonal = np.einsum("eaa->ea", information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    correlation = scale[:, :, None] * information * scale[:, None, :]
    return np.count_nonzero(np.linalg.eigvalsh(correlation) > 1e-9, axis=1)  # of unit diagonal


def check_connected(edges: Integers, fixed: Mask, names: Integers) -> None:
    """Raise InputError if no chain of edges joins some pose to a fixed one.

    fixed : of the poses, and perhaps the origin after them; names : (K,) of the poses
    """
    if not len(names):
        raise InputError("the pose graph has no poses; add some before optimizing")
    apart = loose(edges, fixed)
    if len(apart):
        raise InputError(
            f"pose graph: {len(apart)} of {len(names)} poses are not joined to a fixed one:"
            f" {listed(names[apart])}; add edges to them whose information is not zero, or fix one of them"
        )


def is_connected(edges: Integers, fixed: Mask) -> bool:
    """True if a chain of these edges joins every pose to a fixed one."""
    return not len(loose(edges, fixed))


def loose(edges: Integers, fixed: Mask) -> Integers:
    """Poses that no chain of edges joins to a fixed one."""
    _, part = _parts(edges, len(fixed))
    return np.flatnonzero(~np.isin(part, part[fixed]))


def first_of_unjoined(edges: Integers, fixed: Mask) -> Integers:
    """First pose of every component without a fixed pose, ascending."""
    _, part = _parts(edges, len(fixed))
    first = np.unique(part, return_index=True)[1]
    return np.sort(first[~np.isin(part[first], part[fixed])])


def has_loop(edges: Integers, pose_count: int) -> bool:
    """True if there are more edges than in a spanning forest."""
    return len(edges) > pose_count - _parts(edges, pose_count)[0]


def skip_poses(edges: Integers, is_point: Mask) -> Mask:
    """True for edges (E, 2) between non-consecutive poses, neither of them a point; is_point (K,)."""
    return (np.abs(edges[:, 1] - edges[:, 0]) != 1) & ~is_point[edges].any(axis=1)


def _parts(edges: Integers, pose_count: int) -> tuple[int, NDArray[np.int32]]:
    """Number of connected components of the poses, and the component of each pose."""
    links = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(pose_count, pose_count))
    return connected_components(links, directed=False)


def listed(names: Integers) -> str:
    """These names, ascending, as text: "3, 5 to 9"; the first eight where they are scattered."""
    runs = np.split(names, 1 + np.flatnonzero(np.diff(names) != 1))
    shown = [f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run.tolist())) for run in runs[:8]]
    return ", ".join(shown) + (", ..." if len(runs) > 8 else "")
