"""Place recognition in 3D: bird's-eye-view correlation of upright structure, within the drift or in a map."""

from __future__ import annotations

import io
import math
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.config import Config, LocalMapConfig
from scanchain.data import Closure, ClosureVerdict, Keyframe, Matrix, Points, Pose, Problem, Proposal
from scanchain.errors import InputError
from scanchain.files import write_whole
from scanchain.loops.evidence import AGREE
from scanchain.loops.place_search import Underway, candidates, completed
from scanchain.loops.recognizer import PLACE_DRIFT, Candidate, Query
from scanchain.loops.submaps import Submap, level_frame, seen_together, upright_frame
from scanchain.loops.verification import Verifier
from scanchain.maps.saved_map import read_arrays
from scanchain.registration import SearchGrid, Wanted, Window, find
from scanchain.registration.search import Found, Search, evenly, upright_columns

# of every search
_COLUMNS = (30, 150)  # least number of columns for a search, and most that are scored, evenly spread
_APART = 4.0  # least distance of two distinct poses, cells
_REFINED_RAD = 0.15  # half width in heading of the window around a coarse pose in which it is refined

# of a submap in older ones, within the drift
_HEADING_RAD = 0.5  # largest error of the heading of odometry
_MAX_REACH_M, _MAX_WIDE = 1000.0, 800  # half width of the window, and cells along it; beyond, cells grow
_MIN_APART = 0.25  # least distance in radii of a submap between a pose and its rival
_MOST = 8  # largest number of older submaps that a pose is refined in, and of those verified
_REFINED = 3.0  # half width of the window of refinement, cells
_TOUCHING = 1.5  # cells, within which a column lies on another one

# of keyframes in a whole map
MEMBERS = 10  # number of keyframes whose points are combined; over more, drift would make ground look upright
_RADIUS = 1.5  # radii of a submap up to which structure around the lidar is used
_COARSE, _COARSE_COLUMNS = 2.0, 100  # of the coarse search: cell size in fine cells, largest number of columns
_MAX_CELLS = 1 << 21  # of the coarse grid of a map; a larger one has coarser cells
_MIN_SHARE_IN_MAP = 0.55  # least share of the columns that lie on the map's
_RIVAL_IN_MAP, _POSES_IN_MAP = 0.85, 4  # share of the best score above which a pose is verified, too; most of them
_PER_SCAN = 3  # number of poses that are verified per scan
_MIN_AGREEMENT = 0.8  # least free-space agreement with a map of another day: cars and people differ
_REACH_IN_MAP = 0.5  # radii of a submap from the map's keyframes, beyond which nothing is verified
_LEVEL_M, _MAX_LEVELS = 2.0, 3  # least difference in height of two stories, and number of them that are tried
_AMBIGUOUS = Problem.plain("another location in the map is as similar")

# of the outline of a map
PLACES_FILE, VERSION = "places.npz", 1
_MAX_LEVELED = 16  # number of keyframes, evenly spread, whose ground gives the map's vertical


@dataclass(frozen=True, slots=True)
class SubmapOutline:
    """Upright columns (M, 2) of a submap in its level frame; T_anchor_level is the pose of that frame."""

    anchor: int
    T_anchor_level: Pose
    columns: Points
    tree: KDTree


