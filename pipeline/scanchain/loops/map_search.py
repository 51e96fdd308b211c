"""Search of a whole map in space: its upright structure and that of a path, correlated as seen from above."""

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
from scanchain.loops.place_search import Underway, completed, searched
from scanchain.loops.submaps import Submap, level_frame, seen_together, upright_frame
from scanchain.loops.verification import Verifier
from scanchain.maps.saved_map import read_arrays
from scanchain.registration import SearchGrid, Wanted, Window, find
from scanchain.registration.search import Found, Search, evenly, upright_columns

MEMBERS = 10  # number of the newest keyframes that are sought together
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
_AGREE_M, _AGREE_RAD = 1.0, 0.05  # largest difference between the poses that two finds imply
PLACES_FILE = "places.npz"
VERSION = 1
_TOGETHER = 10  # number of keyframes whose points are seen together; drift between more would raise the ground
_MAX_LEVELED = 16  # number of keyframes, evenly spread, whose ground says where the map's vertical is
_ALIKE = Problem.plain("another place of the map is as similar")


@dataclass(frozen=True, slots=True)
class Outline:
    """Upright structure of a map.

    T_map_level : (4, 4) to the frame whose z axis is normal to the ground, on average, its origin at whole 100 km
    columns : (M, 2) where it is upright, level frame
    size_m : edge length of the cells that the map was seen in
    """

    T_map_level: Pose
    columns: Matrix
    size_m: float


class UprightMap:
    """Keyframes where they lie in the world, and their upright structure, in which poses are sought."""

    def __init__(self, keyframes: Sequence[Keyframe], config: Config, folder: Path | None = None) -> None:
        """See keyframes from above; what is seen is kept in the folder of a map."""
        self.config, self.keyframes, self.verifier = config, keyframes, Verifier(config)
        self.radius_m = config.loops.place_radius_m * float(np.median([each.scale for each in keyframes]))
        outline = outline_of(folder, keyframes, config.local_map)
        self.T_world = np.array([each.T_odom_lidar for each in keyframes])
        self.T_level = lie.inverse(outline.T_map_level) @ self.T_world
        self.size_m, self.columns = outline.size_m, outline.columns
        self.grid: SearchGrid | None = None  # drawn when first searched

    def found(self, members: Sequence[Keyframe]) -> Generator[None, None, Closure | None]:
        """The closure of the last one of some keyframes with the map's; None where nothing is alike."""
        newest = members[-1]
        T_newest_level = level_frame(newest, self.config.local_map)
        T_level_odom = lie.inverse(T_newest_level) @ lie.inverse(newest.T_odom_lidar)
        seeds = yield from self.seeds(seen_together(members, T_level_odom))
        source = Submap(newest, members, self.radius_m)
        tried: list[tuple[Closure, Pose]] = []  # and T_world_newest by it
        for seed in seeds:
            for k in self.stories(seed.T_target_source[:2, 2]):
                if len(tried) % _VERIFIED == 0:
                    yield
                T_first = self.on_ground(k, seed.T_target_source) @ lie.inverse(T_newest_level)
                verified = self.verifier.submap(source, self.submap(k), T_first, min_agreement=_MIN_AGREEMENT)
                closure = verified.closure(self.keyframes[k].index, newest.index, Proposal.PLACE)
                tried.append((closure, self.T_world[k] @ closure.match.T_target_source))
        accepted = [each for each in tried if each[0].verdict is ClosureVerdict.ACCEPTED]
        if not accepted:
            return tried[0][0] if tried else None
        best, T_best = max(accepted, key=lambda each: each[0].overlap)
        off_m, off_rad = np.array([lie.apart(T_best, T) for _, T in accepted]).T
        return best if (off_m < _AGREE_M).all() and (off_rad < _AGREE_RAD).all() else best.rejected(_ALIKE)

    def is_repeated(self, members: Sequence[Keyframe]) -> bool:
        """True if what some keyframes show is in several places of the map."""
        closure = completed(self.found(members))
        return closure is not None and closure.cause == _ALIKE.cause

    def seeds(self, points: Points) -> Generator[None, None, Sequence[Found]]:
        """The best poses (3, 3) of points in the level frame of the map, sought coarsely, then refined."""
        near = points[np.abs(points[:, :2]).max(axis=1, initial=0.0) < _RADIUS * self.radius_m]
        columns = evenly(upright_columns(near, self.size_m), _COLUMNS)
        if len(columns) < _MIN_COLUMNS or not len(self.columns):
            return ()
        if self.grid is None:
            self.grid = self._drawn()
        coarse_m = self.grid.resolution_m
        wanted = Wanted(_APART * coarse_m, _RIVAL, _COARSE_SEEDS, _MIN_SHARE)
        poses = yield from searched(Search(evenly(columns, _COARSE_COLUMNS), self.grid, None, wanted))
        reach_m = 2.0 * _RADIUS * self.radius_m + coarse_m
        seeds: list[Found] = []
        for coarse in poses:
            surfaces = self.columns[np.abs(self.columns - coarse.T_target_source[:2, 2]).max(axis=1) < reach_m]
            around = Window(coarse.T_target_source, coarse_m, _REFINED_RAD)
            seeds += find(columns, SearchGrid.of_points(surfaces, self.size_m), around, wanted._replace(answers=1))
        best_first = sorted(seeds, key=lambda each: -each.share)[:_SEEDS]
        return [each for each in best_first if each.share >= _RIVAL * best_first[0].share]

    def stories(self, position: NDArray[np.float64]) -> list[int]:
        """Numbers of the keyframes nearest to a position (2,), one on each story."""
        positions = self.T_level[:, :3, 3]
        away_m = np.linalg.norm(positions[:, :2] - position, axis=1)
        chosen: list[int] = []
        for k in np.argsort(away_m, kind="stable").tolist():
            if away_m[k] > _REACH * self.radius_m or len(chosen) == _MAX_LEVELS:
                break
            if (np.abs(positions[chosen, 2] - positions[k, 2]) > _LEVEL_M).all():
                chosen.append(k)
        return chosen

    def on_ground(self, k: int, T_plane_source: Pose) -> Pose:
        """T_target_source of a level source at a place, on the plane of the ground around the k-th keyframe."""
        T_level_target = self.T_level[k]
        up = T_level_target[:3, :3] @ level_frame(self.keyframes[k], self.config.local_map)[:3, 2]
        T = upright_frame(up, np.append(T_plane_source[:2, 0], 0.0))
        aside = T_plane_source[:2, 2] - T_level_target[:2, 3]
        T[:2, 3] = T_plane_source[:2, 2]
        T[2, 3] = T_level_target[2, 3] - float(aside @ up[:2]) / float(up[2])
        return lie.inverse(T_level_target) @ T

    def submap(self, k: int) -> Submap:
        """The keyframes around the k-th one, whichever path they lie on."""
        away_m = np.linalg.norm(self.T_level[:, :3, 3] - self.T_level[k, :3, 3], axis=1)
        members = [self.keyframes[index] for index in np.flatnonzero(away_m < self.radius_m).tolist()]
        return Submap(self.keyframes[k], members, self.radius_m)

    def _drawn(self) -> SearchGrid:
        """The coarse grid of the map; poses that it finds may be a cell farther off than those verified."""
        positions = self.T_level[:, :2, 3]
        reach_m = _REACH * self.radius_m + _COARSE * self.size_m
        extent = np.vstack([self.columns, positions - reach_m, positions + reach_m])
        area_m2 = float(np.ptp(extent, axis=0).prod())
        return SearchGrid.of_points(
            self.columns,
            max(_COARSE * self.size_m, math.sqrt(area_m2 / _MAX_CELLS)),
            near=positions,
            reach_m=reach_m,
        )


