"""Place recognition in 2D: correlative scan matching, within the drift or in a map with its free space."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.checks import LARGEST
from scanchain.config import MapsConfig
from scanchain.data import Closure, Keyframe, Matrix, Points, Pose, Problem, Proposal
from scanchain.kernels.search import Score
from scanchain.loops.evidence import SEARCHED_M, rank_of
from scanchain.loops.place_search import Underway, candidates, completed
from scanchain.loops.submaps import VoxelSubmaps, seen_together
from scanchain.loops.verification import Verifier
from scanchain.maps.occupancy_grid import OccupancyGrid, fitting_resolution
from scanchain.preprocess import downsample
from scanchain.registration import SearchGrid, Wanted, Window, find, thinned
from scanchain.registration.search import POINTS, Search, draw_surfaces

# of the newest keyframes in older ones, within the drift
_HEADING = (0.1, 0.2)  # rad and rad/m, half width of the window in heading: at least, and by the uncertainty
_WANTED = Wanted(apart_m=2.0, rival=0.9, answers=2, least=0.55)  # a second answer means ambiguity

# of a path in a whole map
_MAX_CELLS = 16_000_000  # of the grid: a hundred megabytes with its pyramid; larger maps get larger cells
_CERTAIN = 0.6  # log-odds of occupancy above which a cell is a surface, and below minus which it is free
_MORE_POINTS = 800  # number of points that poses are compared with
_IN_MAP = Wanted(apart_m=1.0, rival=0.75, answers=12, least=0.35)  # a rival means ambiguity
_APART_RAD = 0.2  # least angle of two distinct poses
_CHANCE = 2.0  # over the root of the number of points: share above the least that is reached by chance
_CERTAINLY = 0.06  # least share above these for a location to count as found
_CLEAR_M = 2.0  # least path since an ambiguous search for a location to count as found

# of the scans of a path that was found
AGREE = (0.5, 0.1)  # m and rad, largest distance of an aligned scan from where its path was found
_SOURCES, _SUBMAPS = 8, 6  # keyframes of the path that are aligned, about 1 m apart, and submaps tried for each
_NEAR_M = 8.0  # largest distance of such a submap's anchor


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A pose of the lidar in the map, and the mean score of its points as a share of the highest possible.

    ``rival`` is the share of the best pose elsewhere, 0 if none comes near; ``points`` counts one per cell.
    """

    T_map_lidar: Pose
    share: float
    rival: float
    points: int

    @property
    def is_likely(self) -> bool:
        """True if the pose fits better than any does by chance."""
        return self.share >= self._by_chance

    @property
    def _by_chance(self) -> float:
        return _IN_MAP.least + _CHANCE / math.sqrt(self.points)

    @property
    def is_certain(self) -> bool:
        """True if the pose fits far better than any does by chance."""
        return self.share >= self._by_chance + _CERTAINLY

    @property
    def is_ambiguous(self) -> bool:
        """True if the points fit nearly as well elsewhere."""
        return self.rival > _IN_MAP.rival * self.share


