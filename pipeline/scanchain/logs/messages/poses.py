"""nav_msgs/Odometry, stamped poses and tf2_msgs/TFMessage to poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import isfinite, sqrt
from typing import NamedTuple

import numpy as np

from scanchain import lie
from scanchain.data import Pose
from scanchain.logs.messages.cdr import CdrReader, MalformedMessageError

_MOST_TRANSFORMS = 65536


class StampedPose(NamedTuple):
    """A pose of ``child``, empty where it is not named, in ``parent``; (4, 4), or (3, 3) for a planar log."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: Pose


def decode_odometry(data: memoryview, dimension: int = 3, form: type[CdrReader] = CdrReader) -> StampedPose:
    """The pose of a nav_msgs/Odometry, flattened for dimension 2; twist and covariances are passed over."""
    reader = form(data)
    stamp_ns, parent = reader.header()
    child = reader.string()
    return StampedPose(stamp_ns, parent, child, _pose(reader, dimension))


def decode_pose(data: memoryview, dimension: int = 3, form: type[CdrReader] = CdrReader) -> StampedPose:
    """A geometry_msgs/PoseStamped or PoseWithCovarianceStamped, flattened for dimension 2."""
    reader = form(data)
    stamp_ns, parent = reader.header()
    return StampedPose(stamp_ns, parent, "", _pose(reader, dimension))


def decode_transforms(data: memoryview, form: type[CdrReader] = CdrReader) -> list[StampedPose]:
    """All transforms of a tf2_msgs/TFMessage."""
    reader = form(data)
    transforms = []
    count = reader.integer()
    if count > _MOST_TRANSFORMS:
        raise MalformedMessageError(f"it claims {count} transforms; at most {_MOST_TRANSFORMS} are accepted")
    for _ in range(count):
        stamp_ns, parent = reader.header()
        child = reader.string()
        transforms.append(StampedPose(stamp_ns, parent, child, _pose(reader, 3)))
    return transforms


def chain(transforms: Sequence[StampedPose], target: str, source: str) -> Pose | None:
    """T_target_source (4, 4) through the tree of transforms, None where no path joins the two frames."""
    reached = _reached(transforms, source).get(target.lstrip("/"))
    return None if reached is None else reached[1]


def frames_between(transforms: Sequence[StampedPose], target: str, source: str) -> list[str]:
    """The frames that ``chain`` passes from target to source, both included; none where no path joins them."""
    reached, frames, frame = _reached(transforms, source), [], target.lstrip("/")
    while frame in reached:
        frames.append(frame)
        frame = reached[frame][0]
    return frames


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


def _pose(reader: CdrReader, dimension: int) -> Pose:
    return pose_matrix(reader.numbers("d", 7), dimension)


def pose_matrix(numbers: Sequence[float], dimension: int) -> Pose:
    """A pose of position and quaternion xyzw, of any length but zero; flattened for dimension 2."""
    x_m, y_m, z_m, x, y, z, w = numbers
    square = x * x + y * y + z * z + w * w
    if not (isfinite(x_m + y_m + z_m) and isfinite(square) and square > 1e-12):
        raise MalformedMessageError("its pose is not finite, or the quaternion is zero")
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
