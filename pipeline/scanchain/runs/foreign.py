"""The verdict on a trajectory of another tool, checked against the log that it was made of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Match, Matrix, Pose, Scan, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import pair
from scanchain.files import Source
from scanchain.logs import Log, open_log
from scanchain.preprocess import Resolution
from scanchain.registration import MapKeeper, create_matcher
from scanchain.runs.vouching import evidence_of_trajectory
from scanchain.settings import Override, load_settings
from scanchain.trajectory import read_tum
from scanchain.verdict import Evidence, Judged, apart_m, check_overlap, judge

_FEWEST = 3  # scans with a pose


def judge_trajectory(file: Path, logs: Sequence[Source], overrides: Sequence[Override]) -> tuple[Judged, int]:
    """The verdict on the poses at the scans of a log, and the number of scans without a pose.

    Checked are wheels, constant velocity, and each scan aligned to a map of those before at the given poses.
    file : TUM, poses of the lidar. Raises InputError where it has poses for fewer than three scans.
    """
    poses = read_tum(file)
    log = open_log(logs, load_settings(overrides=overrides).config.log)
    config = load_settings(log.dimension, overrides=overrides).config
    stamps_ns, log_times_ns, points, wheels = _table(log, config)
    placeholders = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    pairs = pair(Trajectory(stamps_ns, placeholders), poses)
    if len(pairs) < _FEWEST:
        raise InputError(f"{file}: has poses at {len(pairs)} of {len(stamps_ns)} scans; it must be of this log")
    found = pairs.places
    T_world_lidar = lie.flatten(pairs.reference) if log.dimension == 2 else pairs.reference
    trajectory = Trajectory(stamps_ns[found], T_world_lidar)
    is_chosen = np.zeros(len(stamps_ns), np.bool_)
    is_chosen[found] = True
    scans = (scan for scan in log.scans(config.preprocess) if is_chosen[scan.index])
    matches = _matches(scans, trajectory, config)
    evidence = evidence_of_trajectory(
        trajectory, log_times_ns[found], wheels[found], points[found],
        {"scan matching": _matched_bound_m(trajectory.poses, [T for _, T in matches])},
    )  # fmt: skip
    return judge(_with_matches(evidence, matches, config)), len(stamps_ns) - len(pairs)


def _table(log: Log, config: Config) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Matrix]:
    """Stamps, log times, numbers of points and poses of the lidar by the wheels, NaN where unknown."""
    rows, wheels = [], []
    unknown = np.full(log.T_base_lidar.shape, np.nan)
    for scan in log.scans(config.preprocess):
        rows.append((scan.stamp_ns, scan.log_time_ns, len(scan.points)))
        wheels.append(unknown if scan.T_odom_base is None else scan.T_odom_base @ log.T_base_lidar)
    stamps_ns, log_times_ns, points = np.array(rows, np.int64).T.copy()
    return stamps_ns, log_times_ns, points, np.array(wheels)


def _matched_bound_m(poses: Matrix, corrections: Sequence[Pose]) -> float:
    """Difference of a trajectory from the one that goes on from each pose as the next scan is matched.

    A scan is matched to a map at the given poses. An error that grows along the path shows in every correction, so
    that their sum is larger than it.
    """
    motions = lie.between(poses[:-1], poses[1:]) @ np.array(corrections)[1:]
    chained = [poses[0]]
    for motion in motions:
        chained.append(chained[-1] @ motion)
    return apart_m(poses[:, :-1, -1], np.array(chained)[:, :-1, -1])


def _matches(scans: Iterable[Scan], trajectory: Trajectory, config: Config) -> list[tuple[Match | None, Pose]]:
    """Each scan aligned from its given pose to a map of those before, and the correction of the pose by it."""
    resolution = Resolution(config.preprocess, config.local_map.voxel_size_m)
    keeper, matcher = MapKeeper(trajectory.dimension, config.local_map), create_matcher(config.matching)
    velocities = _velocities(trajectory)
    matches: list[tuple[Match | None, Pose]] = []
    for scan, T_world_lidar, velocity in zip(scans, trajectory.poses, velocities, strict=True):
        sweep, sparse = resolution.downsampled(scan)
        keeper.resize(resolution.scale)
        points = sparse.from_middle(velocity)
        T_world_middle = T_world_lidar @ lie.exp(sweep.middle_s * velocity)
        match, T_matched = None, T_world_middle
        if len(keeper.surfaces) and len(points):
            match = matcher.align(points, keeper.surfaces, T_world_middle)
            T_matched = match.T_target_source
        matches.append((match, lie.between(T_world_middle, T_matched)))
        keeper.extend(sweep.from_middle(velocity), T_world_middle)
    return matches


def _velocities(trajectory: Trajectory) -> NDArray[np.float64]:
    """(N, k) twist per second from each scan to the next, for deskewing; 0 where stamps stand still."""
    seconds = np.diff(trajectory.stamps_ns) * 1e-9
    twists = lie.log(lie.between(trajectory.poses[:-1], trajectory.poses[1:]))
    velocities = np.where(seconds[:, None] > 0.0, twists / np.where(seconds > 0.0, seconds, 1.0)[:, None], 0.0)
    return np.vstack([velocities, velocities[-1:]])


def _with_matches(evidence: Evidence, matches: Sequence[tuple[Match | None, Pose]], config: Config) -> Evidence:
    """With states and fit by the matches; one that ends elsewhere contradicts the pose."""
    least, farthest_m = config.matching.min_inlier_share, config.matching.max_distance_m
    return replace(
        evidence,
        is_lost=np.array([match is not None and match.inlier_share < least for match, _ in matches]),
        is_degenerate=np.array([match is not None and match.observability < 1.0 for match, _ in matches]),
        overlap=check_overlap(np.array([1.0 if match is None else match.inlier_share for match, _ in matches])),
        fit=np.array(
            [
                np.nan if match is None else match.fit * (np.linalg.norm(T[:-1, -1]) < farthest_m)
                for match, T in matches
            ]
        ),
    )
