"""Poses of the first scan in a map, as users know them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.data import Pose
from scanchain.errors import InputError
from scanchain.maps import SavedMap
from scanchain.trajectory import read_tum

_APART_S = 1.0  # largest difference between the first scan and the nearest pose of a file


def pose_near(x_m: float, y_m: float, yaw_deg: float) -> Callable[[int, SavedMap], Pose]:
    """T_map_lidar at a position and heading; in space height and tilt are those of the nearest keyframe."""

    def pose(stamp_ns: int, prior: SavedMap) -> Pose:
        planar = lie.pose_2d(x_m, y_m, np.radians(yaw_deg))
        if prior.dimension == 2:
            return planar
        poses = prior.poses
        nearest = poses[np.argmin(np.hypot(poses[:, 0, 3] - x_m, poses[:, 1, 3] - y_m))]
        T = lie.lift(planar)
        turn = float(lie.yaw(lie.flatten(nearest)))
        T[:3, :3] = T[:3, :3] @ lie.lift(lie.pose_2d(0.0, 0.0, -turn))[:3, :3] @ nearest[:3, :3]
        T[2, 3] = nearest[2, 3]
        return T

    return pose


def pose_in_file(path: Path) -> Callable[[int, SavedMap], Pose]:
    """T_map_lidar of the first scan by a TUM file."""
    trajectory = read_tum(path)

    def pose(stamp_ns: int, prior: SavedMap) -> Pose:
        nearest = int(np.argmin(np.abs(trajectory.stamps_ns - stamp_ns)))
        away_s = abs(int(trajectory.stamps_ns[nearest]) - stamp_ns) * 1e-9
        if away_s > _APART_S:
            raise InputError(f"{path}: has no pose within {_APART_S:g} s of the first scan ({away_s:.1f} s away)")
        T = trajectory.poses[nearest]
        return lie.flatten(T) if prior.dimension == 2 else T

    return pose
