"""Covariances of poses from the Cholesky factor of H, without forming its inverse; written as a CSV table."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanchain.data import Integers, Matrix, Vector
from scanchain.errors import InputError
from scanchain.files import write_whole
from scanchain.graph.factors import turns
from scanchain.graph.problem import GraphProblem

_NAMES = {3: ("x", "y", "yaw"), 6: ("x", "y", "z", "roll", "pitch", "yaw")}


def responses(problem: GraphProblem, i: int, j: int) -> Matrix:
    """Cov(ξ, ξ_j − ξ_i), (K, k, k), of the left twists of all poses, by k solves with the factor of H."""
    result = np.zeros((len(problem.variable), problem.freedom, problem.freedom))
    result[j] += np.eye(problem.freedom)
    result[i] -= np.eye(problem.freedom)
    packing = problem.packing
    result[problem.free] = packing.unpacked(problem.cholesky.solve(packing.packed(result[problem.free])))
    result[problem.variable < 0] = 0.0
    return result


def difference_covariances(problem: GraphProblem, pairs: Integers) -> Matrix:
    """Cov(ξ_j − ξ_i, ξ_b − ξ_a), (P, P, k, k), at [(a, b), (i, j)], of the left twists of pairs (P, 2) of poses.

    Only the part of the factor of H between these poses and the root of the elimination tree is used.
    """
    k, count = problem.freedom, len(pairs)
    ends = problem.variable[pairs]
    variables = np.unique(ends[ends >= 0])
    place = np.where(ends >= 0, np.searchsorted(variables, ends), len(variables))  # the last: fixed poses
    moves = np.zeros((len(variables) + 1, k, count, k))
    for pair, (i, j) in enumerate(place.tolist()):
        moves[j, :, pair] += np.eye(k)
        moves[i, :, pair] -= np.eye(k)
    kept = np.arange(k) < problem.pattern.sizes[variables, None]
    packed = moves[:-1][kept].reshape(-1, count * k)
    joint = problem.cholesky.covariance_of(packed, variables).reshape(count, k, count, k)
    return np.ascontiguousarray(joint.transpose(2, 0, 1, 3))


def inverse_blocks(problem: GraphProblem) -> Matrix:
    """Blocks (…, k, k) of H⁻¹ where H may be nonzero, and at index −1 a block of zeros for fixed poses."""
    blocks = problem.packing.blocks(problem.cholesky.inverse_blocks())
    return np.concatenate([blocks, np.zeros((1, *blocks.shape[1:]))])


def edge_covariances(problem: GraphProblem, blocks: Matrix) -> Matrix:
    """Cov(ξ_j − ξ_i), (E, k, k), of the left twists at the ends of every edge, from ``inverse_blocks``."""
    i, j, pair = problem.slots.T
    return blocks[i] + blocks[j] - blocks[pair] - np.swapaxes(blocks[pair], 1, 2)


def displacements(problem: GraphProblem, poses: Matrix, weight: Vector, changes: Matrix) -> Matrix:
    """First-order changes (G, K, k) of all poses when the measured motions T_ij become T_ij exp(change).

    changes : (G, E, k) twists in the frame of j. The left twists ξ of the poses solve H ξ = Σ w JᵀΩ change;
    the result contains changes of position and orientation along the world's axes.
    """
    result = np.zeros((len(changes), len(poses), problem.freedom))
    for moved, change in zip(result, changes, strict=True):
        gradient = problem.linearize(poses, change, weight).gradient
        moved[problem.free] = _moved(problem, poses, problem.cholesky.solve(gradient))
    return result


def pose_errors(problem: GraphProblem, poses: Matrix, count: int, seed: int) -> Matrix:
    """Errors (count, K, k) of all poses, sampled from their joint distribution; those of fixed poses are zero.

    In the linearized problem with H = Uᵀ U, left twists ξ = U⁻¹ z, with z standard normal, move a position t by
    ρ + φ × t. (Moving the poses by exp(ξ) would overstate large errors.) The result contains this displacement
    and φ, along the world's axes.
    """
    random = np.random.default_rng(seed)
    errors = np.zeros((count, len(poses), problem.freedom))
    for k in range(count):
        sampled = problem.cholesky.draw(random.normal(size=problem.pattern.scalars))
        errors[k, problem.free] = _moved(problem, poses, sampled)
    return errors


def _moved(problem: GraphProblem, poses: Matrix, packed: Vector) -> Matrix:
    """Changes (n, k) of position and orientation of the free poses by left twists."""
    d = poses.shape[-1] - 1
    twists = problem.packing.unpacked(packed)
    twists[:, :d] += (turns(poses[problem.free, :d, d]) @ twists[:, d:, None])[..., 0]
    return twists


def chosen_poses(text: str, ids: Integers) -> Integers:
    """Integers in ``ids`` (K,) of the poses named by ``all`` or ``0,7,12``."""
    if text.strip() == "all":
        return np.arange(len(ids))
    try:
        wanted = [int(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"--marginals is {text!r}; give all, or vertex ids separated by commas") from None
    place = {name: index for index, name in enumerate(ids.tolist())}
    for unknown in sorted(set(wanted) - set(place))[:1]:
        raise InputError(f"--marginals {unknown}: no such vertex; the ids go from {ids.min()} to {ids.max()}")
    return np.array([place[name] for name in wanted])


def write_covariances(path: Path, ids: Integers, covariances: Matrix) -> None:
    """Write a CSV file with one line per pose: its id and the upper triangle of its covariance (K, k, k).

    The twists are in the pose's own frame, T exp(ξ), order (translation, rotation): m², m rad, rad². Raises
    OSError.
    """
    names = _NAMES[covariances.shape[-1]]
    upper = np.triu_indices(len(names))
    header = ["id", *(f"{names[a]}_{names[b]}" for a, b in zip(*upper, strict=True))]
    rows = zip(ids.tolist(), covariances[:, *upper].tolist(), strict=True)
    lines = [header, *([str(name), *map(repr, row)] for name, row in rows)]
    write_whole(path, "".join(f"{','.join(line)}\r\n" for line in lines).encode())
