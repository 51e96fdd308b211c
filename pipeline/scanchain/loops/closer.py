"""Loop closures: to keyframes near by position and drift, to recognized places, and by relocalization."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config, LoopsConfig
from scanchain.data import Closure, ClosureVerdict, Keyframe, Matrix, Points, Pose, Proposal
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.connectivity import Drift, Segments
from scanchain.loops.map_search import UprightFinder
from scanchain.loops.place_search import PlaceSearch
from scanchain.loops.planar_map_search import PlanarFinder
from scanchain.loops.recognizer import PlaceCloser
from scanchain.loops.submaps import VoxelSubmaps
from scanchain.loops.verification import Verifier
from scanchain.registration import SearchGrid, Wanted, Window, find, thinned
from scanchain.registration.search import Found

_KEPT_M = 10.0  # largest distance from the anchor of a map's submap, up to which it is matched on, at full scale
_LARGE = 2000  # keyframes from which on those of one pass go before the nearest one
_ALIKE_RAD = 0.5  # largest difference in heading from a keyframe of the first pass
_ALONG = 10  # keyframes before and after the last target, among which the next one is
_SUBMAP_KEYFRAMES = 5  # before and after the center of a submap, which scans are matched to

_BASIN_M = 0.5  # largest uncertainty that matching corrects without a search
_INTERVAL = 0.2  # share of the uncertainty that is traveled between two searches: wide windows cost most
_RADIANS_A_METER = 0.2  # half width of the window in heading for each meter of uncertainty
_MIN_RAD = 0.1  # least half width of the window in heading
_SPACING_M = 4.0  # least distance between the anchors of submaps that are searched
_MAX_SUBMAPS = 6  # largest number of submaps searched near the expected pose
_WANTED = Wanted(apart_m=1.0, rival=0.8, answers=2, least=0.55)  # near it, in each submap
_SAME_POSE_M = 2.0  # distance within which the results of two submaps are the same pose
_AMBIGUOUS = 0.9  # share of the best score, from which on a result elsewhere makes it ambiguous


class LoopCloser:
    """Searches from each new keyframe for older ones that it revisits and verifies them."""

    def __init__(self, config: Config, dimension: int, *, is_live: bool = False) -> None:
        """Begin without keyframes.

        is_live : whether a search of the whole map goes on over several scans, so that none of them waits for it;
            else it is completed at once, which finds a location sooner
        Raises InputError for a recognizer that cannot be loaded.
        """
        self.config = config
        self.is_live = is_live
        self.segments = Segments()
        submaps = VoxelSubmaps(dimension, _SUBMAP_KEYFRAMES, config.local_map, self.segments)
        verifier = Verifier(config)
        is_planar = dimension == 2
        self.near = ProximityCloser(config.loops, submaps, verifier, PlanarSearch(submaps) if is_planar else None)
        self.search: PlaceSearch[Any] = (
            PlaceSearch(PlanarFinder(submaps, verifier), config.loops, self.segments)
            if is_planar
            else PlaceSearch(UprightFinder(config), config.loops, self.segments)
        )
        self.places = PlaceCloser(config, dimension, submaps, verifier)

    def begin_in(
        self, keyframes: Sequence[Keyframe], folder: Path | None = None, *, is_final: bool = True
    ) -> float:
        """Take the keyframes of a map, which loops close to first; where the path of the log begins, in meters.

        folder : of a map on disk, which keeps its outline
        is_final : whether they stay where they are; else only those of one pass make a submap
        """
        self.near.of_map = len(keyframes)
        if is_final:
            self.near.submaps.begin_in(keyframes)
        if self.config.loops.enabled:
            self.search.begin_in(keyframes, folder)
        return self.places.begin_in(keyframes, are_added=self.near.search is not None)

    def start_segment(self, keyframe: int) -> None:
        """Start a new segment at this keyframe: the motion to it from the one before is unknown."""
        self.segments.start(keyframe)
        self.search.search_again()

    def search_again(self) -> None:
        """Forget where the newest segment was matched in the map: it is not there."""
        self.near.target_in_map = -1
        self.near.drift = Drift(self.config.loops.drift)
        self.search.search_again()

    def advance(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Closures by a search that is under way, which goes on with every scan, in slices of equal work."""
        return self.search.advance(keyframes, graph)

    def close(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Closures of the newest keyframe, and of submaps that are complete by now; accepted or not.

        keyframes : all so far; graph : their best known poses, and how they are connected
        """
        if not self.segments.is_assumed and self.search.has_just_matched(keyframes):
            self.places.skip(keyframes)
            return ()
        components = self.segments.components(graph)
        connected = components == components[-1]
        closures = self.near.close(keyframes, graph, connected)
        self.search.take(keyframes, closures)
        if self.search.is_tracking(keyframes):
            self.places.skip(keyframes)
            return closures
        closures += self.search.close(keyframes, graph, components)
        if not self.is_live:
            closures += self.search.finish(keyframes, graph)
        return closures + self.places.close(keyframes, graph, connected)

    def finish(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Closures of the submaps and searches that the end of the log leaves incomplete."""
        components = self.segments.components(graph)
        closures = self.search.finish(keyframes, graph)
        return closures + self.places.close(keyframes, graph, components == components[-1], finish=True)


class ProximityCloser:
    """Aligns each new keyframe to the nearest older one; in the plane, searches within the drift if that fails."""

    def __init__(
        self, config: LoopsConfig, submaps: VoxelSubmaps, verifier: Verifier, search: PlanarSearch | None
    ) -> None:
        self.config = config
        self.submaps = submaps
        self.verifier = verifier
        self.search = search
        self.drift = Drift(config.drift)
        self.of_map = 0  # number of the first keyframes that belong to a map
        self.target = -1  # anchor of the last submap that was matched, -1 where that failed
        self.target_in_map = -1  # anchor of the last submap of the map that was matched

    def close(
        self, keyframes: Sequence[Keyframe], graph: PoseGraph, connected: NDArray[np.bool_]
    ) -> tuple[Closure, ...]:
        """Closures of the newest keyframe to older ones, accepted or not.

        connected : (K,) keyframes in the component of the newest
        """
        self.drift.measure(graph)
        old = self._old(keyframes)
        if not old:
            return ()
        T_world, newest = graph.poses, len(keyframes) - 1
        nearest, distance_m = self._next(T_world, old, connected)
        near, uncertainty_m = np.array([nearest]), None
        if self.of_map or distance_m > self.config.min_radius_m:
            near, uncertainty_m = self._near(graph, old, connected)
            if not len(near):
                return ()
        target = self.submaps.anchor_of(int(near[np.argmin(_distances_m(T_world, near))]))
        if self.search is None and target < self.of_map:
            kept = self.target_in_map
            if kept in near and _distances_m(T_world, kept) <= _KEPT_M * keyframes[kept].scale:
                target = kept
            self.target_in_map = target
        T_first = lie.between(T_world[target], T_world[-1])
        submap = self.submaps.around(target, keyframes, old - 1)
        verified = self.verifier.scan(keyframes[newest], submap, T_first, in_map=target < self.of_map)
        closure = verified.closure(target, newest)
        self.target = target if closure.verdict is ClosureVerdict.ACCEPTED else -1
        if closure.verdict is ClosureVerdict.ACCEPTED or self.search is None:
            return (closure,)
        if self.submaps.segments.is_assumed or not self.search.is_due(keyframes):
            return (closure,)
        if uncertainty_m is None:
            near, uncertainty_m = self._near(graph, old, connected)
        found = self.search.find(keyframes, T_world, near, uncertainty_m)
        if found is None:
            return (closure,)
        submap = self.submaps.around(found.anchor, keyframes, old - 1)
        searched = self.verifier.scan(keyframes[newest], submap, found.T_anchor_source)
        return closure, searched.closure(found.anchor, newest, Proposal.PLACE)

    def _near(
        self, graph: PoseGraph, old: int, connected: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Older keyframes where the newest may be, of the map alone if any is; uncertainty (old,) of all."""
        uncertainty_m = self.drift.between(graph, len(graph) - 1, self.config.max_radius_m)[:old]
        reach_m = np.maximum(uncertainty_m, self.config.min_radius_m)
        near = np.flatnonzero(connected[:old] & (_distances_m(graph.poses, slice(old)) <= reach_m))
        return near[near < self.of_map] if (near < self.of_map).any() else near, uncertainty_m

    def _next(self, T_world: Matrix, old: int, connected: NDArray[np.bool_]) -> tuple[int, float]:
        """The nearest of the older keyframes, and its distance; in large graphs of one pass over a place.

        So revisits of a place that was passed many times are not closed to another pass each, and its submaps are
        used again. In space it is the pass that was matched last. In the plane it is the first: after a slip of
        odometry in a corridor, keyframes would be closed to each other.
        """
        if old >= _LARGE and self.submaps.dimension == 2:
            first = on_first_pass(T_world, connected[:old], self.config.min_radius_m)
            if first >= 0:
                return first, float(_distances_m(T_world, first))
        if old >= _LARGE and self.target >= self.of_map and self.submaps.dimension == 3:
            begin, end = max(self.target - _ALONG, 0), min(self.target + _ALONG + 1, old)
            distances_m = np.where(connected[begin:end], _distances_m(T_world, slice(begin, end)), np.inf)
            along = int(np.argmin(distances_m))
            if distances_m[along] <= self.config.min_radius_m:
                return begin + along, float(distances_m[along])
        distances_m = np.where(connected[:old], _distances_m(T_world, slice(old)), np.inf)
        return (int(np.argmin(distances_m)), float(distances_m.min())) if connected[:old].any() else (-1, np.inf)

    def _old(self, keyframes: Sequence[Keyframe]) -> int:
        """Number of the first keyframes that lie far enough back along the path to count as revisited."""
        limit_m = keyframes[-1].traveled_m - self.config.min_travel_m
        old = len(keyframes)
        while old > 0 and keyframes[old - 1].traveled_m > limit_m:
            old -= 1
        return old


@dataclass(frozen=True, slots=True)
class Nearby:
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
    ) -> Nearby | None:
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
        found: list[tuple[Found, int]] = []
        for anchor, T, radius_m in zip(anchors, T_first, uncertainty_m[anchors].tolist(), strict=True):
            grid = SearchGrid.of_voxels(self.submaps.around(anchor, keyframes, len(uncertainty_m) - 1), T)
            window = Window(T, radius_m, _MIN_RAD + _RADIANS_A_METER * radius_m)
            some = find(thinned(points, grid.resolution_m), grid, window, _WANTED)
            found += [(each, anchor) for each in some]
        return _best(found, T_world)

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


def on_first_pass(T_world: Matrix, chosen: NDArray[np.bool_], reach_m: float) -> int:
    """Where the first pass by the newest keyframe (K, 3, 3) was nearest, of those chosen (n,); −1 if none was.

    A pass is of keyframes one after the other within reach and of about the same heading.
    """
    distances_m = _distances_m(T_world, slice(len(chosen)))
    cosines = (T_world[: len(chosen), :2, 0] * T_world[-1, :2, 0]).sum(axis=1)
    near = np.flatnonzero(chosen & (distances_m <= reach_m) & (cosines >= np.cos(_ALIKE_RAD)))
    if not len(near):
        return -1
    goes_on = (np.diff(near) == 1) & (np.diff(distances_m[near]) <= 0.0)
    return int(near[np.argmin(np.append(goes_on, False))])


def _distances_m(T_world: Matrix, keyframes: NDArray[np.int64] | slice | int) -> NDArray[np.float64]:
    """Distances of some keyframes from the newest."""
    return np.linalg.norm(T_world[keyframes, :-1, -1] - T_world[-1, :-1, -1], axis=-1)


def _best(found: Sequence[tuple[Found, int]], T_world: Matrix) -> Nearby | None:
    """The best of the poses in submaps of anchors; None where there is none, or another one is as good.

    Two of the same submap are distinct.
    """
    if not found:
        return None
    best, anchor = max(found, key=lambda each: each[0].share)
    position = (T_world[anchor] @ best.T_target_source)[:2, 2]
    for each, other in found:
        away_m = np.linalg.norm((T_world[other] @ each.T_target_source)[:2, 2] - position)
        is_distinct = each is not best if other == anchor else away_m > _SAME_POSE_M
        if is_distinct and each.share >= _AMBIGUOUS * best.share:
            return None
    return Nearby(anchor, best.T_target_source)
