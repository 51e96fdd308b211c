"""Poses: nav_msgs/Odometry, stamped poses and tf2_msgs/TFMessage, and those recorded beside the scans."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Callable, Sequence
from math import isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np

from scanchain import lie
from scanchain.data import Pose, Trajectory
from scanchain.errors import counted
from scanchain.logs.index import Decoded
from scanchain.logs.messages.ros import MalformedMessageError, frame_name, stamp_ns


class StampedPose(NamedTuple):
    """A pose of ``child``, empty where it is not named, in ``parent``; (4, 4), or (3, 3) for a planar log.

    Names of frames are those of ``frame_name``.
    """

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: Pose


def read_pose(message: Any, dimension: int = 3) -> StampedPose:
    """A nav_msgs/Odometry, geometry_msgs/PoseStamped or PoseWithCovarianceStamped, flattened for dimension 2."""
    pose = getattr(message.pose, "pose", message.pose)
    T = pose_of(pose.position, pose.orientation, dimension)
    child = frame_name(getattr(message, "child_frame_id", ""))  # of an Odometry
    return StampedPose(stamp_ns(message), frame_name(message.header.frame_id), child, T)


Frames = tuple[str, str]  # parent and child


def read_transforms(message: Any, link: Frames | None = None, dimension: int = 3) -> list[StampedPose]:
    """All transforms of a tf2_msgs/TFMessage, or those between two frames, flattened for dimension 2."""
    found = []
    for each in message.transforms:
        frames = frame_name(each.header.frame_id), frame_name(each.child_frame_id)
        if link in (None, frames):
            T = pose_of(each.transform.translation, each.transform.rotation, dimension)
            found.append(StampedPose(stamp_ns(each), *frames, T))
    return found


def chain(transforms: Sequence[StampedPose], target: str, source: str) -> Pose | None:
    """T_target_source (4, 4) through the tree of transforms, None where no path joins the two frames."""
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


_REMEMBERED = 512  # largest number of readings in memory
_NEAREST_NS = 500_000_000


class RecordedPoses:
    """Pose messages by topic, the wheels' looked up at the stamp of a scan; malformed ones are counted.

    lidar_on : pose of the lidar on a frame, the identity where poses of that frame are the lidar's
    """

    def __init__(self, odometry_topic: str, ground_truth_topic: str, lidar_on: Callable[[str], Pose]) -> None:
        self.odometry_topic, self.lidar_on = odometry_topic, lidar_on
        self.ground_truth_topic = ground_truth_topic
        self.stamps_ns: list[int] = []  # of the latest readings of the wheels, in order
        self.latest_ns = 0  # of the last one, as logged
        self.wheels: dict[int, Pose] = {}
        self.truth: list[StampedPose] = []
        self.moved = ""  # frame of the truth where it is another than the lidar's
        self.malformed: dict[str, list[str]] = {}  # by topic, what is wrong with each message

    def take(self, message: Decoded) -> None:
        """Sort one message in."""
        topic, pose = message.channel.topic, message.value
        if isinstance(pose, list):  # of /tf, often none of the wheels
            for each in pose:
                self.take(message._replace(value=each))
            return
        if not isinstance(pose, StampedPose):
            self.malformed.setdefault(topic, []).append(str(pose))
            return
        if topic == self.ground_truth_topic:
            self.truth.append(pose)
        if topic == self.odometry_topic:
            if self.stamps_ns and pose.stamp_ns < self.latest_ns - _NEAREST_NS:  # the clock jumped back
                self.stamps_ns, self.wheels = [], {}
            self.latest_ns = pose.stamp_ns
            if pose.stamp_ns not in self.wheels:
                insort(self.stamps_ns, pose.stamp_ns)
            self.wheels[pose.stamp_ns] = pose.T_parent_child
            if len(self.stamps_ns) > _REMEMBERED:
                del self.wheels[self.stamps_ns.pop(0)]

    def covers(self, stamp_ns: int) -> bool:
        """True if there is no reading of the wheels to wait for, at the instant or after it."""
        return not self.odometry_topic or bool(self.stamps_ns and self.stamps_ns[-1] >= stamp_ns)

    def at(self, stamp_ns: int) -> Pose | None:
        """T_odom_base at the instant, or between its neighbors, or the nearest within half a second; else None."""
        if stamp_ns in self.wheels:
            return self.wheels[stamp_ns]
        after = bisect_left(self.stamps_ns, stamp_ns)
        near = [s for s in self.stamps_ns[max(after - 1, 0) : after + 1] if abs(s - stamp_ns) <= _NEAREST_NS]
        if len(near) == 2:
            share = (stamp_ns - near[0]) / (near[1] - near[0])
            return lie.interpolate(self.wheels[near[0]], self.wheels[near[1]], share)
        return self.wheels[near[0]] if near else None

    def ground_truth(self) -> Trajectory | None:
        """The lidar's true poses so far, in the order in which they were logged; None where there are none."""
        if not self.truth:
            return None
        stamps_ns = np.array([pose.stamp_ns for pose in self.truth], np.int64)
        T_of = {child: self.lidar_on(child) for child in {pose.child for pose in self.truth}}
        self.moved = ", ".join(child for child, T in T_of.items() if not np.array_equal(T, np.eye(len(T))))
        return Trajectory(stamps_ns, np.array([pose.T_parent_child @ T_of[pose.child] for pose in self.truth]))

    def notes(self) -> list[str]:
        """A line on a ground truth that is of another frame than the lidar's."""
        moved = f"{self.ground_truth_topic}: poses of {self.moved}, moved to the lidar by the transforms"
        return [moved] if self.moved else []

    def complaints(self) -> list[str]:
        """One line for each topic that had malformed messages."""
        return [
            f"{counted(len(reasons), 'malformed message')} of {topic} left out (the first: {reasons[0]})"
            for topic, reasons in self.malformed.items()
        ]
