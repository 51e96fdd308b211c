"""Loop closures: to keyframes near by position and drift, to recognized places, and by relocalization."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config, LoopsConfig
from scanchain.data import Closure, ClosureVerdict, Keyframe, Matrix, Pose
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.connectivity import Drift, Segments
from scanchain.loops.place_search import PlaceSearch
from scanchain.loops.planar_map_search import PlanarFinder
from scanchain.loops.recognizer import PlaceCloser
from scanchain.loops.submaps import VoxelSubmaps
from scanchain.loops.upright_search import UprightFinder
from scanchain.loops.verification import Verifier

_KEPT_M = 10.0  # distance from the anchor of a map's submap up to which it stays the target, at full scale
_LARGE = 2000  # number of keyframes above which those of one pass are preferred to the nearest one
_SAME_PASS_RAD = 0.5  # largest difference in heading from a keyframe of the first pass
_ALONG = 10  # keyframes before and after the last target that are considered for the next one
_SUBMAP_KEYFRAMES = 5  # before and after the center of a submap, which scans are matched to

_BASIN_M = 0.5  # largest uncertainty that matching corrects without a search
_INTERVAL = 0.2  # share of the uncertainty that is traveled between two searches: wide windows cost most


class LoopCloser:
    """Searches from each new keyframe for older ones that it revisits and verifies them."""

    def __init__(self, config: Config, dimension: int, *, is_live: bool = False) -> None:
        """Start without keyframes.

        is_live : whether a search of the whole map is spread over several scans, so that no scan waits for it;
            else it is completed at once, which finds a location sooner
        Raises InputError for a recognizer that cannot be loaded.
        """
        self.config = config
        self.is_live = is_live
        self.segments = Segments()
        submaps = VoxelSubmaps(dimension, _SUBMAP_KEYFRAMES, config.local_map, self.segments)
        verifier = Verifier(config)
        planar = PlanarFinder(submaps, verifier) if dimension == 2 else None
        finder = planar or UprightFinder(config)
        self.near = ProximityCloser(config.loops, submaps, verifier, planar)
        self.search: PlaceSearch[Any] = PlaceSearch(finder, self.segments)
        self.places = PlaceCloser(config, dimension, submaps, verifier)

    def add_map(
        self, keyframes: Sequence[Keyframe], folder: Path | None = None, *, is_final: bool = True
    ) -> float:
        """Add the keyframes of a map, to which loops close first; returns the start of the log's path, in meters.

        folder : of a map on disk, which caches its outline
        is_final : whether their poses are final; else a submap has keyframes of one pass only
        """
        self.near.of_map = len(keyframes)
        if is_final:
            self.near.submaps.add_map(keyframes)
        if self.config.loops.enabled:
            self.search.add_map(keyframes, folder)
        return self.places.add_map(keyframes, are_added=self.near.finder is not None)

    @property
    def ambiguous_share(self) -> float:
        """Share of the searches of a map, or of older segments, whose result was ambiguous."""
        finder = self.search.finder
        return finder.ambiguous / max(finder.searches, 1)

    def start_segment(self, keyframe: int) -> None:
        """Start a new segment at this keyframe: the motion to it from the one before is unknown."""
        self.segments.start(keyframe)
        self.search.search_again()

    def search_again(self) -> None:
        """Forget where the newest segment was matched in the map: it is not there."""
        self.near.target_in_map = -1
        self.near.drift = Drift(self.config.loops.drift)
        self.search.search_again()

    def is_tracking(self, keyframes: Sequence[Keyframe]) -> bool:
        """True while the last match with the map is recent."""
        return self.search.is_tracking(keyframes)

    def advance(self) -> tuple[Closure, ...]:
        """Closures of the search in progress, which continues with every scan, in slices of equal work."""
        return self.search.advance()

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
        self.search.record(keyframes, closures)
        if self.near.finder is None and self.is_tracking(keyframes):
            self.search.skip()
            self.places.skip(keyframes)
            return closures
        closures += self.search.close(keyframes, graph, components)
        if not self.is_live:
            closures += self.search.finish()
        return closures + self.places.close(keyframes, graph, connected)

    def finish(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Closures of the submaps and searches that the end of the log leaves incomplete."""
        components = self.segments.components(graph)
        closures = self.search.finish()
        return closures + self.places.close(keyframes, graph, components == components[-1], finish=True)


