"""The poses that a log tells beside its scans: the wheels' and the truth."""

from __future__ import annotations

from collections import Counter

import numpy as np

from pipeline.data import Pose, Trajectory
from pipeline.logs.limits import Returns
from pipeline.logs.poses import StampedPose
from pipeline.logs.stream import Decoded
from pipeline.logs.wheels import WheelTrack
from pipeline.words import counted


class ToldPoses:
    """Takes in pose messages and answers where the wheels were; malformed ones are counted."""

    def __init__(self, odometry_topic: str, ground_truth_topic: str) -> None:
        self.odometry_topic = odometry_topic
        self.ground_truth_topic = ground_truth_topic
        self.wheels = WheelTrack()
        self.truth: list[StampedPose] = []
        self.malformed: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}

    def take(self, message: Decoded) -> None:
        """Sort one message in."""
        topic, told = message.channel.topic, message.value
        if not isinstance(told, StampedPose):
            self.malformed[topic] += 1
            self.reasons.setdefault(topic, str(told))
            return
        if topic == self.odometry_topic:
            self.wheels.add(told.stamp_ns, told.T_parent_child)
        if topic == self.ground_truth_topic:
            self.truth.append(told)

    def wheels_at(self, scan: Decoded) -> Pose | None:
        """T_odom_base at the scan's stamp, None where no reading is near."""
        return self.wheels.at(scan.value.stamp_ns) if isinstance(scan.value, Returns) else None

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