class PlanarMapSearch:
    """Surfaces and free space of keyframes at their poses, in a grid in which all poses of a scan are searched.

    A point of the scan scores 1 on a surface, ½ next to it, −1 in free space and 0 in unknown space, and the lidar
    itself has to be in free space: a pose that fits walls but sees through others scores low.
    """

    def __init__(self, keyframes: Sequence[Keyframe], resolution_m: float) -> None:
        """Rasterize keyframes, whose ``T_odom_lidar`` is T_map_lidar."""
        self.keyframes = keyframes
        views = [view for keyframe in keyframes for view in keyframe.views(keyframe.T_odom_lidar)]
        T_map_lidar, clouds = np.array([T for T, _ in views]), [points for _, points in views]
        reach_m = max(float(np.abs(cloud).max(initial=0.0)) for cloud in clouds)
        self.resolution_m = fitting_resolution(
            T_map_lidar, resolution_m=resolution_m, max_range_m=reach_m, max_cells=_MAX_CELLS
        )
        config = MapsConfig(grid_resolution_m=self.resolution_m, grid_max_range_m=LARGEST)
        grid = OccupancyGrid(config)
        grid.insert_batch(T_map_lidar, np.vstack(clouds), np.append(0, np.cumsum([len(each) for each in clouds])))
        grid = grid.trimmed()
        log_odds = np.pad(grid.log_odds, 1)
        cells = np.where(log_odds < -_CERTAIN, Score.FREE, Score.UNKNOWN).astype(np.int8)
        draw_surfaces(cells, *np.nonzero(log_odds > _CERTAIN))
        room = (cells == Score.FREE) | (cells == Score.NEAR)
        self.grid = SearchGrid(cells, grid.origin_m - self.resolution_m, self.resolution_m, room)

    def searched(self, points: Points, least: float = _IN_MAP.least) -> Generator[None, None, Hypothesis | None]:
        """The pose that the points (N, 2), lidar frame, fit best; None if none has the least share.

        Poses are searched with some of the points, in slices of equal work; those found are compared with more.
        """
        points = np.random.default_rng(0).permutation(downsample(points, self.resolution_m))
        search = Search(points[:POINTS], self.grid, None, _IN_MAP._replace(least=least))
        more, step_rad = points[:_MORE_POINTS].copy(), 0.5 * search.turn_rad
        found = yield from candidates(search, lambda T: [self.grid.climbed(more, T, step_rad)])
        if not found:
            return None
        best = found[0]
        apart = (each.share for each in found if _are_apart(each.T_target_source, best.T_target_source))
        return Hypothesis(best.T_target_source, best.share, max(apart, default=0.0), len(points))

    def likely(self, path: Sequence[Keyframe]) -> Hypothesis | None:
        """The pose of the middle keyframe of a path that its points fit best; None if they fit none."""
        T_middle_odom = lie.inverse(path[len(path) // 2].T_odom_lidar)
        best = completed(self.searched(seen_together(path, T_middle_odom)))
        return best if best is not None and best.is_likely else None


class PlanarFinder:
    """Search of rasterized older keyframes for the points of the end of a path; then scans are aligned there.

    A pose is accepted if it fits far better than chance, and no other fits nearly as well, now or shortly before.
    """

    first_m, least_m, most_m = 1.0, 0.5, 2.0
    match_m = 0.0

    def __init__(self, submaps: VoxelSubmaps, verifier: Verifier) -> None:
        self.submaps = submaps
        self.verifier = verifier
        self.ambiguous_m = -math.inf  # path up to the last ambiguous search
        self.searches = self.ambiguous = 0

    def draw(self, keyframes: Sequence[Keyframe], folder: Path | None = None) -> PlanarMapSearch:
        """Surfaces and free space of keyframes."""
        return PlanarMapSearch(keyframes, self.submaps.config.voxel_size_m)

    def find(self, keyframes: Sequence[Keyframe], start: int, target: PlanarMapSearch) -> Underway:
        """Closures of keyframes of the path with older ones; see ``Finder``."""
        path = keyframes[_path_begin(keyframes, start) :]
        T_newest_odom = lie.inverse(path[-1].T_odom_lidar)
        best = yield from target.searched(seen_together(path, T_newest_odom))
        newest_m = path[-1].traveled_m
        self.searches += 1
        if best is not None and best.is_likely and best.is_ambiguous:
            self.ambiguous_m = newest_m
            self.ambiguous += 1
        if best is None or not best.is_certain or newest_m - self.ambiguous_m < _CLEAR_M:
            return ()
        anchors = [each for each in target.keyframes if each.index % self.submaps.half_width == 0]
        closures = [
            self.aligned(source, best.T_map_lidar @ T_newest_odom @ source.T_odom_lidar, anchors, keyframes)
            for source in path[:: -max(len(path) // _SOURCES, 1)][:_SOURCES]
        ]
        return sorted((each for each in closures if each is not None), key=rank_of, reverse=True)

    def within_drift(
        self,
        path: Sequence[Keyframe],
        old: Sequence[Keyframe],
        T_world: Matrix,
        *,
        near: NDArray[np.int64],
        radius_m: float,
    ) -> Closure | None:
        """The closure of the last keyframe of a path with older ones by a search over all poses that drift allows.

        None if it fits nowhere in the older keyframes together, or at two poses.
        T_world : (K, 3, 3) of all keyframes; near : numbers of those within reach
        radius_m : uncertainty of the position relative to them
        """
        newest, size_m = path[-1], self.submaps.config.voxel_size_m * path[-1].scale
        near_anchors = dict.fromkeys(self.submaps.anchor_of(k) for k in near.tolist())
        placed, anchors = (
            [replace(old[k], T_odom_lidar=T_world[k]) for k in chosen] for chosen in (near.tolist(), near_anchors)
        )
        surfaces = downsample(seen_together(placed, lie.identity(2)), size_m)
        points = thinned(seen_together(path, lie.inverse(newest.T_odom_lidar)), size_m)
        window = Window(T_world[-1], radius_m, _HEADING[0] + _HEADING[1] * radius_m)
        found = find(points, SearchGrid.of_points(surfaces, size_m), window, _WANTED)
        return self.aligned(newest, found[0].T_target_source, anchors, old) if len(found) == 1 else None

    def aligned(
        self, source: Keyframe, T_world_source: Pose, anchors: Sequence[Keyframe], keyframes: Sequence[Keyframe]
    ) -> Closure | None:
        """The closure of a keyframe to the nearby submap that it overlaps most; None if there is none.

        anchors : of submaps out of ``keyframes``; their ``T_odom_lidar`` is T_world_lidar
        """
        positions = np.array([each.T_odom_lidar[:2, 2] for each in anchors]).reshape(-1, 2)
        away_m = np.linalg.norm(positions - T_world_source[:2, 2], axis=1)
        best: Closure | None = None
        for anchor in (anchors[k] for k in np.argsort(away_m)[:_SUBMAPS].tolist() if away_m[k] <= _NEAR_M):
            T_first = lie.between(anchor.T_odom_lidar, T_world_source)
            submap = self.submaps.around(anchor.index, keyframes, len(keyframes) - 1)
            verified = self.verifier.scan(source, submap, T_first)
            off_m, problem = lie.apart(T_first, verified.match.T_target_source)[0], None
            if not lie.agree(T_first, verified.match.T_target_source, *AGREE):
                where = "from where the path was found"
                problem = Problem(f"far {where}", f"{off_m:.1f} m {where}")
            closure = verified.closure(anchor.index, source.index, Proposal.PLACE, problem=problem)
            if best is None or (rank_of(closure) > rank_of(best)):
                best = closure
        return best


def _are_apart(T: Pose, T_other: Pose) -> bool:
    """True for two distinct poses."""
    away_m = np.abs(T[:2, 2] - T_other[:2, 2]).max()
    return bool(away_m >= _IN_MAP.apart_m or lie.apart(T, T_other)[1] >= _APART_RAD)


def _path_begin(keyframes: Sequence[Keyframe], start: int) -> int:
    """The first keyframe, from ``start`` on, of the path whose points are searched for."""
    first = len(keyframes) - 1
    while first > start and keyframes[-1].traveled_m - keyframes[first - 1].traveled_m <= SEARCHED_M[2]:
        first -= 1
    return first