class ProximityCloser:
    """Aligns each new keyframe to the nearest older one; in the plane, searches within the drift if that fails."""

    def __init__(
        self, config: LoopsConfig, submaps: VoxelSubmaps, verifier: Verifier, finder: PlanarFinder | None
    ) -> None:
        """Start without keyframes; ``finder`` aligns what is found within the drift, None in 3D."""
        self.config = config
        self.submaps = submaps
        self.verifier = verifier
        self.finder = finder
        self.next_m = 0.0  # path up to which there is no other search within the drift
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
        if self.finder is None and target < self.of_map:
            kept = self.target_in_map
            if kept in near and _distances_m(T_world, kept) <= _KEPT_M * keyframes[kept].scale:
                target = kept
            self.target_in_map = target
        closure = self._tried(keyframes, target, lie.between(T_world[target], T_world[-1]), old)
        self.target = target if closure.verdict is ClosureVerdict.ACCEPTED else -1
        if closure.verdict is ClosureVerdict.ACCEPTED or self.finder is None:
            return (closure,)
        if self.submaps.segments.is_assumed or keyframes[newest].traveled_m < self.next_m:
            return (closure,)
        if uncertainty_m is None:
            near, uncertainty_m = self._near(graph, old, connected)
        radius_m = float(uncertainty_m[near].max())
        if radius_m <= _BASIN_M:
            return (closure,)
        self.next_m = keyframes[newest].traveled_m + _INTERVAL * radius_m
        path = keyframes[max(len(keyframes) - self.submaps.half_width, self.of_map) :]  # the map has another frame
        found = self.finder.within_drift(path, keyframes[:old], T_world, near=near, radius_m=radius_m)
        return (closure,) if found is None else (closure, found)

    def in_map_at(self, T_world_newest: Pose, keyframes: Sequence[Keyframe]) -> tuple[Closure, ...]:
        """The closure of the newest keyframe to the map around a pose; none where the map is not near."""
        positions = np.array([each.T_odom_lidar[:-1, -1] for each in keyframes[: self.of_map]])
        away_m = np.linalg.norm(positions - T_world_newest[:-1, -1], axis=1)
        if away_m.min() > self.config.min_radius_m:
            return ()
        target = self.submaps.anchor_of(int(away_m.argmin()))
        T_first = lie.between(keyframes[target].T_odom_lidar, T_world_newest)
        return (self._tried(keyframes, target, T_first, self.of_map),)

    def _tried(self, keyframes: Sequence[Keyframe], target: int, T_first: Pose, old: int) -> Closure:
        """The closure of the newest keyframe to the submap around another one, accepted or not."""
        submap, newest = self.submaps.around(target, keyframes, old - 1), keyframes[-1]
        verified = self.verifier.scan(newest, submap, T_first, in_map=target < self.of_map)
        return verified.closure(target, newest.index)

    def _near(
        self, graph: PoseGraph, old: int, connected: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Older keyframes where the newest may be, of the map alone if any is; uncertainty (old,) of all."""
        uncertainty_m = self.drift.between(graph, len(graph) - 1, self.config.max_radius_m)[:old]
        reach_m = np.maximum(uncertainty_m, self.config.min_radius_m)
        near = np.flatnonzero(connected[:old] & (_distances_m(graph.poses, slice(old)) <= reach_m))
        return near[near < self.of_map] if (near < self.of_map).any() else near, uncertainty_m

    def _next(self, T_world: Matrix, old: int, connected: NDArray[np.bool_]) -> tuple[int, float]:
        """The nearest of the older keyframes, and its distance; in large graphs, the nearest one of a single pass.

        Thus revisits of a location that was passed many times do not each close to another pass, and its submaps
        are reused. In 3D it is the pass that was matched last. In 2D it is the first one: otherwise, after a slip
        of odometry in a corridor, the keyframes since would be closed to each other.
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


def on_first_pass(T_world: Matrix, chosen: NDArray[np.bool_], reach_m: float) -> int:
    """The keyframe of the first pass that is nearest to the newest one, of those chosen (n,); −1 without any.

    A pass consists of successive keyframes within reach and with about the same heading. T_world : (K, 3, 3)
    """
    distances_m = _distances_m(T_world, slice(len(chosen)))
    cosines = (T_world[: len(chosen), :2, 0] * T_world[-1, :2, 0]).sum(axis=1)
    near = np.flatnonzero(chosen & (distances_m <= reach_m) & (cosines >= np.cos(_SAME_PASS_RAD)))
    if not len(near):
        return -1
    goes_on = (np.diff(near) == 1) & (np.diff(distances_m[near]) <= 0.0)
    return int(near[np.argmin(np.append(goes_on, False))])


def _distances_m(T_world: Matrix, keyframes: NDArray[np.int64] | slice | int) -> NDArray[np.float64]:
    """Distances of some keyframes from the newest."""
    return np.linalg.norm(T_world[keyframes, :-1, -1] - T_world[-1, :-1, -1], axis=-1)
