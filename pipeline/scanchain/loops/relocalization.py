"""Relocalization in the plane: correlative search over submaps, near the expected pose or anywhere in the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Closure, ClosureVerdict, Keyframe, Matrix, Points, Pose, Problem, Proposal
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.connectivity import Segments
from scanchain.loops.planar_map_search import LEAST_SHARE, PlanarMapSearch, WholeSearch
from scanchain.loops.submaps import VoxelSubmaps
from scanchain.loops.verification import ScanVerifier
from scanchain.registration import CorrelativeMap, Seed, VoxelMap

_BASIN_M = 0.5  # largest uncertainty that matching corrects without a search
_INTERVAL = 0.2  # share of the uncertainty that is traveled between two searches: wide windows cost most
_RADIANS_A_METER = 0.2  # half width of the window in heading for each meter of uncertainty
_MIN_RAD = 0.1  # least half width of the window in heading
_SPACING_M = 4.0  # least distance between the anchors of submaps that are searched
_MAX_SUBMAPS = 6  # largest number of submaps searched near the expected pose
_MIN_SHARE = 0.55  # least share of the highest possible score at which something was found near it
_SAME_POSE_M = 2.0  # distance within which the results of two submaps are the same pose
_AMBIGUOUS = 0.9  # share of the best score, from which on a result elsewhere makes it ambiguous

_FIRST_M = 1.0  # distance traveled in a new segment before the first search of the whole map
_BACKOFF = 0.2  # share of the distance searched in vain that is traveled before the next search
_APART_M = 0.5  # least distance traveled between two searches
_INTERVAL_M = 3.0  # largest distance traveled between two searches
_PATH_M = 8.0  # length of the path whose points are searched for: over it odometry drifts less than a cell or two
_AGREE_M, _AGREE_RAD = 0.5, 0.1  # largest difference between two results that confirm each other
_SOURCES, _SUBMAPS = (
    4,
    6,
)  # numbers of keyframes of the path that are aligned, and of submaps that are tried for each
_NEAR_M = 8.0  # largest distance of such a submap's anchor


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

    def is_due(self, keyframes: Sequence[Keyframe]) -> bool:
        """True if the lidar has traveled far enough since the last search."""
        return keyframes[-1].traveled_m >= self.next_m

    def find(
        self,
        keyframes: Sequence[Keyframe],
        T_world: Matrix,
        near: NDArray[np.int64],
        uncertainty_m: NDArray[np.float64],
    ) -> Found | None:
        """The best fit of the newest keyframe; None where there is none, an ambiguous one, or none is needed.

        near : older keyframes within reach; uncertainty_m : of the position of each of the older keyframes
        """
        source = keyframes[-1]
        if uncertainty_m[near].max() <= _BASIN_M:
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

    def _anchors(self, near: NDArray[np.int64], T_world: Matrix) -> list[int]:
        """Anchors among the keyframes within reach, the nearest to the newest first, none close to another."""
        positions = T_world[:, :2, 2]
        anchors = np.unique([self.submaps.anchor_of(index) for index in near.tolist()])
        nearest_first = anchors[np.argsort(np.linalg.norm(positions[anchors] - positions[-1], axis=1))]
        chosen: list[int] = []
        for anchor in nearest_first.tolist():
            away_m = np.linalg.norm(positions[chosen] - positions[anchor], axis=1)
            if len(chosen) < _MAX_SUBMAPS and (away_m >= _SPACING_M).all():
                chosen.append(anchor)
        return chosen

    def _points(self, keyframes: Sequence[Keyframe], count: int) -> Points:
        """Points of the last keyframes in the newest one's frame: one scan alone may fit at many poses."""
        T_source_odom = lie.inverse(keyframes[-1].T_odom_lidar)
        members = keyframes[-count:]
        return np.vstack([lie.transform(T_source_odom @ member.T_odom_lidar, member.points) for member in members])


