"""How the lidar sits on the robot, from the latched static transforms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline import lie
from pipeline.data import Pose
from pipeline.logs.first_messages import first_messages
from pipeline.logs.poses import StampedPose, chain
from pipeline.logs.readers import (
    cloud_reader,
    has_transforms,
    is_odometry,
    is_scan,
    pose_reader,
    scan_reader,
    transforms_reader,
)
from pipeline.logs.records import Channel, FileIndex
from pipeline.logs.topics import topics_of

_BASE_FRAMES = ("base_link", "base_footprint", "base")


def find_mounting(indexes: Sequence[FileIndex], lidar: Channel, wheels: Channel | None, notes: list[str]) -> Pose:
    """T_base_lidar (4, 4); the identity where the log does not say, with a note where that is an assumption."""
    transforms = static_transforms(indexes)
    if not transforms and wheels is None:
        return np.eye(4)
    read = scan_reader(lidar) if is_scan(lidar) else cloud_reader(lidar)
    lidar_frame = next(first_messages(indexes, lidar.topic, lambda data: read(data).frame), "")
    base_frame = ""
    if wheels is not None and is_odometry(wheels):
        told = next(first_messages(indexes, wheels.topic, pose_reader(wheels, 3)), None)
        base_frame = "" if told is None else told.child
    for base in (base_frame, *_BASE_FRAMES) if base_frame else _BASE_FRAMES:
        T_base_lidar = chain(transforms, base, lidar_frame)
        if T_base_lidar is not None:
            return T_base_lidar
    notes.append(
        f"no static transform from {base_frame or _BASE_FRAMES[0]} to {lidar_frame or 'the lidar'}: "
        "the lidar is taken to sit at the robot's origin"
    )
    return np.eye(4)


def root_frame(transforms: Sequence[StampedPose], frame: str) -> str:
    """The topmost frame to which fixed transforms join a frame; the frame itself where there are none."""
    parents = {each.child.lstrip("/"): each.parent.lstrip("/") for each in transforms}
    seen: list[str] = []
    while frame in parents and frame not in seen:
        seen.append(frame)
        frame = parents[frame]
    return frame


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


def static_transforms(indexes: Sequence[FileIndex]) -> list[StampedPose]:
    """Every transform of the topics that tell fixed ones."""
    found: list[StampedPose] = []
    for topic, channel in topics_of(indexes).items():
        if topic.endswith("tf_static") and has_transforms(channel):
            for transforms in first_messages(indexes, topic, transforms_reader(channel)):
                found += transforms
    return found