class OutlineRecognizer:
    """Proposes poses at which the upright structure of a submap matches older ones, from any viewing direction.

    All poses that the drift allows are searched in the combined outlines of all older submaps, at their poses in
    the graph; each match is then refined in those individual outlines that it overlaps most.
    """

    def __init__(self, config: Config, dimension: int) -> None:
        if dimension != 3:
            raise InputError("loops.recognizer outline is for 3D logs; leave it at auto in a 2D log")
        self.config = config
        self.outlines: list[SubmapOutline] = []

    def add(self, submap: Submap) -> None:
        """Store the outline of a submap."""
        T_anchor_level = level_frame(submap.anchor, self.config.local_map)
        points = lie.transform(lie.inverse(T_anchor_level), submap.points())
        columns = upright_columns(points, self.config.local_map.voxel_size_m * submap.anchor.scale)
        self.outlines.append(SubmapOutline(submap.anchor.index, T_anchor_level, columns, KDTree(columns)))

    def query(self, query: Query) -> list[Candidate]:
        """The best few of the poses that fit, each with the older submaps that it overlaps most.

        Far from the expected pose, a pose with a rival elsewhere is ambiguous.
        """
        newest, keyframes, limits = self.outlines[-1], query.keyframes, self.config.loops
        here, radius_m = query.submap.anchor, query.submap.radius_m
        old = [each for each in self.outlines if keyframes[each.anchor].traveled_m <= query.max_traveled_m]
        if not old or len(newest.columns) < _COLUMNS[0]:
            return []
        T_old, T_expected = _in_plane(old, newest, query)
        path_m = here.traveled_m - np.array([keyframes[each.anchor].traveled_m for each in old])
        reach_m = np.clip(PLACE_DRIFT * path_m, limits.min_radius_m, _MAX_REACH_M)
        near = np.flatnonzero(_away_m(T_old, T_expected) <= reach_m + radius_m)
        if not len(near):
            return []
        within_m, fine_m = float(reach_m[near].max()), self.config.local_map.voxel_size_m * here.scale
        size_m = max(fine_m, 2.0 * within_m / _MAX_WIDE)
        combined = np.vstack([lie.transform(T_old[k], old[k].columns) for k in near.tolist()])
        window = Window(T_expected, within_m, _HEADING_RAD)
        # half of the columns is hidden from the other side
        wanted = Wanted(apart_m=_APART * size_m, rival=0.9, answers=8, least=0.4)
        found = find(evenly(newest.columns, _COLUMNS[1]), SearchGrid.of_points(combined, size_m), window, wanted)
        poses = np.array([each.T_target_source for each in found]).reshape(-1, 3, 3)
        candidates: list[Candidate] = []
        for T in poses:
            adjacent = near[_away_m(T_old[near], T) <= radius_m].tolist()
            T_targets = {k: lie.between(T_old[k], T) for k in adjacent}
            touching = {k: _touching(newest.columns, old[k], T_targets[k], size_m) for k in adjacent}
            for k in sorted(adjacent, key=lambda k: -touching[k])[:_MOST]:
                drift_m = float(np.clip(limits.drift * path_m[k], limits.min_radius_m, limits.max_radius_m))
                by, rival = Proposal.POSITION, -1
                if _away_m(T, T_expected) > drift_m:
                    by = Proposal.PLACE
                    elsewhere = poses[_away_m(poses, T) > max(_MIN_APART * radius_m, drift_m)]
                    rival = old[int(np.argmin(_away_m(T_old, elsewhere[0])))].anchor if len(elsewhere) else -1
                for fit in _refined(newest.columns, old[k].columns, fine_m, T_targets[k], _REFINED * size_m):
                    T_level = old[k].T_anchor_level @ lie.lift(fit.T_target_source)
                    T_target_source = T_level @ lie.inverse(newest.T_anchor_level)
                    candidates.append(Candidate(old[k].anchor, T_target_source, fit.share, by, rival))
        return sorted(candidates, key=lambda each: -each.score)[:_MOST]


def _in_plane(old: Sequence[SubmapOutline], newest: SubmapOutline, query: Query) -> tuple[Matrix, Pose]:
    """Poses (N, 3, 3) of the level frames of older submaps, and the expected one of the newest, from above."""
    T_world_old = query.T_world[[each.anchor for each in old]] @ np.array([each.T_anchor_level for each in old])
    up = T_world_old[:, :3, 2].mean(axis=0)
    T_level_world = lie.inverse(upright_frame(up / np.linalg.norm(up)))
    T_world_newest = query.T_world_anchor @ newest.T_anchor_level
    return lie.flatten(T_level_world @ T_world_old), lie.flatten(T_level_world @ T_world_newest)


