"""Loop closures that agree with each other and contradict the trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scanchain import lie
from scanchain.data import Matrix
from scanchain.verdict.checks import Floats

LEAST_M = 0.5  # smallest contradiction of a closure that is checked
_FEWEST = 3  # closures of a group; fewer may agree by chance
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
    if len(chosen) < _FEWEST:
        return []
    target, source, T = closures.target[chosen], closures.source[chosen], closures.T_target_source[chosen]
    agree = _agreement(target, source, T, poses)
    groups = []
    labels = connected_components(coo_array(agree), directed=False)[1]
    for label in range(labels.max() + 1):
        members = labels == label
        count = int(members.sum())
        if count >= _FEWEST:
            low, high = np.minimum(target, source)[members], np.maximum(target, source)[members]
            first, last = int(low.max()), int(high.min())
            if first >= last:
                first, last = int(low.min()), int(high.max())
            groups.append(Group(first, last, count, float(np.median(size_m[chosen][members]))))
    return groups


def _agreement(
    target: NDArray[np.int64], source: NDArray[np.int64], T: Matrix, poses: Matrix
) -> NDArray[np.bool_]:
    """(C, C) pairs of closures that predict each other along short parts of the path."""
    steps_m = np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)
    path_m: Floats = np.concatenate([[0.0], np.cumsum(steps_m)])
    agree = np.zeros((len(target), len(target)), np.bool_)
    for i in range(len(target)):
        between_m = np.abs(path_m[target] - path_m[target[i]]) + np.abs(path_m[source] - path_m[source[i]])
        near = np.flatnonzero(between_m < _NEAR_M)
        before = lie.between(poses[np.full(len(near), target[i])], poses[target[near]])
        after = lie.between(poses[source[near]], poses[np.full(len(near), source[i])])
        predicted = before @ T[near] @ after
        off_m = np.linalg.norm(predicted[:, :-1, -1] - T[i, :-1, -1], axis=1)
        agree[i, near] = off_m < _AGREE_M + _AGREE_SHARE * between_m[near]
    return agree
