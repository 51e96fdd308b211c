"""nav_msgs/Odometry, stamped poses and tf2_msgs/TFMessage to poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np

from scanchain import lie
from scanchain.data import Pose
from scanchain.logs.messages.ros import MalformedMessageError, stamp_ns


class StampedPose(NamedTuple):
    """A pose of ``child``, empty where it is not named, in ``parent``; (4, 4), or (3, 3) for a planar log."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: Pose


def read_odometry(message: Any, dimension: int = 3) -> StampedPose:
    """The pose of a nav_msgs/Odometry, flattened for dimension 2."""
    return read_pose(message, dimension)._replace(child=message.child_frame_id)


def read_pose(message: Any, dimension: int = 3) -> StampedPose:
    """A geometry_msgs/PoseStamped or PoseWithCovarianceStamped, flattened for dimension 2."""
    pose = getattr(message.pose, "pose", message.pose)
    T = pose_of(pose.position, pose.orientation, dimension)
    return StampedPose(stamp_ns(message), message.header.frame_id, "", T)


def read_transforms(message: Any) -> list[StampedPose]:
    """All transforms of a tf2_msgs/TFMessage."""
    return [
        StampedPose(
            stamp_ns(each),
            each.header.frame_id,
            each.child_frame_id,
            pose_of(each.transform.translation, each.transform.rotation),
        )
        for each in message.transforms
    ]


def chain(transforms: Sequence[StampedPose], target: str, source: str) -> Pose | None:
    """T_target_source (4, 4) through the tree of transforms, None where no path joins the two frames."""
    reached = _reached(transforms, source).get(target.lstrip("/"))
    return None if reached is None else reached[1]


def _reached(transforms: Sequence[StampedPose], source: str) -> dict[str, tuple[str, Pose]]:
    """Every frame that a path joins to ``source``: the frame before it on that path, and T_frame_source (4, 4)."""
    source = source.lstrip("/")
    steps: dict[str, list[tuple[str, Pose]]] = {}
    for step in transforms:
        parent, child = step.parent.lstrip("/"), step.child.lstrip("/")
        steps.setdefault(child, []).append((parent, step.T_parent_child))
        steps.setdefault(parent, []).append((child, lie.inverse(step.T_parent_child)))
    reached = {source: ("", np.eye(4))}
    queue = deque([source])
    while queue:
        frame = queue.popleft()
        for following, T in steps.get(frame, []):
            if following not in reached:
                reached[following] = frame, T @ reached[frame][1]
                queue.append(following)
    return reached


def pose_of(position: Any, orientation: Any, dimension: int = 3) -> Pose:
    """A pose of position and quaternion, of any length but zero; flattened for dimension 2."""
    x_m, y_m, z_m = position.x, position.y, position.z
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    square = x * x + y * y + z * z + w * w
    if not (isfinite(x_m + y_m + z_m) and 1e-12 < square < 1e12):
        raise MalformedMessageError("its pose is not finite, or the quaternion is zero or without bound")
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