def _touching(columns: Points, outline: SubmapOutline, T: Pose, size_m: float) -> float:
    """Share of columns (N, 2) that lie on those of an outline at this pose in it."""
    away_m = outline.tree.query(lie.transform(T, columns), distance_upper_bound=_TOUCHING * size_m)[0]
    return float(np.isfinite(away_m).mean())


def _away_m(T: Matrix, T_other: Pose) -> NDArray[np.float64]:
    return np.linalg.norm(T[..., :2, 2] - T_other[:2, 2], axis=-1)


@dataclass(frozen=True, slots=True)
class MapOutline:
    """Upright structure of a map.

    T_map_level : (4, 4) of the frame whose z axis is normal to the ground, on average, its origin at whole 100 km
    columns : (M, 2) positions of upright structure, level frame
    size_m : edge length of the cells of the columns
    """

    T_map_level: Pose
    columns: Matrix
    size_m: float


class UprightMap:
    """Keyframes at their world poses, and their upright structure, in which poses are searched."""

    def __init__(self, keyframes: Sequence[Keyframe], config: Config, folder: Path | None = None) -> None:
        """Extract the upright structure of keyframes; the folder of a map caches it."""
        self.config, self.keyframes, self.verifier = config, keyframes, Verifier(config)
        self.radius_m = config.loops.place_radius_m * float(np.median([each.scale for each in keyframes]))
        outline = outline_of(folder, keyframes, config.local_map)
        self.T_world = np.array([each.T_odom_lidar for each in keyframes])
        self.T_level = lie.inverse(outline.T_map_level) @ self.T_world
        self.size_m, self.columns = outline.size_m, outline.columns
        self.grid: SearchGrid | None = None  # rasterized at the first search

    def found(self, members: Sequence[Keyframe]) -> Generator[None, None, Closure | None]:
        """The closure of the last one of some keyframes with one of the map; None if nothing is similar."""
        newest = members[-1]
        T_newest_level = level_frame(newest, self.config.local_map)
        T_level_odom = lie.inverse(T_newest_level) @ lie.inverse(newest.T_odom_lidar)
        seeds = yield from self.seeds(seen_together(members, T_level_odom))
        source = Submap(newest, members, self.radius_m)
        tried: list[tuple[Closure, Pose]] = []  # and T_world_newest by it
        for seed in seeds:
            for k in self.stories(seed.T_target_source[:2, 2]):
                if len(tried) % _PER_SCAN == 0:
                    yield
                T_first = self.on_ground(k, seed.T_target_source) @ lie.inverse(T_newest_level)
                verified = self.verifier.submap(source, self.submap(k), T_first, min_agreement=_MIN_AGREEMENT)
                closure = verified.closure(self.keyframes[k].index, newest.index, Proposal.PLACE)
                tried.append((closure, self.T_world[k] @ closure.match.T_target_source))
        accepted = [each for each in tried if each[0].verdict is ClosureVerdict.ACCEPTED]
        if not accepted:
            return tried[0][0] if tried else None
        best, T_best = max(accepted, key=lambda each: each[0].overlap)
        return best if all(lie.agree(T_best, T, *AGREE) for _, T in accepted) else best.rejected(_AMBIGUOUS)

    def is_repeated(self, members: Sequence[Keyframe]) -> bool:
        """True if the structure around some keyframes is found at several locations in the map."""
        closure = completed(self.found(members))
        return closure is not None and closure.cause == _AMBIGUOUS.cause

    def seeds(self, points: Points) -> Generator[None, None, Sequence[Found]]:
        """The best poses (3, 3) of points in the level frame of the map, from a coarse search, then refined."""
        near = points[np.abs(points[:, :2]).max(axis=1, initial=0.0) < _RADIUS * self.radius_m]
        columns = evenly(upright_columns(near, self.size_m), _COLUMNS[1])
        if len(columns) < _COLUMNS[0] or not len(self.columns):
            return ()
        if self.grid is None:
            self.grid = self._rasterized()
        coarse_m = self.grid.resolution_m
        wanted = Wanted(apart_m=_APART * coarse_m, rival=_RIVAL_IN_MAP, answers=12, least=_MIN_SHARE_IN_MAP)
        reach_m = 2.0 * _RADIUS * self.radius_m + coarse_m

        def refine(T: Pose) -> Sequence[Found]:
            surfaces = self.columns[np.abs(self.columns - T[:2, 2]).max(axis=1) < reach_m]
            return _refined(columns, surfaces, self.size_m, T, coarse_m, _MIN_SHARE_IN_MAP)

        search = Search(evenly(columns, _COARSE_COLUMNS), self.grid, None, wanted)
        best_first = yield from candidates(search, refine)
        return [each for each in best_first[:_POSES_IN_MAP] if each.share >= _RIVAL_IN_MAP * best_first[0].share]

    def stories(self, position: NDArray[np.float64]) -> list[int]:
        """Numbers of the keyframes nearest to a position (2,), one on each story."""
        positions = self.T_level[:, :3, 3]
        away_m = np.linalg.norm(positions[:, :2] - position, axis=1)
        chosen: list[int] = []
        for k in np.argsort(away_m, kind="stable").tolist():
            if away_m[k] > _REACH_IN_MAP * self.radius_m or len(chosen) == _MAX_LEVELS:
                break
            if (np.abs(positions[chosen, 2] - positions[k, 2]) > _LEVEL_M).all():
                chosen.append(k)
        return chosen

    def on_ground(self, k: int, T_plane_source: Pose) -> Pose:
        """T_target_source of a level source at a planar pose, on the ground plane around the k-th keyframe."""
        T_level_target = self.T_level[k]
        up = T_level_target[:3, :3] @ level_frame(self.keyframes[k], self.config.local_map)[:3, 2]
        T = upright_frame(up, np.append(T_plane_source[:2, 0], 0.0))
        aside = T_plane_source[:2, 2] - T_level_target[:2, 3]
        T[:2, 3] = T_plane_source[:2, 2]
        T[2, 3] = T_level_target[2, 3] - float(aside @ up[:2]) / float(up[2])
        return lie.inverse(T_level_target) @ T

    def submap(self, k: int) -> Submap:
        """The submap of the keyframes around the k-th one, of all passes."""
        away_m = np.linalg.norm(self.T_level[:, :3, 3] - self.T_level[k, :3, 3], axis=1)
        members = [self.keyframes[index] for index in np.flatnonzero(away_m < self.radius_m).tolist()]
        return Submap(self.keyframes[k], members, self.radius_m)

    def _rasterized(self) -> SearchGrid:
        """The coarse grid of the map; poses are searched up to a cell farther out than they are verified."""
        positions = self.T_level[:, :2, 3]
        reach_m = _REACH_IN_MAP * self.radius_m + _COARSE * self.size_m
        extent = np.vstack([self.columns, positions - reach_m, positions + reach_m])
        area_m2 = float(np.ptp(extent, axis=0).prod())
        return SearchGrid.of_points(
            self.columns,
            max(_COARSE * self.size_m, math.sqrt(area_m2 / _MAX_CELLS)),
            near=positions,
            reach_m=reach_m,
        )