class Relocalizer:
    """Search for a new segment in the older ones, as long as no loop joins it to them.

    All points of its path so far are searched for in the whole map, again and again as it travels. A pose is
    taken once it fits better than chance, no pose elsewhere fits nearly as well, an earlier search found the same
    one, and scans align there. A search in a large map goes on over several scans.
    """

    def __init__(self, submaps: VoxelSubmaps, verifier: ScanVerifier, segments: Segments) -> None:
        self.submaps = submaps
        self.verifier = verifier
        self.segments = segments
        self.next_m = 0.0
        self.turn = 0
        self.found: list[Find] = []
        self.searched: PlanarMapSearch | None = None
        self.searched_poses = np.empty((0, 3, 3))
        self.underway: Search | None = None

    def begin_in(self, keyframes: Sequence[Keyframe], T_map_lidar: Matrix) -> None:
        """Draw a map, with keyframes at their poses (K, 3, 3), before its first search."""
        self._draw(keyframes, T_map_lidar)

    def advance(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Go on with the search that is under way, for a scan; closures once it is done, as of ``close``."""
        if self.underway is None:
            return ()
        self.underway.search.advance()
        return self._found(keyframes, graph.poses) if self.underway.search.is_done else ()

    def close(
        self, keyframes: Sequence[Keyframe], graph: PoseGraph, components: NDArray[np.int64]
    ) -> tuple[Closure, ...]:
        """Closures of keyframes of the newest segment to older segments; accepted where two finds agree.

        components : (K,) of ``Segments.components``
        """
        start = self.segments.starts[-1]
        unknown = np.flatnonzero(components != components[-1])
        if not len(unknown) or (self.underway is not None and self.underway.source < start):
            self.underway = None
        if not len(unknown) or self.underway is not None or not self._is_due(start, keyframes):
            return ()
        self._begin(start, self._next_component(unknown, components), keyframes, graph.poses)
        return self.advance(keyframes, graph)

    def finish(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Closures by the search that the end of the log left under way."""
        closures: tuple[Closure, ...] = ()
        while self.underway is not None:
            closures = self.advance(keyframes, graph)
        return closures

    def _found(self, keyframes: Sequence[Keyframe], T_world: Matrix) -> tuple[Closure, ...]:
        """Closures by the search that is done, where it agrees with another one of the newest segment."""
        assert self.underway is not None
        old, find = self.underway.old, self.underway.find()
        self.underway = None
        if find is None:
            return ()
        start = self.segments.starts[-1]
        self.found = [each for each in self.found if each.source >= start]
        agreeing = any(_agree(other, find, keyframes) for other in self.found)
        self.found.append(find)
        if not agreeing:
            return ()
        path = np.arange(_path_begin(keyframes, start), len(keyframes))
        return self._verified(find, path, old, keyframes, T_world)

    def _next_component(self, unknown: NDArray[np.int64], components: NDArray[np.int64]) -> NDArray[np.int64]:
        """Keyframes of the next component, in rotation: two may show the same location."""
        numbers = np.unique(components[unknown])
        self.turn += 1
        return unknown[components[unknown] == numbers[self.turn % len(numbers)]]

    def _is_due(self, start: int, keyframes: Sequence[Keyframe]) -> bool:
        """True if the newest segment has gone far enough for the next search, which sets the distance after it."""
        traveled_m = keyframes[-1].traveled_m - keyframes[start].traveled_m
        if traveled_m < _FIRST_M or keyframes[-1].traveled_m < self.next_m:
            return False
        self.next_m = keyframes[-1].traveled_m + min(max(_BACKOFF * traveled_m, _APART_M), _INTERVAL_M)
        return True

    def _begin(self, start: int, old: NDArray[np.int64], keyframes: Sequence[Keyframe], T_world: Matrix) -> None:
        """Begin a search for the end of the newest segment among older keyframes."""
        path = keyframes[_path_begin(keyframes, start) :]
        T_newest_odom = lie.inverse(path[-1].T_odom_lidar)
        points = np.vstack([lie.transform(T_newest_odom @ member.T_odom_lidar, member.points) for member in path])
        target = self._draw([keyframes[k] for k in old.tolist()], T_world[old])
        self.underway = Search(path[-1].index, old, WholeSearch(target, points, LEAST_SHARE))

    def _draw(self, keyframes: Sequence[Keyframe], T_world: Matrix) -> PlanarMapSearch:
        """The map of keyframes at their poses; the last one where these are the same."""
        if self.searched is None or not np.array_equal(self.searched_poses, T_world):
            self.searched = PlanarMapSearch(keyframes, T_world, self.submaps.config.voxel_size_m)
            self.searched_poses = T_world
        return self.searched

    def _verified(
        self,
        find: Find,
        path: NDArray[np.int64],
        old: NDArray[np.int64],
        keyframes: Sequence[Keyframe],
        T_world: Matrix,
    ) -> tuple[Closure, ...]:
        """Closures of some keyframes of the path, from where the find puts them."""
        sources = path[:: -max(len(path) // _SOURCES, 1)][:_SOURCES]
        anchors = old[old % self.submaps.half_width == 0]
        closures = [
            self._aligned(source, find.moved_to(source, keyframes), anchors, keyframes, T_world)
            for source in sources.tolist()
        ]
        return tuple(sorted((each for each in closures if each is not None), key=_rank, reverse=True))

    def _aligned(
        self,
        source: int,
        T_world_source: Pose,
        anchors: NDArray[np.int64],
        keyframes: Sequence[Keyframe],
        T_world: Matrix,
    ) -> Closure | None:
        """The closure of a keyframe to the submap near by that it overlaps most; None where there is none."""
        away_m = np.linalg.norm(T_world[anchors, :2, 2] - T_world_source[:2, 2], axis=1)
        near = anchors[np.argsort(away_m)[:_SUBMAPS]]
        near = near[np.linalg.norm(T_world[near, :2, 2] - T_world_source[:2, 2], axis=1) <= _NEAR_M]
        best: Closure | None = None
        for anchor in near.tolist():
            T_first = lie.between(T_world[anchor], T_world_source)
            verified = self.verifier.verify(keyframes, source, anchor, T_first, newest=len(keyframes) - 1)
            off_m, off_rad = lie.apart(T_first, verified.match.T_target_source)
            is_off = off_m > _AGREE_M or off_rad > _AGREE_RAD
            far = Problem("far from where the path was found", f"{off_m:.1f} m from where the path was found")
            closure = verified.closure(anchor, source, Proposal.PLACE, problem=far if is_off else None)
            if best is None or (_rank(closure) > _rank(best)):
                best = closure
        return best


@dataclass(frozen=True, slots=True)
class Search:
    """A search under way, for keyframe ``source`` among the older keyframes ``old``."""

    source: int
    old: NDArray[np.int64]
    search: WholeSearch

    def find(self) -> Find | None:
        """The pose that the search found; None where there is none, or an ambiguous one."""
        best = self.search.best()
        if best is None or best.is_ambiguous or not best.is_likely:
            return None
        return Find(self.source, int(self.old[0]), best.T_map_lidar)


@dataclass(frozen=True, slots=True)
class Find:
    """The pose of keyframe ``source`` among older keyframes, by a search; ``target`` is the first of them."""

    source: int
    target: int
    T_world_source: Pose

    def moved_to(self, keyframe: int, keyframes: Sequence[Keyframe]) -> Pose:
        """T_world_keyframe of another keyframe of the segment, by odometry."""
        odom = keyframes[self.source].T_odom_lidar
        return self.T_world_source @ lie.between(odom, keyframes[keyframe].T_odom_lidar)


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
    if rival >= _AMBIGUOUS * shares[best]:
        return None
    return Found(anchors[best], seeds[best].T_target_source)


def _path_begin(keyframes: Sequence[Keyframe], start: int) -> int:
    """The first keyframe, from ``start`` on, of the path whose points are searched for."""
    first = len(keyframes) - 1
    while first > start and keyframes[-1].traveled_m - keyframes[first - 1].traveled_m <= _PATH_M:
        first -= 1
    return first


def _agree(a: Find, b: Find, keyframes: Sequence[Keyframe]) -> bool:
    """True if two finds imply the same pose of the later keyframe."""
    off_m, off_rad = lie.apart(a.moved_to(b.source, keyframes), b.T_world_source)
    return a.target == b.target and off_m < _AGREE_M and off_rad < _AGREE_RAD


def _rank(closure: Closure) -> tuple[bool, float]:
    return closure.verdict is ClosureVerdict.ACCEPTED, closure.overlap
