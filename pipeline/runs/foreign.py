"""The verdict on a trajectory of another tool, checked against the log that it was made of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.config import LogConfig
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import pair
from scanchain.logs import open_log
from scanchain.runs.vouching import evidence_of_trajectory
from scanchain.source import Source
from scanchain.trajectory import read_tum
from scanchain.verdict import Judged, judge

_FEWEST = 3  # scans with a pose


def judge_trajectory(file: Path, logs: Sequence[Source], config: LogConfig) -> tuple[Judged, int]:
    """The verdict by wheels and constant velocity at the scans that have a pose, and how many have none.

    file : TUM, poses of the lidar. Raises InputError where it has poses for fewer than three scans.
    """
    poses = read_tum(file)
    log = open_log(logs, config)
    stamps, log_times, points, wheels = [], [], [], []
    unknown = np.full(log.T_base_lidar.shape, np.nan)
    for scan in log.scans():
        stamps.append(scan.stamp_ns)
        log_times.append(scan.log_time_ns)
        points.append(len(scan.points))
        wheels.append(unknown if scan.T_odom_base is None else scan.T_odom_base @ log.T_base_lidar)
    placeholders = np.tile(np.eye(4), (len(stamps), 1, 1))
    pairs = pair(Trajectory(np.array(stamps, np.int64), placeholders), poses)
    if len(pairs) < _FEWEST:
        raise InputError(f"{file}: has poses at {len(pairs)} of {len(stamps)} scans; it must be of this log")
    found = pairs.places
    T_world_lidar = lie.flatten(pairs.reference) if log.dimension == 2 else pairs.reference
    trajectory = Trajectory(np.array(stamps, np.int64)[found], T_world_lidar)
    log_times_ns = np.array(log_times, np.int64)[found]
    wheel_poses, counts = np.array(wheels)[found], np.array(points, np.int64)[found]
    return judge(evidence_of_trajectory(trajectory, log_times_ns, wheel_poses, counts)), len(stamps) - len(pairs)
