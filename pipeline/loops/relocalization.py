"""Relocalization in the plane: correlative search over submaps, near the expected pose or anywhere in the map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Closure, Keyframe, Matrix, Points, Pose, Proposal, Verdict
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.connectivity import Segments
from scanchain.loops.submaps import VoxelSubmaps
from scanchain.loops.verification import ScanVerifier
from scanchain.registration import CorrelativeMap, Seed, VoxelMap

_BASIN_M = 0.5  # largest uncertainty that matching corrects without a search
_INTERVAL = 0.2  # share of the uncertainty that is traveled between two searches: wide windows cost most
_RADIANS_A_METER = 0.2  # half width of the window in heading for each meter of uncertainty
_MIN_RAD = 0.1  # least half width of the window in heading
_SPACING_M = 4.0  # least distance between the anchors of submaps that are searched
_MAX_SUBMAPS = 6  # largest number of submaps searched near the expected pose
_MAX_SUBMAPS_ANYWHERE = 400  # largest number of submaps searched without an expected pose
_KEYFRAMES_ANYWHERE = 12  # number of keyframes whose points are searched for together, without an expected pose
_MIN_SHARE = 0.55  # least share of the highest possible score at which something was found
_SAME_POSE_M = 2.0  # distance within which the results of two submaps are the same pose
_RIVAL = 0.9  # share of the best score, from which on a result elsewhere makes it ambiguous
_FIRST_M = 3.0  # distance traveled in a new segment before the first search anywhere
_BACKOFF = 0.2  # share of the distance searched in vain that is traveled before the next search
_APART_M = 1.0  # least distance traveled between two results that may confirm each other
_AGREE_M, _AGREE_RAD = 0.5, 0.1  # largest difference between two results that confirm each other


@dataclass(frozen=True, slots=True)
class Found:
    """The anchor of the submap that the newest keyframe fits best, and its pose there, to within a voxel."""

    anchor: int
    T_anchor_source: Pose


class PlanarSearch:
    """Correlative search over all windows that the uncertainty of the graph allows."""

    def __init__(self, submaps: VoxelSubmaps) -> None:
        self.submaps = submaps
        self.next_m = 0.0

    def find(
        self,
        keyframes: Sequence[Keyframe],
        T_world: Matrix,
        near: NDArray[np.int64],
        uncertainty_m: NDArray[np.float64],
    ) -> Found | None:
        """The best fit of the newest keyframe; None where there is none, an ambiguous one, or a search is not due.

        near : older keyframes within reach; uncertainty_m : of the position of each of the older keyframes
        """
        source = keyframes[-1]
        if uncertainty_m[near].max() <= _BASIN_M or source.traveled_m < self.next_m:
            return None
        self.next_m = source.traveled_m + _INTERVAL * float(uncertainty_m[near].max())
        anchors = self._anchors(near, T_world)
        points = self._points(keyframes, self.submaps.half_width)
        T_first = lie.between(T_world[anchors], T_world[-1])
        seeds = [
            _seed(
                points,
                self.submaps.around(anchor, keyframes, len(uncertainty_m) - 1),
                T,
                radius_m,
                _MIN_RAD + _RADIANS_A_METER * radius_m,
            )
            for anchor, T, radius_m in zip(anchors, T_first, uncertainty_m[anchors].tolist(), strict=True)
        ]
        return _best(anchors, seeds, T_world)

    def find_anywhere(
        self, keyframes: Sequence[Keyframe], T_world: Matrix, old: NDArray[np.int64], known: int
    ) -> Found | None:
        """The best fit of the newest keyframe among older ones, without an expected pose.

        old : these keyframes, of one component; known : how many of the last ones odometry joins to the newest
        """
        old = old[old % self.submaps.half_width == 0]
        if not len(old):
            return None
        anchors = self._anchors(old, T_world, most=_MAX_SUBMAPS_ANYWHERE)
        points = self._points(keyframes, min(known, _KEYFRAMES_ANYWHERE))
        newest = len(keyframes) - 1
        seeds = [
            _seed(points, self.submaps.around(anchor, keyframes, newest), lie.identity(2), _SPACING_M, math.pi)
            for anchor in anchors
        ]
        return _best(anchors, seeds, T_world)

    def _anchors(self, near: NDArray[np.int64], T_world: Matrix, most: int = _MAX_SUBMAPS) -> list[int]:
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

    def _points(self, keyframes: Sequence[Keyframe], count: int) -> Points:
        """Points of the last keyframes in the newest one's frame: one scan alone may fit at many poses."""
        T_source_odom = lie.inverse(keyframes[-1].T_odom_lidar)
        members = keyframes[-count:]
        return np.vstack([lie.transform(T_source_odom @ member.T_odom_lidar, member.points) for member in members])


