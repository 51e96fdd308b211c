"""Search for a 3D log in a map: upright structure of both, correlated as seen from above, verified in space."""

from __future__ import annotations

import io
import math
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config, LocalMapConfig
from scanchain.data import Closure, ClosureVerdict, Keyframe, Matrix, Points, Pose, Problem, Proposal
from scanchain.errors import InputError
from scanchain.files import write_whole
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.connectivity import Segments
from scanchain.loops.evidence import pose_by
from scanchain.loops.submaps import Submap, level_frame, upright_frame
from scanchain.loops.verification import Verifier
from scanchain.maps.saved_map import read_arrays
from scanchain.registration import SearchGrid, Wanted, Window, find
from scanchain.registration.search import Found, Search, evenly, upright_columns

_MEMBERS = 10  # number of the newest keyframes that are sought together
_RADIUS = 1.5  # radii of a submap, up to which structure around the lidar is sought
_COLUMNS = 150  # number of columns that are scored, evenly spread
_COARSE, _COARSE_COLUMNS, _COARSE_SEEDS = 2.0, 100, 12  # cells, in fine ones, and numbers of the first search
_REFINED_RAD = 0.15  # half width of the window in heading around what it found
_MIN_COLUMNS = 30  # number of columns, below which there is too little to see
_MAX_CELLS = 1 << 21  # of the coarse grid of a map; a larger one has coarser cells
_VERIFIED = 3  # number of poses that are verified in one scan
_MIN_SHARE = 0.55  # least share of the columns that lie on the map's
_RIVAL = 0.85  # share of the best score, from which on another pose is verified, too
_SEEDS = 4  # largest number of poses that are verified
_APART = 4.0  # least distance of two distinct poses, cells
_MIN_AGREEMENT = 0.8  # least agreement about free space with a map of another day: cars and people are others
_REACH = 0.5  # radii of a submap from the map's keyframes, beyond which nothing is verified
_LEVEL_M = 2.0  # least difference in height of two stories
_MAX_LEVELS = 3  # number of stories that are tried
_STEP_M = 1.0  # least path between two searches
_BACKOFF = 0.1  # path between two searches, as a share of what was searched so far
_INTERVAL_M = 5.0  # largest path between two searches
_AGREE_M, _AGREE_RAD = 1.0, 0.05  # largest difference between the poses that two finds imply
_MATCH_M = 3.5  # path between two matches with the map, at full scale
_TRACKED_M = 20.0  # path since the last match with the map, up to which it is not searched
_DRIFT = 0.1  # largest distance from the prediction, as a share of the path since the last match
PLACES_FILE = "places.npz"
VERSION = 1
_TOGETHER = 10  # number of keyframes whose points are seen together; drift between more would raise the ground
_MAX_LEVELED = 16  # number of keyframes, evenly spread, whose ground says where the map's vertical is
_ALIKE = Problem.plain("another place of the map is as similar")


@dataclass(frozen=True, slots=True)
class Outline:
    """Upright structure of a map.

    Attributes
    ----------
    T_map_level : (4, 4) rotation to the frame whose z axis is normal to the ground, on average
    columns : (M, 2) where it is upright, level frame
    size_m : edge length of the cells that the map was seen in
    """

    T_map_level: Pose
    columns: Matrix
    size_m: float


