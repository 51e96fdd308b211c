"""Poses recorded beside the scans: of the wheels, of the ground truth, and of the lidar on the robot."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter
from typing import NamedTuple

import numpy as np

from scanchain import lie
from scanchain.data import Pose, Trajectory
from scanchain.logs.mcap.stream import Decoded
from scanchain.logs.messages.poses import StampedPose
from scanchain.logs.messages.returns import Returns
from scanchain.logs.mounting import Mounting, edge
from scanchain.words import counted

_REMEMBERED = 512  # largest number of readings in memory
_NEAREST_NS = 500_000_000


class PosesAtScan(NamedTuple):
    """T_odom_base (d+1, d+1) and T_base_lidar (4, 4) at a scan's stamp; None where no reading is near."""

    T_odom_base: Pose | None
    T_base_lidar: Pose | None


class RecordedPoses:
    """Pose messages by topic, looked up at the stamp of a scan; malformed ones are counted."""

    def __init__(self, odometry_topic: str, ground_truth_topic: str, mounting: Mounting | None = None) -> None:
        self.odometry_topic = odometry_topic
        self.ground_truth_topic = ground_truth_topic
        self.wheels = PoseTrack()
        self.mounting = mounting
        self.joints = {joint: PoseTrack() for joint in (() if mounting is None else mounting.joints)}
        self.truth: list[StampedPose] = []
        self.malformed: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}

    def take(self, message: Decoded) -> None:
        """Sort one message in."""
        topic, pose = message.channel.topic, message.value
        if isinstance(pose, list):
            self._take_joints(pose)
            return
        if not isinstance(pose, StampedPose):
            self.malformed[topic] += 1
            self.reasons.setdefault(topic, str(pose))
            return
        if topic == self.odometry_topic:
            self.wheels.add(pose.stamp_ns, pose.T_parent_child)
        if topic == self.ground_truth_topic:
            self.truth.append(pose)

    def covers(self, stamp_ns: int) -> bool:
        """True if all poses that a scan at the instant needs have been read."""
        needed = [self.wheels] if self.odometry_topic else []
        return all(track.covers(stamp_ns) for track in (*needed, *self.joints.values()))

    def at_scan(self, scan: Decoded) -> PosesAtScan:
        """The poses at the scan's stamp."""
        if not isinstance(scan.value, Returns):
            return PosesAtScan(None, None)
        stamp_ns = scan.value.stamp_ns
        return PosesAtScan(self.wheels.at(stamp_ns), self._mounting_at(stamp_ns))

    def _take_joints(self, transforms: list[StampedPose]) -> None:
        for each in transforms:
            track = self.joints.get(edge(each))
            if track is not None:
                track.add(each.stamp_ns, each.T_parent_child)

    def _mounting_at(self, stamp_ns: int) -> Pose | None:
        poses = [(joint, track.at(stamp_ns)) for joint, track in self.joints.items()]
        known = [StampedPose(stamp_ns, *joint, pose) for joint, pose in poses if pose is not None]
        return self.mounting.at(known) if self.mounting is not None and known else None

    def ground_truth(self) -> Trajectory | None:
        """The true poses so far, in the order in which they were logged; None where there are none."""
        if not self.truth:
            return None
        stamps_ns = np.array([pose.stamp_ns for pose in self.truth], np.int64)
        return Trajectory(stamps_ns, np.array([pose.T_parent_child for pose in self.truth]))

    def complaints(self) -> list[str]:
        """One line for each topic that had malformed messages."""
        return [
            f"{counted(count, 'malformed message')} of {topic} left out (the first: {self.reasons[topic]})"
            for topic, count in self.malformed.items()
        ]


class PoseTrack:
    """The latest poses of a moving frame, by stamp, interpolated between them."""

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []
        self.poses: dict[int, Pose] = {}

    def add(self, stamp_ns: int, T_odom_base: Pose) -> None:
        """Add a reading; the oldest are dropped."""
        if stamp_ns not in self.poses:
            insort(self.stamps_ns, stamp_ns)
        self.poses[stamp_ns] = T_odom_base
        if len(self.stamps_ns) > _REMEMBERED:
            del self.poses[self.stamps_ns.pop(0)]

    def covers(self, stamp_ns: int) -> bool:
        """True if there is a reading at the instant, or one after it."""
        return stamp_ns in self.poses or bool(self.stamps_ns and self.stamps_ns[-1] >= stamp_ns)

    def at(self, stamp_ns: int) -> Pose | None:
        """The reading at the instant, or between its neighbors, or the nearest within half a second."""
        if stamp_ns in self.poses:
            return self.poses[stamp_ns]
        after = bisect_left(self.stamps_ns, stamp_ns)
        near = [s for s in self.stamps_ns[max(after - 1, 0) : after + 1] if abs(s - stamp_ns) <= _NEAREST_NS]
        if len(near) == 2:
            share = (stamp_ns - near[0]) / (near[1] - near[0])
            return lie.interpolate(self.poses[near[0]], self.poses[near[1]], share)
        return self.poses[near[0]] if near else None
