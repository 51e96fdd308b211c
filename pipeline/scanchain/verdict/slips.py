"""Slips of wheels or of scans where the two disagree: of the one that other evidence contradicts."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from itertools import product

import numpy as np

from scanchain import lie
from scanchain.data import Matrix
from scanchain.verdict.checks import Floats
from scanchain.verdict.loops import Closures

_FEWEST, _MOST = 3, 20  # closures around a stretch that decide: at least, and the shortest of more
_MOST_PARTS = 8  # largest number of stretches within a closure that are told apart
_RATIO = 1.0 / 3.0  # of what is left unexplained by the right source and by the wrong one, at most
_EXPLAINED = 0.5  # share of a disagreement that the wrong source leaves, or that a jump of the wheels explains
_IMPOSSIBLE_M = 1.0  # smallest change of the wheels' motion from scan to scan that is a jump


class Slipped(Enum):
    """The source of evidence that is wrong."""

    UNKNOWN = 0
    SCANS = 1
    WHEELS = 2


def which_slipped(
    parts: Sequence[slice], odometry: Matrix, wheels: Matrix, closures: Closures
) -> list[tuple[Slipped, float]]:
    """The wrong one of scans and wheels in each part of a trajectory where they disagree, and its error in m.

    A closure around a part measures once more where its two scans lie. It is predicted with the motion of each
    part by scans or by wheels, in every combination, and with that of the rest by either, in the directions
    of the scans. Of a part, the source is wrong without which the closures are predicted well, and with which they
    are not. Wheels that jump, which no vehicle does, need no closure.
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
            found.append((Slipped.WHEELS, size_m))
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


def _decided(left_m: Floats, size_m: float) -> Slipped:
    """By what closures leave (C, 2, 2), with the rest by scans, by wheels, with the part by scans, by wheels."""
    if len(left_m) < _FEWEST:
        return Slipped.UNKNOWN
    by_scans, by_wheels = np.median(left_m, axis=0).T
    for right, wrong, slipped in ((by_scans, by_wheels, Slipped.WHEELS), (by_wheels, by_scans, Slipped.SCANS)):
        if (right <= _RATIO * wrong).all() and (wrong >= _EXPLAINED * size_m).all():
            return slipped
    return Slipped.UNKNOWN


def _largest_jump_m(poses: Matrix) -> float:
    """Largest change of the motion from scan to scan; 0 where it is unknown."""
    changes_m = np.linalg.norm(np.diff(poses[:, :-1, -1], n=2, axis=0), axis=1)
    return float(np.nan_to_num(changes_m).max(initial=0.0))
