"""The wheel-odometry pose that belongs to a scan."""

from __future__ import annotations

from bisect import bisect_left, insort

from scanchain import lie
from scanchain.data import Pose

_REMEMBERED = 512  # readings
_NEAREST_NS = 500_000_000


class WheelTrack:
    """The latest wheel readings, by stamp."""

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []
        self.poses: dict[int, Pose] = {}

    def add(self, stamp_ns: int, T_odom_base: Pose) -> None:
        """Remember a reading; the oldest are forgotten."""
        if stamp_ns not in self.poses:
            insort(self.stamps_ns, stamp_ns)
        self.poses[stamp_ns] = T_odom_base
        if len(self.stamps_ns) > _REMEMBERED:
            del self.poses[self.stamps_ns.pop(0)]

    def covers(self, stamp_ns: int) -> bool:
        """Whether there is a reading at the instant, or one after it."""
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