class UprightFinder:
    """Search for the last keyframes of a path in older ones, by bird's-eye view; then verified in 3D."""

    first_m, least_m, most_m = 0.0, 1.0, 2.0
    match_m = 3.5

    def __init__(self, config: Config) -> None:
        self.config = config
        self.searches = self.ambiguous = 0

    def draw(self, keyframes: Sequence[Keyframe], folder: Path | None = None) -> UprightMap:
        """The upright structure of keyframes."""
        return UprightMap(keyframes, self.config, folder)

    def find(self, keyframes: Sequence[Keyframe], start: int, target: UprightMap) -> Underway:
        """The closure of the newest keyframe with the older ones, verified or not; see ``Finder``."""
        closure = yield from target.found(keyframes[max(start, len(keyframes) - MEMBERS) :])
        self.searches += 1
        self.ambiguous += closure is not None and closure.cause == _AMBIGUOUS.cause
        return () if closure is None else (closure,)


def outline_of(folder: Path | None, keyframes: Sequence[Keyframe], config: LocalMapConfig) -> MapOutline:
    """The outline of keyframes; a map's folder caches it if it is writable.

    keyframes : of the map; their ``T_odom_lidar`` is T_map_lidar
    """
    stored = None if folder is None else _stored(folder / PLACES_FILE, len(keyframes))
    if stored is not None:
        return stored
    size_m = config.voxel_size_m * float(np.median([keyframe.scale for keyframe in keyframes]))
    T_map_level = level_of(keyframes, [keyframe.T_odom_lidar for keyframe in keyframes], config)
    T_map_level[:3, 3] = np.round(np.mean([each.T_odom_lidar[:3, 3] for each in keyframes], axis=0), -5)
    columns = _columns(keyframes, lie.inverse(T_map_level), size_m).astype(np.float32)  # as it is stored
    if folder is not None:
        data, count = io.BytesIO(), len(keyframes)
        np.savez(data, version=VERSION, keyframes=count, T_map_level=T_map_level, columns=columns, size_m=size_m)
        with suppress(OSError):  # a read-only map is searched without the cache
            write_whole(folder / PLACES_FILE, data.getvalue())
    return MapOutline(T_map_level, columns.astype(np.float64), size_m)


