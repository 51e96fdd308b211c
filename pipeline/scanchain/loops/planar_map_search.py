"""Relocalization in the plane: search of a whole map for the points along the path of a new segment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import MapsConfig
from scanchain.data import Closure, Keyframe, Matrix, Points, Pose, Problem, Proposal
from scanchain.graph.pose_graph import PoseGraph
from scanchain.kernels.search import FREE, NEAR, UNKNOWN
from scanchain.loops.connectivity import Segments
from scanchain.loops.evidence import rank_of
from scanchain.loops.submaps import VoxelSubmaps
from scanchain.loops.verification import Verifier
from scanchain.maps.occupancy_grid import OccupancyGrid, fitting_resolution
from scanchain.preprocess import downsample
from scanchain.registration import SearchGrid, Wanted, search

_MAX_CELLS = 16_000_000  # of the grid: a hundred megabytes with its pyramid; larger maps get larger cells
_CERTAIN = 0.6  # log-odds of occupancy, from which on a cell is a surface, and below minus which it is free
_POINTS, _MORE_POINTS = 120, 800  # number of points that poses are searched with and compared with
_APART_M, _APART_RAD = 1.0, 0.2  # least distance of two distinct poses
_ANSWERS = 12  # largest number of poses that are compared
_RIVAL = 0.75  # share of the best score, from which on other poses are compared with it
LEAST_SHARE = 0.35  # of the highest score: wrong poses of long paths come up to it
_CHANCE = 2.0  # what a search over all poses finds by chance: that much over the root of the number of points more
_AMBIGUOUS = 0.8  # share of the best score, from which on a pose elsewhere makes it ambiguous

_FIRST_M = 1.0  # distance traveled in a new segment before the first search of the whole map
_BACKOFF = 0.2  # share of the distance searched in vain that is traveled before the next search
_LEAST_INTERVAL_M = 0.5  # least distance traveled between two searches
_INTERVAL_M = 3.0  # largest distance traveled between two searches
_PATH_M = 8.0  # length of the path whose points are searched for: over it odometry drifts less than a cell or two
_AGREE_M, _AGREE_RAD = 0.5, 0.1  # largest difference between two results that confirm each other
_SOURCES, _SUBMAPS = 4, 6  # keyframes of the path that are aligned, and submaps that are tried for each
_NEAR_M = 8.0  # largest distance of such a submap's anchor


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A pose of the lidar in the map, and the mean score of its points as a share of the highest possible.

    ``rival`` is the share of the best pose elsewhere, 0 where none comes near; ``points`` is one a cell.
    """

    T_map_lidar: Pose
    share: float
    rival: float
    points: int

    @property
    def is_likely(self) -> bool:
        """True if the pose fits better than any does by chance."""
        return self.share >= LEAST_SHARE + _CHANCE / math.sqrt(self.points)

    @property
    def is_ambiguous(self) -> bool:
        """True if the points fit nearly as well elsewhere."""
        return self.rival > _AMBIGUOUS * self.share


