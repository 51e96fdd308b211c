"""Stamped poses: of nav_msgs/Odometry, geometry_msgs and tf2_msgs/TFMessage."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from math import isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np

from scanchain import lie
from scanchain.data import Pose
from scanchain.logs.messages.ros import MalformedMessageError, frame_name, stamp_ns


class StampedPose(NamedTuple):
    """Pose (4, 4), or (3, 3) of a planar log, of frame ``child``, empty if it has no name, in ``parent``."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: Pose

    def interpolate(self, later: StampedPose, stamp_ns: int) -> StampedPose:
        """The pose at a stamp between this one and a later one."""
        share = (stamp_ns - self.stamp_ns) / (later.stamp_ns - self.stamp_ns)
        T = lie.interpolate(self.T_parent_child, later.T_parent_child, share)
        return StampedPose(stamp_ns, self.parent, self.child, T)


def read_pose(message: Any, dimension: int = 3) -> StampedPose:
    """A nav_msgs/Odometry, geometry_msgs/PoseStamped or PoseWithCovarianceStamped, flattened for dimension 2."""
    pose = getattr(message.pose, "pose", message.pose)
    T = pose_of(pose.position, pose.orientation, dimension)
    child = frame_name(getattr(message, "child_frame_id", ""))  # of an Odometry
    return StampedPose(stamp_ns(message), frame_name(message.header.frame_id), child, T)


Frames = tuple[str, str]  # parent and child


def read_transforms(message: Any, link: Frames | None = None, dimension: int = 3) -> list[StampedPose]:
    """Transforms of a tf2_msgs/TFMessage, all or those of the frames ``link``; flattened for dimension 2.

    Raises MalformedMessageError for one of the link that is no pose; others that are none are NaN.
    """
    found = list[StampedPose]()
    for each in message.transforms:
        frames = frame_name(each.header.frame_id), frame_name(each.child_frame_id)
        if link in (None, frames):
            T = np.full((dimension + 1, dimension + 1), np.nan)
            with suppress(*() if link else (MalformedMessageError,)):
                T = pose_of(each.transform.translation, each.transform.rotation, dimension)
            found.append(StampedPose(stamp_ns(each), *frames, T))
    return found


def chain(transforms: Sequence[StampedPose], target: str, source: str) -> Pose | None:
    """T_target_source (4, 4) through the tree of transforms; None if no path connects the two frames."""
    steps: dict[str, list[tuple[str, Pose]]] = {}
    for step in transforms:
        steps.setdefault(step.child, []).append((step.parent, step.T_parent_child))
        steps.setdefault(step.parent, []).append((step.child, lie.inverse(step.T_parent_child)))
    reached = {source: np.eye(4)}  # poses of the source in frames
    queue = deque(reached)
    while queue:
        frame = queue.popleft()
        for following, T in steps.get(frame, []):
            if following not in reached:
                reached[following] = T @ reached[frame]
                queue.append(following)
    return reached.get(target)


def pose_of(position: Any, orientation: Any, dimension: int = 3) -> Pose:
    """A pose of position and quaternion, which is normalized; flattened for dimension 2."""
    x_m, y_m, z_m = position.x, position.y, position.z
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    square = x * x + y * y + z * z + w * w
    if not (isfinite(x_m + y_m + z_m) and 1e-12 < square < 1e12):
        raise MalformedMessageError("its pose is not finite, or the norm of its quaternion is far from 1")
    if dimension == 2:
        cosine, sine = w * w + x * x - y * y - z * z, 2.0 * (x * y + z * w)
        norm = sqrt(cosine * cosine + sine * sine) or 1.0
        cosine, sine = cosine / norm, sine / norm
        return np.array([[cosine, -sine, x_m], [sine, cosine, y_m], [0.0, 0.0, 1.0]])
    s = 2.0 / square
    return np.array([
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), x_m],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w), y_m],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y), z_m],
        [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip
