"""The poses that a log tells beside its scans: the wheels', the truth, and those of the lidar on the robot."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np

from scanchain.data import Pose, Trajectory
from scanchain.logs.mcap.stream import Decoded
from scanchain.logs.messages.limits import Returns
from scanchain.logs.messages.poses import StampedPose
from scanchain.logs.mounting import Mounting, edge
from scanchain.logs.wheels import WheelTrack
from scanchain.words import counted


class Beside(NamedTuple):
    """T_odom_base (d+1, d+1) and T_base_lidar (4, 4) at a scan's stamp; None where no reading is near."""

    T_odom_base: Pose | None
    T_base_lidar: Pose | None


class ToldPoses:
    """Takes in pose messages and answers where the wheels were; malformed ones are counted."""

    def __init__(self, odometry_topic: str, ground_truth_topic: str, mounting: Mounting | None = None) -> None:
        self.odometry_topic = odometry_topic
        self.ground_truth_topic = ground_truth_topic
        self.wheels = WheelTrack()
        self.mounting = mounting
        self.joints = {joint: WheelTrack() for joint in (() if mounting is None else mounting.joints)}
        self.truth: list[StampedPose] = []
        self.malformed: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}

    def take(self, message: Decoded) -> None:
        """Sort one message in."""
        topic, told = message.channel.topic, message.value
        if isinstance(told, list):
            self._take_joints(told)
            return
        if not isinstance(told, StampedPose):
            self.malformed[topic] += 1
            self.reasons.setdefault(topic, str(told))
            return
        if topic == self.odometry_topic:
            self.wheels.add(told.stamp_ns, told.T_parent_child)
        if topic == self.ground_truth_topic:
            self.truth.append(told)

    def covers(self, stamp_ns: int) -> bool:
        """Whether everything that a scan at the instant needs has been told."""
        needed = [self.wheels] if self.odometry_topic else []
        return all(track.covers(stamp_ns) for track in (*needed, *self.joints.values()))

    def beside(self, scan: Decoded) -> Beside:
        """What holds at the scan's stamp."""
        if not isinstance(scan.value, Returns):
            return Beside(None, None)
        stamp_ns = scan.value.stamp_ns
        return Beside(self.wheels.at(stamp_ns), self._mounting_at(stamp_ns))

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