class PlanarMapSearch:
    """Surfaces and free space of keyframes at their poses, in a grid in which all poses of a scan are searched.

    A point of the scan scores 1 on a surface, ½ beside it, −1 in free space and nothing where the map knows
    nothing, and the lidar itself stands in free space: a pose that fits walls but looks through others scores low.
    """

    def __init__(self, keyframes: Sequence[Keyframe], T_map_lidar: Matrix, resolution_m: float) -> None:
        """Draw keyframes at their poses (K, 3, 3)."""
        clouds = [keyframe.points for keyframe in keyframes]
        reach_m = max(float(np.abs(cloud).max(initial=0.0)) for cloud in clouds)
        self.resolution_m = fitting_resolution(
            T_map_lidar, resolution_m=resolution_m, max_range_m=reach_m, max_cells=_MAX_CELLS
        )
        config = msgspec.structs.replace(MapsConfig(), grid_resolution_m=self.resolution_m)
        grid = OccupancyGrid(config, max_range_m=math.inf)
        grid.insert_batch(T_map_lidar, np.vstack(clouds), np.append(0, np.cumsum([len(each) for each in clouds])))
        grid = grid.trimmed()
        log_odds = np.pad(grid.log_odds, 1)
        cells = np.where(log_odds < -_CERTAIN, FREE, UNKNOWN).astype(np.int8)
        search.draw_surfaces(cells, *np.nonzero(log_odds > _CERTAIN))
        room = (cells == FREE) | (cells == NEAR)
        self.grid = SearchGrid(cells, grid.origin_m - self.resolution_m, self.resolution_m, room)

    def best(self, points: Points, least: float) -> Hypothesis | None:
        """The pose that the points (N, 2), lidar frame, fit best; None where none has the least share."""
        search = WholeSearch(self, points, least)
        while not search.is_done:
            search.advance()
        return search.best()

    def likely(self, path: Sequence[Keyframe]) -> Hypothesis | None:
        """The pose of the middle keyframe of a path that its points fit best; None where they fit none."""
        T_middle_odom = lie.inverse(path[len(path) // 2].T_odom_lidar)
        points = np.vstack([lie.transform(T_middle_odom @ each.T_odom_lidar, each.points) for each in path])
        best = self.best(points, LEAST_SHARE)
        return best if best is not None and best.is_likely else None


class WholeSearch:
    """Search of a whole map for points, in slices of equal work; what it finds is compared with more points."""

    def __init__(self, target: PlanarMapSearch, points: Points, least: float) -> None:
        """Begin to search for points (N, 2), lidar frame; least : share of the highest score that counts."""
        points = np.random.default_rng(0).permutation(downsample(points, target.resolution_m))
        self.count = len(points)
        self.points = points[:_MORE_POINTS].copy()
        self.search = search.Search(points[:_POINTS], target.grid, None, Wanted(_APART_M, _RIVAL, _ANSWERS, least))

    @property
    def is_done(self) -> bool:
        """True once all poses were searched."""
        return self.search.is_done

    def advance(self) -> None:
        """Search on."""
        self.search.advance()

    def best(self) -> Hypothesis | None:
        """The pose that the points fit best; None where none has the least share."""
        step_rad = 0.5 * self.search.turn_rad
        found = [
            self.search.grid.climbed(self.points, each.T_target_source, step_rad) for each in self.search.poses()
        ]
        if not found:
            return None
        best = max(found, key=lambda each: each.share)
        apart = (each.share for each in found if _are_apart(each.T_target_source, best.T_target_source))
        return Hypothesis(best.T_target_source, best.share, max(apart, default=0.0), self.count)


class Relocalizer:
    """Search for a new segment in the older ones, as long as no loop joins it to them.

    All points of its path so far are searched for in the whole map, again and again as it travels. A pose is
    taken once it fits better than chance, no pose elsewhere fits nearly as well, an earlier search found the same
    one, and scans align there. A search in a large map goes on over several scans.
    """

    def __init__(self, submaps: VoxelSubmaps, verifier: Verifier, segments: Segments) -> None:
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
        self.next_m = keyframes[-1].traveled_m + min(max(_BACKOFF * traveled_m, _LEAST_INTERVAL_M), _INTERVAL_M)
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
        return tuple(sorted((each for each in closures if each is not None), key=rank_of, reverse=True))

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
            submap = self.submaps.around(anchor, keyframes, len(keyframes) - 1)
            verified = self.verifier.scan(keyframes[source], submap, T_first)
            off_m, off_rad = lie.apart(T_first, verified.match.T_target_source)
            is_off = off_m > _AGREE_M or off_rad > _AGREE_RAD
            far = Problem("far from where the path was found", f"{off_m:.1f} m from where the path was found")
            closure = verified.closure(anchor, source, Proposal.PLACE, problem=far if is_off else None)
            if best is None or (rank_of(closure) > rank_of(best)):
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


def _are_apart(T: Pose, T_other: Pose) -> bool:
    """True for two poses that are not the same."""
    away_m = np.abs(T[:2, 2] - T_other[:2, 2]).max()
    return bool(away_m >= _APART_M or lie.apart(T, T_other)[1] >= _APART_RAD)


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
