"""Loop closures as evidence: those that contradict the trajectory, and the slips of wheels or scans they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.consistency import FEWEST, carried, connected
from scanchain.verdict.checks import Floats, Kind, Stretch

_LEAST_M = 0.5  # smallest contradiction of a closure that is checked
_NEAR_M = 10.0  # largest path between the ends of two closures of a group
_AGREE_M, _AGREE_SHARE = 0.2, 0.02  # largest difference of two that agree: meters, and share of the path between
_FINDABLE = 3000  # largest number of contradicting closures that are grouped; of more every n-th

_FEWEST, _MOST = 3, 20  # closures around a stretch that decide: at least, and the shortest of more
_MOST_PARTS = 8  # largest number of stretches within a closure that are told apart
_RATIO = 1.0 / 3.0  # of what is left unexplained by the right source and by the wrong one, at most
_EXPLAINED = 0.5  # share of a disagreement that the wrong source leaves, or that a jump of the wheels explains
_IMPOSSIBLE_M = 1.0  # smallest change of the wheels' motion from scan to scan that is a jump


@dataclass(frozen=True, slots=True)
class Closures:
    """Closures that verification accepted.

    Attributes
    ----------
    target, source : (C,) scans
    T_target_source : (C, d+1, d+1) as measured
    is_accepted : (C,) by the back end
    tried : number of scans from which any was tried, accepted or not, as the trajectory returned to a place
    """

    target: NDArray[np.int64]
    source: NDArray[np.int64]
    T_target_source: Matrix
    is_accepted: NDArray[np.bool_]
    tried: int = 0


def contradicting_groups(closures: Closures, poses: Matrix, seconds: Floats) -> list[Stretch]:
    """Scans that groups of closures span, at least three which agree, each far off the final poses (N, d+1, d+1).

    The motion from the first scan to the last is wrong by about as much, or the two places are alike.
    seconds : (N,) of the scans
    """
    if not len(closures.target):
        return []
    expected = lie.between(poses[closures.target], poses[closures.source])
    off = lie.between(expected, closures.T_target_source)[:, :-1, -1]
    size_m = np.linalg.norm(off, axis=1)
    chosen = np.flatnonzero(size_m > _LEAST_M)
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
        start_s, end_s = seconds[[first, last]].tolist()
        wrong_m = float(np.median(size_m[chosen][members]))
        groups.append(Stretch(Kind.LOOPS, first, last, len(members), start_s, end_s, wrong_m))
    return groups


def which_slipped(
    parts: Sequence[slice], odometry: Matrix, wheels: Matrix, closures: Closures
) -> list[tuple[Kind, float]]:
    """Which of scans and wheels slipped in each part of a trajectory where they disagree, and its error in m.

    A closure around a part measures once more where its two scans lie. It is predicted with the motion of each
    part by scans or by wheels, in every combination, and with that of the rest by either, in the directions
    of the scans. Of a part, the source is wrong without which the closures are predicted well, and with which they
    are not. Wheels that jump, which no vehicle does, need no closure. Where nothing tells, the wheels disagree.

    odometry, wheels : (N, d+1, d+1), of the lidar; wheels NaN where unknown
    """
    steps = np.nan_to_num(
        lie.between(wheels[:-1], wheels[1:])[:, :-1, -1] - lie.between(odometry[:-1], odometry[1:])[:, :-1, -1]
    )
    excess = np.zeros((len(odometry), odometry.shape[-1] - 1))  # of the wheels' path over that of the scans
    excess[1:] = np.cumsum(np.einsum("nij,nj->ni", odometry[:-1, :-1, :-1], steps), axis=0)
    ends = np.array([(max(part.start - 1, 0), part.stop - 1) for part in parts], np.int64).reshape(-1, 2)
    apart = excess[ends[:, 1]] - excess[ends[:, 0]]
    low, high = np.minimum(closures.target, closures.source), np.maximum(closures.target, closures.source)
    is_forward = (closures.target <= closures.source)[:, None, None]
    T_low_high = np.where(is_forward, closures.T_target_source, lie.inverse(closures.T_target_source))
    off = (odometry[low] @ T_low_high)[:, :-1, -1] - odometry[high][:, :-1, -1]
    found = []
    for place, (first, last) in enumerate(ends.tolist()):
        size_m = float(np.linalg.norm(apart[place]))
        jumps_m = [_largest_jump_m(poses[first : last + 1]) for poses in (wheels, odometry)]
        if jumps_m[0] > max(_IMPOSSIBLE_M + 2.0 * jumps_m[1], _EXPLAINED * size_m):
            found.append((Kind.WHEELS_SLIP, size_m))
            continue
        around = np.flatnonzero(closures.is_accepted & (low <= first) & (high >= last))
        around = around[np.argsort(high[around] - low[around], kind="stable")][:_MOST]
        left = []
        for closure in around.tolist():
            within = np.flatnonzero((ends[:, 0] >= low[closure]) & (ends[:, 1] <= high[closure]))
            if len(within) <= _MOST_PARTS:
                rest = excess[high[closure]] - excess[low[closure]] - apart[within].sum(axis=0)
                is_this = within == place
                left.append(
                    [_left_m(each, apart[within], is_this) for each in (off[closure], off[closure] - rest)]
                )
        found.append((_decided(np.array(left), size_m), size_m))
    return found


def _left_m(off: Floats, apart: Floats, is_this: Floats) -> tuple[float, float]:
    """Rest of ``off`` (d,) that the best combination of parts (K, d) leaves, with one by scans, by wheels."""
    by_wheels = np.array(list(product((0.0, 1.0), repeat=len(apart))))
    left_m = np.linalg.norm(off - by_wheels @ apart, axis=1)
    has_this = by_wheels @ is_this > 0.0
    return float(left_m[~has_this].min()), float(left_m[has_this].min())


def _decided(left_m: Floats, size_m: float) -> Kind:
    """By what closures leave (C, 2, 2), with the rest by scans, by wheels, with the part by scans, by wheels."""
    if len(left_m) < _FEWEST:
        return Kind.WHEELS
    by_scans, by_wheels = np.median(left_m, axis=0).T
    for right, wrong, slipped in ((by_scans, by_wheels, Kind.WHEELS_SLIP), (by_wheels, by_scans, Kind.SCANS_SLIP)):
        if (right <= _RATIO * wrong).all() and (wrong >= _EXPLAINED * size_m).all():
            return slipped
    return Kind.WHEELS


def _largest_jump_m(poses: Matrix) -> float:
    """Largest change of the motion from scan to scan; 0 where it is unknown."""
    changes_m = np.linalg.norm(np.diff(poses[:, :-1, -1], n=2, axis=0), axis=1)
    return float(np.nan_to_num(changes_m).max(initial=0.0))
