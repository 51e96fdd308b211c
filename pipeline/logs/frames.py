"""Which frame of a log moves with the robot, for those who show results beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from scanchain import lie
from scanchain.data import Pose
from scanchain.logs.mcap.first_messages import first_messages
from scanchain.logs.messages.poses import StampedPose, chain
from scanchain.logs.messages.readers import cloud_reader, is_scan, scan_reader
from scanchain.logs.mounting import in_plane, root_frame, static_transforms

if TYPE_CHECKING:
    from scanchain.logs.log import Log


class MovingFrame(NamedTuple):
    """A frame and its pose (d+1, d+1) as seen from the lidar."""

    name: str
    T_lidar_frame: Pose


def moving_frame(log: Log) -> MovingFrame:
    """The root of the fixed transforms above the lidar, the lidar's own frame where the log has none.

    Transforms of /tf that join it to the base and do not change are as good as fixed ones.
    """
    read = scan_reader(log.lidar) if is_scan(log.lidar) else cloud_reader(log.lidar)
    lidar = next(first_messages(log.indexes, log.topic, lambda data: read(data).frame), "").lstrip("/") or "lidar"
    transforms = static_transforms(log.indexes)
    mounting = log.mounting
    if mounting.joints and mounting.motion is None:
        transforms.append(StampedPose(0, mounting.base, lidar, mounting.T_base_lidar))
    root = root_frame(transforms, lidar)
    T_root_lidar = chain(transforms, root, lidar)
    T_root_lidar = np.eye(4) if T_root_lidar is None else T_root_lidar
    return MovingFrame(root, lie.inverse(in_plane(T_root_lidar) if log.dimension == 2 else T_root_lidar))
