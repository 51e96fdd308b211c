"""Loop closures that agree with each other and contradict the trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.robust.groups import FEWEST, carried, connected

LEAST_M = 0.5  # smallest contradiction of a closure that is checked
_NEAR_M = 10.0  # largest path between the ends of two closures of a group
_AGREE_M, _AGREE_SHARE = 0.2, 0.02  # largest difference of two that agree: meters, and share of the path between
_FINDABLE = 3000  # largest number of contradicting closures that are grouped; of more every n-th


@dataclass(frozen=True, slots=True)
class Closures:
    """Closures that verification accepted.

    Attributes
    ----------
    target, source : (C,) scans
    T_target_source : (C, d+1, d+1) as measured
    is_accepted : (C,) by the back end
    tried : number of all, accepted or not, that were tried as the trajectory returned to a place
    """

    target: NDArray[np.int64]
    source: NDArray[np.int64]
    T_target_source: Matrix
    is_accepted: NDArray[np.bool_]
    tried: int = 0


class Group(NamedTuple):
    """Closures that agree with each other: scans that all of them span, their number, and contradiction in meters.

    The motion from the first scan to the last is wrong by that much, or the two places are alike.
    """

    first: int
    last: int
    closures: int
    size_m: float


def contradicting_groups(closures: Closures, poses: Matrix) -> list[Group]:
    """Groups of at least three closures, each more than ``LEAST_M`` off the final poses (N, d+1, d+1)."""
    if not len(closures.target):
        return []
    expected = lie.between(poses[closures.target], poses[closures.source])
    off = lie.between(expected, closures.T_target_source)[:, :-1, -1]
    size_m = np.linalg.norm(off, axis=1)
    chosen = np.flatnonzero(size_m > LEAST_M)
    chosen = chosen[:: max(1, -(-len(chosen) // _FINDABLE))]
    if len(chosen) < FEWEST:
        return []
    edges, T = np.stack([closures.target, closures.source], axis=1)[chosen], closures.T_target_source[chosen]
    steps_m = np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])[edges]

    def agree(a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.bool_]:
        off_m = np.linalg.norm((carried(poses, edges[a], T[a], edges[b]) - T[b])[:, :-1, -1], axis=1)
        return off_m < _AGREE_M + _AGREE_SHARE * np.abs(along_m[a] - along_m[b]).sum(axis=1)

    pairs = KDTree(along_m).query_pairs(_NEAR_M, p=1, output_type="ndarray")
    groups = []
    for members in connected(np.concatenate([pairs, pairs[:, ::-1]]), len(chosen), agree):
        low, high = edges[members].min(axis=1), edges[members].max(axis=1)
        first, last = int(low.max()), int(high.min())
        if first >= last:
            first, last = int(low.min()), int(high.max())
        groups.append(Group(first, last, len(members), float(np.median(size_m[chosen][members]))))
    return groups
