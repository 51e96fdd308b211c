"""Where a planar keyframe lies among older ones, however far the graph is off: correlative search over submaps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Keyframe, Matrix, Points, Pose
from scanchain.loops.submaps import Submaps
from scanchain.registration import CorrelativeMap, Seed, VoxelMap

_BASIN_M = 0.5  # of doubt, up to which matching needs no search
_SHARE_OF_DOUBT = 0.2  # that is traveled between two searches: wide windows cost most and run out last
_RADIANS_A_METER = 0.2  # of doubt: who is off by a meter after five looks that far to the side
_LEAST_RAD = 0.1
_SPACING_M = 4.0  # between the submaps that are searched
_SUBMAPS = 6  # of them at most
_SUBMAPS_ANYWHERE = 400  # at most where nothing is known
_MEMBERS_ANYWHERE = 12  # keyframes whose points are sought together
_LEAST_SHARE = 0.55  # of the highest score, below which nothing was found
_SAME_M = 2.0  # within which two submaps tell the same place
_RIVAL = 0.9  # of the best score, from which on another place is as good


@dataclass(frozen=True, slots=True)
class Found:
    """The anchor of the submap that the newest keyframe fits best, and where it lies there, to within a voxel."""

    anchor: int
    T_anchor_source: Pose


class PlanarSearch:
    """Tries every pose in the windows that the graph leaves open."""

    def __init__(self, submaps: Submaps) -> None:
        self.submaps = submaps
        self.next_m = 0.0

    def find(
        self,
        keyframes: Sequence[Keyframe],
        T_world: Matrix,
        near: NDArray[np.int64],
        doubts_m: NDArray[np.float64],
    ) -> Found | None:
        """Where the newest keyframe fits best; None where nothing is like it, or two places are, or not sought.

        near : older keyframes within reach; doubts_m : by how much each of the older keyframes may be off
        """
        source = keyframes[-1]
        if doubts_m[near].max() <= _BASIN_M or source.traveled_m < self.next_m:
            return None
        self.next_m = source.traveled_m + _SHARE_OF_DOUBT * float(doubts_m[near].max())
        anchors = self._anchors(near, T_world)
        points = self._surroundings(keyframes, self.submaps.half_width)
        T_first = lie.between(T_world[anchors], T_world[-1])
        seeds = [
            _seed(
                points,
                self.submaps.around(anchor, keyframes, len(doubts_m) - 1),
                T,
                doubt_m,
                _LEAST_RAD + _RADIANS_A_METER * doubt_m,
            )
            for anchor, T, doubt_m in zip(anchors, T_first, doubts_m[anchors].tolist(), strict=True)
        ]
        return _best(anchors, seeds, T_world)

    def find_anywhere(
        self, keyframes: Sequence[Keyframe], T_world: Matrix, old: NDArray[np.int64], known: int
    ) -> Found | None:
        """Where the newest keyframe fits best among older ones that tell nothing of where it may be.

        old : these keyframes, of one group; known : how many of the last ones odometry joins to the newest
        """
        old = old[old % self.submaps.half_width == 0]
        if not len(old):
            return None
        anchors = self._anchors(old, T_world, most=_SUBMAPS_ANYWHERE)
        points = self._surroundings(keyframes, min(known, _MEMBERS_ANYWHERE))
        newest = len(keyframes) - 1
        seeds = [
            _seed(points, self.submaps.around(anchor, keyframes, newest), lie.identity(2), _SPACING_M, math.pi)
            for anchor in anchors
        ]
        return _best(anchors, seeds, T_world)

    def _anchors(self, near: NDArray[np.int64], T_world: Matrix, most: int = _SUBMAPS) -> list[int]:
        """Anchors among the keyframes within reach, the nearest to the newest first, none close to another."""
        positions = T_world[:, :2, 2]
        anchors = np.unique([self.submaps.anchor_of(index) for index in near.tolist()])
        nearest_first = anchors[np.argsort(np.linalg.norm(positions[anchors] - positions[-1], axis=1))]
        chosen: list[int] = []
        for anchor in nearest_first.tolist():
            away_m = np.linalg.norm(positions[chosen] - positions[anchor], axis=1)
            if len(chosen) < most and (away_m >= _SPACING_M).all():
                chosen.append(anchor)
        return chosen

    def _surroundings(self, keyframes: Sequence[Keyframe], count: int) -> Points:
        """The points of the last keyframes, as seen from the newest: one scan alone may fit in many places."""
        T_source_odom = lie.inverse(keyframes[-1].T_odom_lidar)
        members = keyframes[-count:]
        return np.vstack([lie.transform(T_source_odom @ member.T_odom_lidar, member.points) for member in members])


def _seed(points: Points, submap: VoxelMap, T_first: Pose, half_width_m: float, half_width_rad: float) -> Seed:
    return CorrelativeMap(submap, lie.identity(2)).best(
        points, T_first, half_width_m=half_width_m, half_width_rad=half_width_rad, least=_LEAST_SHARE
    )


def _best(anchors: Sequence[int], seeds: Sequence[Seed], T_world: Matrix) -> Found | None:
    """The best of all seeds; None where nothing is like it, or another place as good."""
    shares = np.array([seed.share for seed in seeds])
    best = int(np.argmax(shares))
    T_found = np.array([T_world[a] @ seed.T_target_source for a, seed in zip(anchors, seeds, strict=True)])
    elsewhere = np.linalg.norm((T_found - T_found[best])[:, :2, 2], axis=1) > _SAME_M
    rival = max(seeds[best].rival, float(shares[elsewhere].max(initial=0.0)))
    if rival >= _RIVAL * shares[best]:
        return None
    return Found(anchors[best], seeds[best].T_target_source)
