"""The recognizer for 3D logs: searches older submaps for the upright structure of a submap, within the drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Matrix, Points, Pose, Proposal
from scanchain.errors import InputError
from scanchain.loops.recognizer import Candidate, Query
from scanchain.loops.submaps import Submap, level_frame, upright_frame
from scanchain.registration import SearchGrid, Wanted, Window, find
from scanchain.registration.search import Found, evenly, upright_columns

_COLUMNS, _MIN_COLUMNS = 150, 30  # numbers of columns that are scored, evenly spread, and least for a query
_REACH, _HEADING_RAD = 0.1, 0.5  # largest error of odometry: position, as a share of the path between, and heading
_MAX_REACH_M, _MAX_CELLS = 1000.0, 800  # half width of the window, and cells along it; beyond, cells grow
_MIN_SHARE = 0.4  # least share of the columns that lie on older ones: half is hidden from the other side
_POSES, _APART = 8, 4.0  # largest number of poses that are compared, and least distance of two, cells
_RIVAL = 0.9  # share of the best score above which a pose elsewhere makes it ambiguous
_MIN_APART = 0.25  # least distance in radii of a submap between two distinct poses
_TARGETS, _VERIFIED = 8, 8  # largest number of older submaps that a pose is refined in, and of those verified
_REFINED, _REFINED_RAD = 3.0, 0.15  # half widths of the window around it, cells and radians
_TOUCHING = 1.5  # cells, within which a column lies on another one


@dataclass(frozen=True, slots=True)
class Outline:
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
        self.outlines: list[Outline] = []

    def add(self, submap: Submap) -> None:
        """Store the outline of a submap."""
        T_anchor_level = level_frame(submap.anchor, self.config.local_map)
        points = lie.transform(lie.inverse(T_anchor_level), submap.points())
        columns = upright_columns(points, self.config.local_map.voxel_size_m * submap.anchor.scale)
        self.outlines.append(Outline(submap.anchor.index, T_anchor_level, columns, KDTree(columns)))

    def query(self, query: Query) -> list[Candidate]:
        """The best few of the poses that fit, each with the older submaps that it overlaps most.

        Far from the expected pose, a pose with a rival elsewhere is ambiguous.
        """
        newest, keyframes, limits = self.outlines[-1], query.keyframes, self.config.loops
        here, radius_m = query.submap.anchor, query.submap.radius_m
        old = [each for each in self.outlines if keyframes[each.anchor].traveled_m <= query.max_traveled_m]
        if not old or len(newest.columns) < _MIN_COLUMNS:
            return []
        T_old, T_expected = _in_plane(old, newest, query)
        path_m = here.traveled_m - np.array([keyframes[each.anchor].traveled_m for each in old])
        reach_m = np.clip(_REACH * path_m, limits.min_radius_m, _MAX_REACH_M)
        near = np.flatnonzero(_away_m(T_old, T_expected) <= reach_m + radius_m)
        if not len(near):
            return []
        within_m, fine_m = float(reach_m[near].max()), self.config.local_map.voxel_size_m * here.scale
        size_m = max(fine_m, 2.0 * within_m / _MAX_CELLS)
        combined = np.vstack([lie.transform(T_old[k], old[k].columns) for k in near.tolist()])
        window = Window(T_expected, within_m, _HEADING_RAD)
        wanted = Wanted(_APART * size_m, _RIVAL, _POSES, _MIN_SHARE)
        found = find(evenly(newest.columns, _COLUMNS), SearchGrid.of_points(combined, size_m), window, wanted)
        poses = np.array([each.T_target_source for each in found]).reshape(-1, 3, 3)
        candidates: list[Candidate] = []
        for T in poses:
            adjacent = near[_away_m(T_old[near], T) <= radius_m].tolist()
            T_targets = {k: lie.between(T_old[k], T) for k in adjacent}
            touching = {k: _touching(newest.columns, old[k], T_targets[k], size_m) for k in adjacent}
            for k in sorted(adjacent, key=lambda k: -touching[k])[:_TARGETS]:
                drift_m = float(np.clip(limits.drift * path_m[k], limits.min_radius_m, limits.max_radius_m))
                by, rival = Proposal.POSITION, -1
                if _away_m(T, T_expected) > drift_m:
                    by = Proposal.PLACE
                    elsewhere = poses[_away_m(poses, T) > max(_MIN_APART * radius_m, drift_m)]
                    rival = old[int(np.argmin(_away_m(T_old, elsewhere[0])))].anchor if len(elsewhere) else -1
                for fit in _refined(newest.columns, old[k], T_targets[k], size_m, fine_m):
                    T_level = old[k].T_anchor_level @ lie.lift(fit.T_target_source)
                    T_target_source = T_level @ lie.inverse(newest.T_anchor_level)
                    candidates.append(Candidate(old[k].anchor, T_target_source, fit.share, by, rival))
        return sorted(candidates, key=lambda each: -each.score)[:_VERIFIED]


def _in_plane(old: Sequence[Outline], newest: Outline, query: Query) -> tuple[Matrix, Pose]:
    """Poses (N, 3, 3) of the level frames of older submaps, and the expected one of the newest, from above."""
    T_world_old = query.T_world[[each.anchor for each in old]] @ np.array([each.T_anchor_level for each in old])
    up = T_world_old[:, :3, 2].mean(axis=0)
    T_level_world = lie.inverse(upright_frame(up / np.linalg.norm(up)))
    T_world_newest = query.T_world_anchor @ newest.T_anchor_level
    return lie.flatten(T_level_world @ T_world_old), lie.flatten(T_level_world @ T_world_newest)


def _touching(columns: Points, outline: Outline, T: Pose, size_m: float) -> float:
    """Share of columns (N, 2) that lie on those of an outline at this pose in it."""
    away_m = outline.tree.query(lie.transform(T, columns), distance_upper_bound=_TOUCHING * size_m)[0]
    return float(np.isfinite(away_m).mean())


def _refined(columns: Points, outline: Outline, T: Pose, size_m: float, fine_m: float) -> Sequence[Found]:
    """The pose near ``T`` that fits a single outline best, if any does."""
    grid, around = SearchGrid.of_points(outline.columns, fine_m), Window(T, _REFINED * size_m, _REFINED_RAD)
    return find(evenly(columns, _COLUMNS), grid, around, Wanted(_APART * fine_m, 1.0, 1))


def _away_m(T: Matrix, T_other: Pose) -> NDArray[np.float64]:
    return np.linalg.norm(T[..., :2, 2] - T_other[:2, 2], axis=-1)