def _stored(path: Path, count: int) -> MapOutline | None:
    """The outline on disk; None where there is none of this version and number of keyframes."""
    try:
        file = read_arrays(path)
        if (int(file["version"]), int(file["keyframes"])) != (VERSION, count):
            return None
        return MapOutline(file["T_map_level"], file["columns"].astype(np.float64), float(file["size_m"]))
    except (InputError, ValueError, KeyError, TypeError):
        return None


def level_of(keyframes: Sequence[Keyframe], poses: Sequence[Pose] | Matrix, config: LocalMapConfig) -> Pose:
    """T_map_level from the ground around some of the keyframes, given their poses in the map."""
    step = max(-(-len(keyframes) // _MAX_LEVELED), 1)
    chosen = zip(keyframes[::step], poses[::step], strict=True)
    up = sum((T[:3, :3] @ level_frame(k, config)[:3, 2] for k, T in chosen), np.zeros(3))
    return upright_frame(up / np.linalg.norm(up))


def _columns(keyframes: Sequence[Keyframe], T_level_map: Pose, size_m: float) -> Matrix:
    """Upright columns (M, 2), one per cell."""
    seen: list[NDArray[np.float64]] = []
    for first in range(0, len(keyframes), MEMBERS):
        members = keyframes[first : first + MEMBERS]
        seen.append(upright_columns(seen_together(members, T_level_map), size_m))
    columns = np.vstack(seen)
    return columns[np.unique(np.floor(columns / size_m), axis=0, return_index=True)[1]]


def _refined(
    columns: Points, surfaces: Points, size_m: float, T: Pose, half_width_m: float, least: float = 0.0
) -> Sequence[Found]:
    """The pose of columns (N, 2) near a coarse one that fits other columns (M, 2) best; empty if none fits."""
    around = Window(T, half_width_m, _REFINED_RAD)
    wanted = Wanted(_APART * size_m, 1.0, 1, least)
    return find(evenly(columns, _COLUMNS[1]), SearchGrid.of_points(surfaces, size_m), around, wanted)
