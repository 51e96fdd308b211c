"""Which slipped where wheels and scans disagree: the one that two other sources of evidence contradict."""

from __future__ import annotations

from enum import Enum

import numpy as np

from scanchain import lie
from scanchain.data import Matrix
from scanchain.verdict.loops import Closures

_FEWEST, _MOST = 3, 20  # closures around a stretch that decide: at least, and the shortest of more
_RATIO = 1.0 / 3.0  # of the contradictions of closures by one source and by the other, up to which they decide
_EXPLAINED = 0.5  # share of a disagreement that a jump of the wheels must explain
_IMPOSSIBLE_M = 1.0  # smallest change of the wheels' motion from scan to scan that is a jump


class Slipped(Enum):
    """The source of evidence that is wrong."""

    UNKNOWN = 0
    SCANS = 1
    WHEELS = 2


def slipped(first: int, last: int, size_m: float, odometry: Matrix, wheels: Matrix, closures: Closures) -> Slipped:
    """Which of scans and wheels is wrong from one scan to another, where they disagree by ``size_m``.

    Each closure around the stretch measures the motion over it once more. It is predicted by the odometry of the
    scans, and by the same with the wheels' motion over the stretch in its place; the one whose predictions are far
    off where the others are right is wrong. Wheels that jump, which no vehicle does, are wrong without closures.
    odometry, wheels : (N, d+1, d+1), of the lidar; wheels NaN where unknown
    """
    known = np.flatnonzero(np.isfinite(wheels[:, 0, 0]))
    first, last = (int(known[np.argmin(np.abs(known - scan))]) for scan in (max(first - 1, 0), last))
    if first >= last:
        return Slipped.UNKNOWN
    if _largest_jump_m(wheels[first : last + 1]) > max(
        _IMPOSSIBLE_M + 2.0 * _largest_jump_m(odometry[first : last + 1]), _EXPLAINED * size_m
    ):
        return Slipped.WHEELS
    low, high = np.minimum(closures.target, closures.source), np.maximum(closures.target, closures.source)
    around = np.flatnonzero(closures.is_accepted & (low <= first) & (high >= last))
    around = around[np.argsort(high[around] - low[around], kind="stable")][:_MOST]
    if len(around) < _FEWEST:
        return Slipped.UNKNOWN
    is_forward = (closures.target <= closures.source)[around, None, None]
    T_low_high = closures.T_target_source[around]
    T_low_high = np.where(is_forward, T_low_high, lie.inverse(T_low_high))
    scans, rolled = (lie.between(each[first], each[last]) for each in (odometry, wheels))
    straight = scans.copy()  # as the wheels are far, in the direction of the scans
    straight[:-1, -1] = rolled[:-1, -1]
    before = lie.between(odometry[low[around]], np.broadcast_to(odometry[first], T_low_high.shape))
    after = lie.between(np.broadcast_to(odometry[last], T_low_high.shape), odometry[high[around]])
    by_scans, *by_wheels = (
        float(np.median(np.linalg.norm(lie.between(before @ motion @ after, T_low_high)[:, :-1, -1], axis=1)))
        for motion in (scans, straight, rolled)
    )
    if by_scans <= _RATIO * min(by_wheels):
        return Slipped.WHEELS
    return Slipped.SCANS if min(by_wheels) <= _RATIO * by_scans else Slipped.UNKNOWN


def _largest_jump_m(poses: Matrix) -> float:
    """Largest change of the motion from scan to scan; 0 where it is unknown."""
    changes_m = np.linalg.norm(np.diff(poses[:, :-1, -1], n=2, axis=0), axis=1)
    return float(np.nan_to_num(changes_m).max(initial=0.0))
