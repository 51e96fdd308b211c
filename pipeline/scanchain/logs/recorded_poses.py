"""Poses recorded beside the scans: of the wheels and of the ground truth."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter

import numpy as np

from scanchain import lie
from scanchain.data import Pose, Trajectory
from scanchain.errors import counted
from scanchain.logs.mcap.stream import Decoded
from scanchain.logs.messages.poses import StampedPose

_REMEMBERED = 512  # largest number of readings in memory
_NEAREST_NS = 500_000_000


class RecordedPoses:
    """Pose messages by topic, the wheels' looked up at the stamp of a scan; malformed ones are counted."""

    def __init__(self, odometry_topic: str, ground_truth_topic: str) -> None:
        self.odometry_topic = odometry_topic
        self.ground_truth_topic = ground_truth_topic
        self.stamps_ns: list[int] = []  # of the latest readings of the wheels, in order
        self.wheels: dict[int, Pose] = {}
        self.truth: list[StampedPose] = []
        self.malformed: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}

    def take(self, message: Decoded) -> None:
        """Sort one message in."""
        topic, pose = message.channel.topic, message.value
        if not isinstance(pose, StampedPose):
            self.malformed[topic] += 1
            self.reasons.setdefault(topic, str(pose))
            return
        if topic == self.ground_truth_topic:
            self.truth.append(pose)
        if topic == self.odometry_topic:
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