class Relocalizer:
    """Search for a new segment in the older ones, as long as no loop joins it to them."""

    def __init__(self, search: PlanarSearch, verifier: ScanVerifier, segments: Segments) -> None:
        self.search = search
        self.verifier = verifier
        self.segments = segments
        self.next_m = 0.0
        self.turn = 0
        self.found: list[Closure] = []

    def close(
        self, keyframes: Sequence[Keyframe], graph: PoseGraph, components: NDArray[np.int64]
    ) -> tuple[Closure, ...]:
        """Closures of the newest keyframe to older segments; the first that agree with each other are accepted.

        components : (K,) of ``Segments.components``
        """
        start = self.segments.starts[-1]
        traveled_m = keyframes[-1].traveled_m - keyframes[start].traveled_m
        unknown = np.flatnonzero(components != components[-1])
        is_due = traveled_m >= _FIRST_M and keyframes[-1].traveled_m >= self.next_m
        if not len(unknown) or not is_due:
            return ()
        self.next_m = keyframes[-1].traveled_m + max(_BACKOFF * traveled_m, _APART_M)
        old = self._next_component(unknown, components)
        found = self.search.find_anywhere(keyframes, graph.poses, old, len(keyframes) - start)
        if found is None:
            return ()
        newest = len(keyframes) - 1
        verified = self.verifier.verify(
            keyframes, newest, found.anchor, found.T_anchor_source, newest=newest, alone=True
        )
        closure = verified.closure(found.anchor, newest, Proposal.PLACE)
        if closure.verdict is Verdict.REJECTED:
            return (closure,)
        return self._confirmed(closure, keyframes, graph.poses)

    def _next_component(self, unknown: NDArray[np.int64], components: NDArray[np.int64]) -> NDArray[np.int64]:
        """Keyframes of the next component, in rotation: two may show the same location."""
        numbers = np.unique(components[unknown])
        self.turn += 1
        return unknown[components[unknown] == numbers[self.turn % len(numbers)]]

    def _confirmed(self, closure: Closure, keyframes: Sequence[Keyframe], T_world: Matrix) -> tuple[Closure, ...]:
        """The closure and the older ones that agree with it; rejected while there are none."""
        old = [other for other in self.found if other.source >= self.segments.starts[-1]]
        agreeing = [other for other in old if _agree(closure, other, keyframes, T_world)]
        if agreeing:
            self.found = []
            return (*agreeing, closure)
        self.found = [*old, closure]
        return (replace(closure, verdict=Verdict.REJECTED, reason="found anywhere, and no other find agrees yet"),)


def _seed(points: Points, submap: VoxelMap, T_first: Pose, half_width_m: float, half_width_rad: float) -> Seed:
    return CorrelativeMap(submap, lie.identity(2)).best(
        points, T_first, half_width_m=half_width_m, half_width_rad=half_width_rad, least=_MIN_SHARE
    )


def _best(anchors: Sequence[int], seeds: Sequence[Seed], T_world: Matrix) -> Found | None:
    """The best of all seeds; None where there is none, or another one elsewhere is as good."""
    shares = np.array([seed.share for seed in seeds])
    best = int(np.argmax(shares))
    T_found = np.array([T_world[a] @ seed.T_target_source for a, seed in zip(anchors, seeds, strict=True)])
    elsewhere = np.linalg.norm((T_found - T_found[best])[:, :2, 2], axis=1) > _SAME_POSE_M
    rival = max(seeds[best].rival, float(shares[elsewhere].max(initial=0.0)))
    if rival >= _RIVAL * shares[best]:
        return None
    return Found(anchors[best], seeds[best].T_target_source)


def _agree(a: Closure, b: Closure, keyframes: Sequence[Keyframe], T_world: Matrix) -> bool:
    """True if two closures imply the same pose of the newest keyframe."""
    off_m, off_rad = lie.apart(
        _implied_pose(a, a.source, keyframes, T_world), _implied_pose(b, a.source, keyframes, T_world)
    )
    return off_m < _AGREE_M and off_rad < _AGREE_RAD


def _implied_pose(closure: Closure, keyframe: int, keyframes: Sequence[Keyframe], T_world: Matrix) -> Pose:
    """T_world_keyframe by a closure and odometry, in the world of the closure's target."""
    T_source_keyframe = lie.between(keyframes[closure.source].T_odom_lidar, keyframes[keyframe].T_odom_lidar)
    return T_world[closure.target] @ closure.match.T_target_source @ T_source_keyframe
