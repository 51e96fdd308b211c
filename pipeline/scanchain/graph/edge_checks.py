"""Checks of a pose graph's edges: numbers, positive semidefiniteness, rank, connectivity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from scanchain.checks import LARGEST
from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.kernels.geometry.validity import largest_magnitude

_NO_INFORMATION = 1e-9  # eigenvalue of a matrix of unit diagonal up to which a direction is not measured
_ROUNDING = 1e-6  # share of the largest entry that a negative eigenvalue may have, from printed digits


def check_edges(edges: NDArray[np.int64], measurements: Matrix, information: Matrix, pose_count: int) -> None:
    """Refuse edges to unknown poses, from a pose to itself, or with impossible numbers."""
    is_sound = positive_semidefinite(information)
    largest = max(largest_magnitude(each.reshape(-1, each.shape[-1])) for each in (measurements, information))
    is_known = edges.min(initial=0) >= 0 and edges.max(initial=-1) < pose_count
    if is_known and is_sound.all() and largest <= LARGEST and (edges[:, 0] != edges[:, 1]).all():
        return
    lowest, highest = edges.min(axis=1, initial=0), edges.max(axis=1, initial=-1)
    for index in np.flatnonzero((lowest < 0) | (highest >= pose_count))[:1]:
        i, j = edges[index]
        raise InputError(f"edge {i}-{j} joins a pose that is not there: the graph has {pose_count}; add it first")
    for index in np.flatnonzero(edges[:, 0] == edges[:, 1])[:1]:
        i, j = edges[index]
        raise InputError(f"edge {i}-{j} joins a pose to itself; remove it")
    for numbers, what in ((measurements, "measurement"), (information, "information")):
        largest = np.abs(numbers).max(axis=(1, 2), initial=0.0)
        for index in np.flatnonzero(np.isfinite(largest) & (largest > LARGEST))[:1]:
            i, j = edges[index]
            raise InputError(
                f"edge {i}-{j}: {what} of {largest[index]:g}, over {LARGEST:g}; give meters and radians, "
                "and an inverse covariance of these"
            )
    for index in np.flatnonzero(~is_sound)[:1]:
        i, j = edges[index]
        raise InputError(
            f"edge {i}-{j}: information matrix is not symmetric positive semidefinite; give an inverse covariance"
        )


def positive_semidefinite(information: Matrix) -> NDArray[np.bool_]:
    """True for each of the matrices (E, k, k) that is finite, symmetric and positive semidefinite, (E,)."""
    largest = np.abs(information).max(axis=(1, 2), initial=0.0)
    is_finite = np.isfinite(largest)
    known = np.where(is_finite[:, None, None], information, 0.0)
    margin = np.where(is_finite, _ROUNDING * largest, 0.0)
    asymmetry = np.abs(known - np.swapaxes(known, 1, 2)).max(axis=(1, 2), initial=0.0)
    return is_finite & (asymmetry <= margin) & (np.linalg.eigvalsh(known)[:, 0] >= -margin)


def nearest_semidefinite(information: Matrix) -> Matrix:
    """The positive semidefinite matrix nearest to each symmetric one (E, k, k), V max(Λ, 0) Vᵀ (Higham 1988)."""
    values, vectors = np.linalg.eigh(information)
    projected = (vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return 0.5 * (projected + np.swapaxes(projected, 1, 2))


def ranks(information: Matrix) -> NDArray[np.int64]:
    """Rank of each of the positive semidefinite matrices (E, k, k), whatever their units, (E,)."""
    diagonal = np.einsum("eaa->ea", information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    correlation = scale[:, :, None] * information * scale[:, None, :]
    return np.count_nonzero(np.linalg.eigvalsh(correlation) > _NO_INFORMATION, axis=1)


def check_connected(edges: NDArray[np.int64], fixed: NDArray[np.bool_], names: NDArray[np.int64]) -> None:
    """Refuse a graph with poses that no chain of edges joins to a fixed one; ``names`` (K,) are the poses'."""
    if not len(fixed):
        raise InputError("the pose graph has no poses; add some before optimizing")
    apart = loose(edges, fixed)
    if len(apart):
        raise InputError(
            f"pose graph: {len(apart)} of {len(fixed)} poses are not joined to a fixed one:"
            f" {listed(names[apart])}; add edges to them whose information is not zero, or fix one of them"
        )


def is_connected(edges: NDArray[np.int64], fixed: NDArray[np.bool_]) -> bool:
    """True if a chain of these edges joins every pose to a fixed one."""
    return not len(loose(edges, fixed))


def loose(edges: NDArray[np.int64], fixed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Poses that no chain of edges joins to a fixed one."""
    _, part = _parts(edges, len(fixed))
    return np.flatnonzero(~np.isin(part, part[fixed]))


def has_loop(edges: NDArray[np.int64], pose_count: int) -> bool:
    """True if there are more edges than a spanning forest of them has."""
    return len(edges) > pose_count - _parts(edges, pose_count)[0]


def _parts(edges: NDArray[np.int64], pose_count: int) -> tuple[int, NDArray[np.int32]]:
    """Number of connected components of the poses, and the component of each pose."""
    links = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(pose_count, pose_count))
    return connected_components(links, directed=False)


def listed(names: NDArray[np.int64]) -> str:
    """These names, ascending, as text: "3, 5 to 9"; the first eight where they are scattered."""
    runs = np.split(names, 1 + np.flatnonzero(np.diff(names) != 1))
    shown = [f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run.tolist())) for run in runs[:8]]
    return ", ".join(shown) + (", ..." if len(runs) > 8 else "")
