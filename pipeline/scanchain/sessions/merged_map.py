"""The map of several sessions: final poses of their keyframes and scans, removal of vanished points, and files.

Updating a map removes the points of older keyframes that newer sessions saw through.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.config import Config
from scanchain.data import REJECTED_WEIGHT, Closure, KeyframePoints, Matrix, Points, RaySpan, Trajectory
from scanchain.errors import InputError
from scanchain.graph.g2o import write_g2o
from scanchain.loops import refined, spread
from scanchain.maps import SavedMap, write_map, write_ply, write_saved_map
from scanchain.runs.closures import closures_table, final_verdicts
from scanchain.runs.results import GRAPH_FILE, Cloud, grid_of
from scanchain.runs.step_table import write_table
from scanchain.sessions.changes import Label, Part, changes_between
from scanchain.sessions.joining import Joined, graph_of
from scanchain.trajectory import read_tum, write_tum


@dataclass(frozen=True, slots=True)
class MergedMap:
    """Several maps merged in one frame, with their sessions.

    joined : the maps with their common graph
    saved : the merged map; in 2D its poses are refined beyond those of the graph; the sessions of all maps are in
        chronological order, with unique names
    trajectories : of the sessions; of all scans if the run directory has them, else of the keyframes
    removed : (K,) number of each keyframe's points that newer sessions saw through; 0 without an update
    warnings : of the update
    """

    joined: Joined
    saved: SavedMap
    trajectories: tuple[Trajectory, ...]
    removed: NDArray[np.int64]
    warnings: tuple[str, ...] = ()


def session_names(maps: Sequence[SavedMap], order: Sequence[int]) -> list[list[str]]:
    """Names of the sessions of each map.

    A run of one log is named after its directory; where names are equal, the later ones in ``order`` get a number.
    """
    names: list[list[str]] = [[] for _ in maps]
    taken = set[str]()
    for number in order:
        saved = maps[number]
        for session in saved.sessions:
            stem = name = saved.name if len(saved.sessions) == 1 else session.name
            numbers = count(2)
            while name in taken:
                name = f"{stem}-{next(numbers)}"
            taken.add(name)
            names[number].append(name)
    return names


def merged_map(
    joined: Joined,
    maps: Sequence[SavedMap],
    names: Sequence[Sequence[str]],
    config: Config,
    *,
    folder: Path,
    first: int,
    held: int,
    update: bool = False,
) -> MergedMap:
    """The map of joined maps, in the frame of the map ``first``: its first keyframe stays where it was.

    names : of the sessions of each map; folder : where it will be; held : map whose poses stay as they are, or −1
    update : whether points that newer sessions saw through are removed
    """
    poses = _refined(joined, config, held)
    if held < 0:
        at = int(np.flatnonzero(joined.of_map == first)[0])
        T_first_world = maps[first].keyframes[0].T_odom_lidar @ lie.inverse(poses[at])
        poses = T_first_world @ poses
        joined = joined.placed(T_first_world @ joined.poses)
    chosen = [(number, index) for number in joined.maps for index in range(len(maps[number].sessions))]
    chosen.sort(key=lambda each: maps[each[0]].sessions[each[1]].first_stamp_ns)
    session = np.empty(len(poses), np.int64)
    sessions, trajectories = [], []
    for new, (number, index) in enumerate(chosen):
        of_session = np.flatnonzero(joined.of_map == number)[maps[number].session == index]
        session[of_session] = new
        sessions.append(msgspec.structs.replace(maps[number].sessions[index], name=names[number][index]))
        trajectories.append(_trajectory(maps[number], index, poses[of_session]))
    keyframes = joined.placed(poses).keyframes
    in_force = joined.edges.where(joined.edges.weight >= REJECTED_WEIGHT)
    saved = SavedMap(folder, joined.dimension, keyframes, session, tuple(sessions), in_force)
    merged = MergedMap(joined, saved, tuple(trajectories), np.zeros(len(poses), np.int64))
    return updated(merged, config) if update else merged


def final_closures(merged: MergedMap) -> tuple[Closure, ...]:
    """Every closure tried between maps with its final verdict."""
    state, edges = graph_of(merged.joined).state(), merged.joined.edges
    order = np.argsort(edges.is_loop, kind="stable")  # of the state: odometry first
    between = merged.joined.is_between[order]
    return final_verdicts(merged.joined.closures, replace(state, is_loop=between, weight=edges.weight[order]))


def write_merged(folder: Path, merged: MergedMap, cloud: Cloud, final: Sequence[Closure], config: Config) -> None:
    """Write map, trajectories, point cloud, grid, graph and closures into a directory."""
    saved = merged.saved
    write_saved_map(saved)
    for session, trajectory in zip(saved.sessions, merged.trajectories, strict=True):
        write_tum(folder / f"{session.name}.tum", trajectory, force=True)
    write_ply(folder / "map.ply", cloud.points)
    if saved.dimension == 2:
        write_map(folder, grid_of(saved.keyframes, saved.poses, config.maps))
    write_g2o(folder / GRAPH_FILE, graph_of(replace(merged.joined, edges=saved.edges)))
    write_table(folder / "loops.parquet", closures_table(final, saved.keyframes, saved.dimension))


def _refined(joined: Joined, config: Config, held: int) -> Matrix:
    """Final poses (K, d+1, d+1): in the plane, each keyframe aligned once more to the map of all of them."""
    poses = joined.poses
    if joined.dimension == 3 or not config.loops.refine:
        return poses
    free = np.flatnonzero(joined.of_map != held)
    path = [joined.keyframes[k] for k in free.tolist()]
    poses[free] = refined(poses[free], lambda n: path[n].points, joined.keyframes, joined.poses, config)
    return poses


def _trajectory(saved: SavedMap, index: int, poses: Matrix) -> Trajectory:
    """Poses of a session's scans from its first keyframe on, corrected to its keyframes' poses (K, d+1, d+1)."""
    keyframes = [saved.keyframes[k] for k in np.flatnonzero(saved.session == index).tolist()]
    stamps_ns = np.array([keyframe.stamp_ns for keyframe in keyframes], np.int64)
    before = np.array([keyframe.T_odom_lidar for keyframe in keyframes])
    file = saved.folder.parent / (
        "trajectory.tum" if len(saved.sessions) == 1 else f"{saved.sessions[index].name}.tum"
    )
    scans = read_tum(file) if file.exists() else Trajectory(stamps_ns[:0], before[:0])
    known = lie.flatten(scans.poses) if saved.dimension == 2 and len(scans) else scans.poses
    rows = np.array([keyframe.scan_index for keyframe in keyframes], np.int64)
    for first in (0, int(rows[0])):  # a merged map's file begins at the first keyframe
        begin, found = int(rows[0]) - first, rows - rows[0]
        if rows[-1] - first < len(scans) and np.array_equal(scans.stamps_ns[rows - first], stamps_ns):
            is_still = np.array_equal(poses, before)
            return Trajectory(
                scans.stamps_ns[begin:], known[begin:] if is_still else spread(poses, found, known[begin:])
            )
    return Trajectory(stamps_ns, poses)


@dataclass(frozen=True, slots=True)
class RemainingPoints:
    """Points of a keyframe for which ``kept`` (M,) holds."""

    stored: KeyframePoints
    kept: NDArray[np.bool_]

    @property
    def spans(self) -> tuple[RaySpan, ...]:
        """Origins of the rays of the points that remain."""
        return RaySpan.among(self.stored.spans, np.flatnonzero(self.kept))

    def read(self) -> Points:
        """(N, d) meters."""
        return self.stored.read()[self.kept]


def updated(merged: MergedMap, config: Config) -> MergedMap:
    """The map without points that vanished in later sessions; warns of sessions that match none before."""
    saved, session, poses = merged.saved, merged.saved.session, merged.saved.poses
    result, removed, warnings = list(saved.keyframes), merged.removed.copy(), list(merged.warnings)
    for number, newest in enumerate(saved.sessions[1:], 1):
        older, newer = np.flatnonzero(session < number), np.flatnonzero(session == number)
        earlier, later = (
            Part("", [result[k] for k in chosen.tolist()], poses[chosen]) for chosen in (older, newer)
        )
        try:
            changes = changes_between(earlier, later, config)
        except InputError:
            warnings.append(f"{newest.name}: too little in common with older sessions; it removed no points")
            continue
        if not (changes.labels == Label.VANISHED).any():
            continue
        label_of = KDTree(changes.points)
        reach_m = np.sqrt(changes.dimension) * changes.voxel_size_m
        is_vanished = np.append(changes.labels == Label.VANISHED, False)  # the last one: no point within reach
        for k in older.tolist():
            points = lie.transform(poses[k], result[k].points)
            gone = is_vanished[label_of.query(points, distance_upper_bound=reach_m)[1]]
            if gone.any():
                removed[k] += gone.sum()
                result[k] = replace(result[k], stored=RemainingPoints(result[k].stored, ~gone))
    saved = replace(saved, keyframes=tuple(result))
    return replace(merged, saved=saved, removed=removed, warnings=tuple(warnings))