class MapSearch:
    """Search for the newest keyframes in a map, as long as no closure joins them or none has for a while.

    In a large map a search goes on over several scans: each does a bounded part of it, by counts and not by the
    clock, so that a live log is not held up and results are the same on any machine.
    """

    def __init__(self, config: Config, segments: Segments, keyframes: Sequence[Keyframe], folder: Path) -> None:
        """Take the keyframes of a map; the outline is kept in its folder."""
        self.config = config
        self.segments = segments
        self.verifier = Verifier(config)
        self.of_map = len(keyframes)
        self.radius_m = config.loops.place_radius_m * float(np.median([each.scale for each in keyframes]))
        outline = outline_of(folder, keyframes, config.local_map)
        self.T_map_keyframes = np.array([each.T_odom_lidar for each in keyframes])
        self.T_level_keyframes = lie.inverse(outline.T_map_level) @ self.T_map_keyframes
        self.size_m, self.columns = outline.size_m, outline.columns
        self.grid: SearchGrid | None = None  # drawn when first searched
        self.search: Generator[None, None, Closure | None] | None = None  # the one that is under way
        self.has_advanced = False  # in the present scan
        self.next_m = 0.0
        self.matched_m = -math.inf  # path up to the last match with the map

    def has_just_matched(self, keyframes: Sequence[Keyframe]) -> bool:
        """True while the last match with the map lies so little behind the newest keyframe that none is due."""
        newest = keyframes[-1]
        since_m = newest.traveled_m - self.matched_m
        return since_m < _MATCH_M * newest.scale and self.segments.starts[-1] != newest.index

    def take(self, keyframes: Sequence[Keyframe], closures: Sequence[Closure]) -> None:
        """Remember whether the newest keyframe, of these closures, matches the map; then no search goes on."""
        if any(each.verdict is ClosureVerdict.ACCEPTED and each.target < self.of_map for each in closures):
            self.matched_m = keyframes[-1].traveled_m
            self.search = None

    def is_tracking(self, keyframes: Sequence[Keyframe]) -> bool:
        """True while the last match with the map lies little behind the newest keyframe."""
        return keyframes[-1].traveled_m - self.matched_m <= _TRACKED_M

    def close(
        self, keyframes: Sequence[Keyframe], graph: PoseGraph, components: NDArray[np.int64]
    ) -> tuple[Closure, ...]:
        """Closures of the newest keyframe with the map; the first that agree with each other are accepted.

        components : (K,) of ``Segments.components``
        """
        newest, start = keyframes[-1], self.segments.starts[-1]
        if newest.index == start:
            self.search = None  # of keyframes that the newest is not joined to
        is_due = newest.traveled_m >= self.next_m or newest.index == start
        if self.search is None and is_due:
            begun_m = self._begun_m(keyframes, components)
            self.next_m = newest.traveled_m + min(
                max(_BACKOFF * (newest.traveled_m - begun_m), _STEP_M), _INTERVAL_M
            )
            members = keyframes[max(start, len(keyframes) - _MEMBERS) :]
            self.search = self._found(members, keyframes)
        return () if self.has_advanced else self._go_on(keyframes, graph, components)

    def advance(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Closures, as of ``close``, of the search that is under way, which does its part of a new scan."""
        self.has_advanced = self.search is not None
        if self.search is None:
            return ()
        return self._go_on(keyframes, graph, self.segments.components(graph))

    def finish(
        self, keyframes: Sequence[Keyframe], graph: PoseGraph, components: NDArray[np.int64]
    ) -> tuple[Closure, ...]:
        """Complete the search that is under way, if any."""
        closures: tuple[Closure, ...] = ()
        while self.search is not None:
            closures = self._go_on(keyframes, graph, components)
        return closures

    def _go_on(
        self, keyframes: Sequence[Keyframe], graph: PoseGraph, components: NDArray[np.int64]
    ) -> tuple[Closure, ...]:
        if self.search is None:
            return ()
        try:
            next(self.search)
        except StopIteration as over:
            self.search = None
            return self._judged(over.value, keyframes, graph, components)
        return ()

    def _begun_m(self, keyframes: Sequence[Keyframe], components: NDArray[np.int64]) -> float:
        """Path up to where the search began: the last match with the map, or the begin of the segment."""
        is_joined = components[-1] == components[0]
        return self.matched_m if is_joined else keyframes[self.segments.starts[-1]].traveled_m

    def _judged(
        self,
        closure: Closure | None,
        keyframes: Sequence[Keyframe],
        graph: PoseGraph,
        components: NDArray[np.int64],
    ) -> tuple[Closure, ...]:
        """Closures by the result of a search, accepted where another find agrees."""
        if closure is None or closure.verdict is ClosureVerdict.REJECTED:
            return () if closure is None else (closure,)
        self.next_m = keyframes[-1].traveled_m + _STEP_M
        if components[-1] == components[0]:
            gone_m = keyframes[closure.source].traveled_m - self.matched_m
            problem = self._contradiction(closure, keyframes, graph.poses, gone_m)
            if problem:
                return (closure.rejected(problem),)
        return (closure,)

    def is_repeated(self, newest: int, keyframes: Sequence[Keyframe]) -> bool:
        """True if what keyframes of the map up to one of them show is elsewhere in the map as well."""
        search = self._found(keyframes[max(newest + 1 - _MEMBERS, 0) : newest + 1], keyframes)
        while True:
            try:
                next(search)
            except StopIteration as over:
                return over.value is not None and over.value.cause == _ALIKE.cause

    def _found(
        self, members: Sequence[Keyframe], keyframes: Sequence[Keyframe]
    ) -> Generator[None, None, Closure | None]:
        """The closure of the newest of the members with the map, verified or not; None where nothing is alike.

        Yields where the work of one scan is done.
        """
        newest = members[-1]
        T_newest_level = level_frame(newest, self.config.local_map)
        seeds = yield from self._seeds(_together(members, lie.inverse(T_newest_level)))
        source = Submap(newest, members, self.radius_m)
        tried: list[Closure] = []
        for seed in seeds:
            for target in self._stories(seed.T_target_source[:2, 2]):
                if len(tried) % _VERIFIED == 0:
                    yield
                T_level_source = self._on_ground(keyframes[target], seed.T_target_source) @ lie.inverse(
                    T_newest_level
                )
                T_first = lie.inverse(self.T_level_keyframes[target]) @ T_level_source
                verified = self.verifier.submap(
                    source, self._submap(target, keyframes), T_first, min_agreement=_MIN_AGREEMENT
                )
                tried.append(verified.closure(target, newest.index, Proposal.PLACE))
        accepted = [each for each in tried if each.verdict is ClosureVerdict.ACCEPTED]
        if not accepted:
            return tried[0] if tried else None
        best = max(accepted, key=lambda each: each.overlap)
        poses = [pose_by(each, newest.index, keyframes, self.T_map_keyframes) for each in (best, *accepted)]
        off_m, off_rad = np.array([lie.apart(poses[0], each) for each in poses]).T
        return best if (off_m < _AGREE_M).all() and (off_rad < _AGREE_RAD).all() else best.rejected(_ALIKE)

    def _seeds(self, points: Points) -> Generator[None, None, Sequence[Found]]:
        """The best poses (3, 3) in the map's level frame, sought coarsely, then refined."""
        near = points[np.abs(points[:, :2]).max(axis=1, initial=0.0) < _RADIUS * self.radius_m]
        columns = evenly(upright_columns(near, self.size_m), _COLUMNS)
        if len(columns) < _MIN_COLUMNS or not len(self.columns):
            return ()
        if self.grid is None:
            self.grid = self._drawn()
        coarse_m = self.grid.resolution_m
        wanted = Wanted(_APART * coarse_m, _RIVAL, _COARSE_SEEDS, _MIN_SHARE)
        search = Search(evenly(columns, _COARSE_COLUMNS), self.grid, None, wanted)
        search.advance()
        while not search.is_done:
            yield
            search.advance()
        reach_m = 2.0 * _RADIUS * self.radius_m + coarse_m
        seeds: list[Found] = []
        for coarse in search.poses():
            surfaces = self.columns[np.abs(self.columns - coarse.T_target_source[:2, 2]).max(axis=1) < reach_m]
            around = Window(coarse.T_target_source, coarse_m, _REFINED_RAD)
            seeds += find(columns, SearchGrid.of_points(surfaces, self.size_m), around, wanted._replace(answers=1))
        best_first = sorted(seeds, key=lambda each: -each.share)[:_SEEDS]
        return [each for each in best_first if each.share >= _RIVAL * best_first[0].share]

    def _drawn(self) -> SearchGrid:
        """The coarse grid of the map; poses that it finds may be a cell farther off than those verified."""
        positions = self.T_level_keyframes[:, :2, 3]
        reach_m = _REACH * self.radius_m + _COARSE * self.size_m
        extent = np.vstack([self.columns, positions - reach_m, positions + reach_m])
        area_m2 = float(np.ptp(extent, axis=0).prod())
        return SearchGrid.of_points(
            self.columns,
            max(_COARSE * self.size_m, math.sqrt(area_m2 / _MAX_CELLS)),
            near=positions,
            reach_m=reach_m,
        )

    def _stories(self, place: NDArray[np.float64]) -> list[int]:
        """Keyframes of the map nearest to a place (2,), one on each story."""
        positions = self.T_level_keyframes[:, :3, 3]
        away_m = np.linalg.norm(positions[:, :2] - place, axis=1)
        chosen: list[int] = []
        for index in np.argsort(away_m, kind="stable").tolist():
            if away_m[index] > _REACH * self.radius_m or len(chosen) == _MAX_LEVELS:
                break
            if (np.abs(positions[chosen, 2] - positions[index, 2]) > _LEVEL_M).all():
                chosen.append(index)
        return chosen

    def _on_ground(self, target: Keyframe, T_plane_source: Pose) -> Pose:
        """T_level_source of a level source at a place, on the plane of the ground around the target."""
        T_level_target = self.T_level_keyframes[target.index]
        up = T_level_target[:3, :3] @ level_frame(target, self.config.local_map)[:3, 2]
        T = upright_frame(up, np.append(T_plane_source[:2, 0], 0.0))
        aside = T_plane_source[:2, 2] - T_level_target[:2, 3]
        T[:2, 3] = T_plane_source[:2, 2]
        T[2, 3] = T_level_target[2, 3] - float(aside @ up[:2]) / float(up[2])
        return T

    def _submap(self, target: int, keyframes: Sequence[Keyframe]) -> Submap:
        """The keyframes of the map around one of them, whichever path they lie on."""
        away_m = np.linalg.norm(self.T_level_keyframes[:, :3, 3] - self.T_level_keyframes[target, :3, 3], axis=1)
        members = [keyframes[index] for index in np.flatnonzero(away_m < self.radius_m).tolist()]
        return Submap(keyframes[target], members, self.radius_m)

    def _contradiction(
        self, closure: Closure, keyframes: Sequence[Keyframe], T_world: Matrix, traveled_m: float
    ) -> Problem | None:
        """Why a find contradicts the prediction since the last match, None if it does not."""
        T_found = pose_by(closure, closure.source, keyframes, T_world)
        moved_m = lie.apart(T_world[closure.source], T_found)[0]
        if moved_m <= max(_DRIFT * traveled_m, self.config.loops.min_radius_m):
            return None
        limit = f"from the prediction, more than {100.0 * _DRIFT:g} % of the path between"
        return Problem(f"far {limit}", f"{moved_m:.1f} m {limit}")


def outline_of(folder: Path, keyframes: Sequence[Keyframe], config: LocalMapConfig) -> Outline:
    """The outline of a map in this folder, which holds it from the first time on where it can be written to.

    keyframes : of the map; their ``T_odom_lidar`` is T_map_lidar
    """
    path = folder / PLACES_FILE
    stored = _stored(path, len(keyframes))
    if stored is not None:
        return stored
    size_m = config.voxel_size_m * float(np.median([keyframe.scale for keyframe in keyframes]))
    T_map_level = level_of(keyframes, [keyframe.T_odom_lidar for keyframe in keyframes], config)
    columns = _columns(keyframes, lie.inverse(T_map_level), size_m).astype(np.float32)  # as it is stored
    data = io.BytesIO()
    np.savez(
        data,
        version=VERSION,
        keyframes=len(keyframes),
        T_map_level=T_map_level,
        columns=columns,
        size_m=size_m,
    )
    with suppress(OSError):  # a map that cannot be written to is searched all the same
        write_whole(path, data.getvalue())
    return Outline(T_map_level, columns.astype(np.float64), size_m)


def _stored(path: Path, count: int) -> Outline | None:
    """The outline on disk; None where there is none of this version and number of keyframes."""
    try:
        file = read_arrays(path)
        if (int(file["version"]), int(file["keyframes"])) != (VERSION, count):
            return None
        return Outline(file["T_map_level"], file["columns"].astype(np.float64), float(file["size_m"]))
    except (InputError, ValueError, KeyError, TypeError):
        return None


def level_of(keyframes: Sequence[Keyframe], poses: Sequence[Pose] | Matrix, config: LocalMapConfig) -> Pose:
    """T_map_level by the ground around some of the keyframes, whose poses in the map these are."""
    step = max(-(-len(keyframes) // _MAX_LEVELED), 1)
    chosen = zip(keyframes[::step], poses[::step], strict=True)
    up = sum((T[:3, :3] @ level_frame(k, config)[:3, 2] for k, T in chosen), np.zeros(3))
    return upright_frame(up / np.linalg.norm(up))


def _columns(keyframes: Sequence[Keyframe], T_level_map: Pose, size_m: float) -> Matrix:
    """Upright columns (M, 2), one a cell."""
    seen: list[NDArray[np.float64]] = []
    for first in range(0, len(keyframes), _TOGETHER):
        members = keyframes[first : first + _TOGETHER]
        seen.append(
            upright_columns(
                np.vstack([lie.transform(T_level_map @ each.T_odom_lidar, each.points) for each in members]),
                size_m,
            )
        )
    columns = np.vstack(seen)
    return columns[np.unique(np.floor(columns / size_m), axis=0, return_index=True)[1]]


def _together(members: Sequence[Keyframe], T_level_newest: Pose) -> Points:
    """(N, 3) points of keyframes in the level frame of the last one."""
    T_level_odom = T_level_newest @ lie.inverse(members[-1].T_odom_lidar)
    return np.vstack([lie.transform(T_level_odom @ each.T_odom_lidar, each.points) for each in members])
