"""Search of a whole planar map for the points along a path: surfaces speak for a pose, free space against it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import MapsConfig
from scanchain.data import Keyframe, Matrix, Points, Pose
from scanchain.kernels.search.branch_and_bound import fill_pyramid
from scanchain.kernels.search.whole_map import (
    SURFACE,
    best_poses,
    climb,
    find_room,
    interleave,
    score_cells,
    score_windows,
    turned,
)
from scanchain.maps.occupancy_grid import OccupancyGrid, fitting_resolution
from scanchain.preprocess import downsample

_TOP = 2  # levels of the pyramid above the grid itself; windows start with 2² cells: larger ones rule out nothing
_ADDITIONS = 400_000_000  # of scores in one slice of a search, 20 to 40 ms
_MAX_CELLS = 16_000_000  # of the grid: a hundred megabytes with its pyramid; larger maps get larger cells
_CERTAIN = 0.6  # log-odds of occupancy, from which on a cell is a surface, and below minus which it is free
_POINTS, _MORE_POINTS = 120, 800  # number of points that poses are searched with and compared with
_APART_M, _APART_RAD = 1.0, 0.2  # least distance of two distinct poses
_ANSWERS = 12  # largest number of poses that are compared
_RIVAL = 0.75  # share of the best score, from which on other poses are compared with it
_MIN_RANGE_M = 1.0  # least median range that sets the step of the headings
LEAST_SHARE = 0.35  # of the highest score: wrong poses of long paths come up to it
_CHANCE = 2.0  # what a search over all poses finds by chance: that much over the root of the number of points more
_AMBIGUOUS = 0.8  # share of the best score, from which on a pose elsewhere makes it ambiguous


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
        before, after = 2**_TOP, 2  # windows begin before the first cell; the border is unknown
        log_odds = np.pad(grid.log_odds, (before, after))
        self.origin_m = grid.origin_m - before * self.resolution_m
        self.pyramid = np.zeros((_TOP + 1, *log_odds.shape), np.int8)
        score_cells(log_odds, _CERTAIN, self.pyramid[0])
        fill_pyramid(self.pyramid)
        self.blocks = interleave(self.pyramid[_TOP], _TOP)
        self.spans = np.empty((self.blocks.shape[2], 2), np.int64)
        self.has_room = find_room(self.pyramid[0], _TOP, self.spans)

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

    def climbed(self, points: Points, pose: NDArray[np.float64], step_rad: float) -> float:
        """Share of the points at a pose (3,), which moves to the best one near by."""
        score = climb(self.pyramid[0], points, self.origin_m, self.resolution_m, pose, step_rad)
        return float(score) / SURFACE


class WholeSearch:
    """Search of a whole map for points, in slices of equal work, so that no scan of a live stream waits long."""

    def __init__(self, target: PlanarMapSearch, points: Points, least: float) -> None:
        """Begin to search for points (N, 2), lidar frame; least : share of the highest score that counts."""
        points = np.random.default_rng(0).permutation(downsample(points, target.resolution_m))
        self.target = target
        self.count = len(points)
        self.points = points[:_MORE_POINTS].copy()
        few = points[:_POINTS].copy()
        range_m = max(float(np.median(np.hypot(few[:, 0], few[:, 1]))), _MIN_RANGE_M) if len(few) else 0.0
        self.cells = turned(few, target.resolution_m, math.ceil(2.0 * math.pi * range_m / target.resolution_m))
        self.least = least * SURFACE * len(few)
        additions = max(int(np.maximum(np.diff(target.spans), 0).sum()) * len(few), 1)
        self.headings = max(_ADDITIONS // additions, 1)
        self.turn = 0
        self.windows: list[NDArray[np.int64]] = []

    @property
    def is_done(self) -> bool:
        """True once all headings were searched."""
        return self.turn >= len(self.cells)

    def advance(self) -> None:
        """Search the next headings."""
        target, cells = self.target, self.cells[self.turn : self.turn + self.headings]
        self.windows.append(
            score_windows(target.blocks, _TOP, target.has_room, target.spans, cells, self.turn, self.least)
        )
        self.turn += len(cells)

    def best(self) -> Hypothesis | None:
        """The pose that the points fit best; None where none has the least share."""
        target, turns = self.target, len(self.cells)
        if not self.count:
            return None
        found = best_poses(
            target.pyramid, self.cells, np.vstack(self.windows), target.resolution_m, self.least, _RIVAL, _APART_M,
            _ANSWERS,
        )  # fmt: skip
        if not len(found):
            return None
        poses = np.empty((len(found), 3))
        poses[:, :2] = target.origin_m + (found[:, :2] + 0.5) * target.resolution_m
        poses[:, 2] = 2.0 * math.pi / turns * found[:, 2]
        shares = np.array([target.climbed(self.points, pose, math.pi / turns) for pose in poses])
        best = int(np.argmax(shares))
        rival = float(shares[_is_apart(poses, poses[best])].max(initial=0.0))
        x_m, y_m, yaw_rad = poses[best].tolist()
        return Hypothesis(lie.pose_2d(x_m, y_m, yaw_rad), float(shares[best]), rival, self.count)


def _is_apart(poses: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.bool_]:
    """True for poses (A, 3) that are not the given one."""
    away_m = np.abs(poses[:, :2] - pose[:2]).max(axis=1)
    away_rad = np.abs(np.angle(np.exp(1j * (poses[:, 2] - pose[2]))))
    return (away_m >= _APART_M) | (away_rad >= _APART_RAD)