class UprightFinder:
    """The last keyframes of a path, sought together in older ones as seen from above; then verified in space."""

    first_m, least_m, most_m = 0.0, 1.0, 2.0
    match_m = 3.5

    def __init__(self, config: Config) -> None:
        self.config = config
        self.searches = self.alike = 0

    def draw(self, keyframes: Sequence[Keyframe], folder: Path | None = None) -> UprightMap:
        """The upright structure of keyframes."""
        return UprightMap(keyframes, self.config, folder)

    def find(self, keyframes: Sequence[Keyframe], start: int, target: UprightMap) -> Underway:
        """The closure of the newest keyframe with the older ones, verified or not; see ``Finder``."""
        closure = yield from target.found(keyframes[max(start, len(keyframes) - MEMBERS) :])
        self.searches += 1
        self.alike += closure is not None and closure.cause == _ALIKE.cause
        return () if closure is None else (closure,)


def outline_of(folder: Path | None, keyframes: Sequence[Keyframe], config: LocalMapConfig) -> Outline:
    """The outline of keyframes; a map's folder holds it from the first time on where it can be written to.

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
        with suppress(OSError):  # a map that cannot be written to is searched all the same
            write_whole(folder / PLACES_FILE, data.getvalue())
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
        seen.append(upright_columns(seen_together(members, T_level_map), size_m))
    columns = np.vstack(seen)
    return columns[np.unique(np.floor(columns / size_m), axis=0, return_index=True)[1]]
