"""How the lidar sits on the robot."""

from __future__ import annotations

import numpy as np

from pipeline import lie
from pipeline.data import Pose
from pipeline.logs.poses import StampedPose, chain

BASE_FRAMES = ("base_link", "base_footprint", "base")


def mounting(transforms: list[StampedPose], base: str, lidar: str, notes: list[str]) -> Pose:
    """T_base_lidar (4, 4) from the static transforms; the identity, and a note, where they do not say."""
    for candidate in (base, *BASE_FRAMES) if base else BASE_FRAMES:
        T_base_lidar = chain(transforms, candidate, lidar)
        if T_base_lidar is not None:
            return T_base_lidar
    notes.append(f"no static transform from {base or 'base_link'} to {lidar or 'the lidar'}: taken to be the same")
    return np.eye(4)


def is_upside_down(T_base_lidar: Pose) -> bool:
    """Whether the lidar's z axis points downwards."""
    return bool(T_base_lidar[2, 2] < 0.0)


def in_plane(T_base_lidar: Pose) -> Pose:
    """T_base_lidar (3, 3) of a planar scanner.

    One that hangs upside down sees the plane mirrored; its points are turned about its own x axis (y → −y), and
    so is its mounting, so that both are as seen from above.
    """
    if is_upside_down(T_base_lidar):
        T_base_lidar = T_base_lidar @ np.diag([1.0, -1.0, -1.0, 1.0])
    return lie.flatten(T_base_lidar)
