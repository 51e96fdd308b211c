"""nav_msgs/Odometry and tf2_msgs/TFMessage to poses."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from pipeline import lie
from pipeline.data import Pose
from pipeline.logs.cdr import CdrReader, MalformedMessageError


@dataclass(frozen=True, slots=True)
class StampedPose:
    """A pose (4, 4) of ``child`` in ``parent`` at an instant."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: Pose


def decode_odometry(data: memoryview) -> StampedPose:
    """The pose of a nav_msgs/Odometry; twist and covariances are passed over."""
    reader = CdrReader(data)
    stamp_ns, parent = reader.header()
    child = reader.string()
    return StampedPose(stamp_ns, parent, child, _pose(reader))


def decode_transforms(data: memoryview) -> list[StampedPose]:
    """All transforms of a tf2_msgs/TFMessage."""
    reader = CdrReader(data)
    transforms = []
    for _ in range(reader.integer()):
        stamp_ns, parent = reader.header()
        child = reader.string()
        transforms.append(StampedPose(stamp_ns, parent, child, _pose(reader)))
    return transforms


def chain(transforms: list[StampedPose], target: str, source: str) -> Pose | None:
    """T_target_source (4, 4) through the tree of transforms, None where no path joins the two frames."""
    if target.lstrip("/") == source.lstrip("/"):
        return np.eye(4)
    steps: dict[str, list[tuple[str, Pose]]] = {}
    for step in transforms:
        parent, child = step.parent.lstrip("/"), step.child.lstrip("/")
        steps.setdefault(child, []).append((parent, step.T_parent_child))
        steps.setdefault(parent, []).append((child, lie.inverse(step.T_parent_child)))
    reached = {source.lstrip("/"): np.eye(4)}
    queue = deque(reached)
    while queue:
        frame = queue.popleft()
        for following, T in steps.get(frame, []):
            if following not in reached:
                reached[following] = T @ reached[frame]
                queue.append(following)
    return reached.get(target.lstrip("/"))


def _pose(reader: CdrReader) -> Pose:
    values = np.array(reader.numbers("d", 7))
    norm = np.linalg.norm(values[3:])
    if not np.isfinite(values).all() or norm < 1e-6:
        raise MalformedMessageError("a pose is not finite, or its quaternion is zero")
    T = np.eye(4)
    x, y, z, w = values[3:] / norm
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = values[:3]
    return T
