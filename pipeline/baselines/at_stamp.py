"""Poses that hold somewhere in the sweep, moved to the scan's stamp."""

from __future__ import annotations

import numpy as np

from scanchain import lie
from scanchain.data import Pose


class AtStamp:
    """Moves each pose back to its scan's stamp, at the velocity since the pose before.

    A baseline calls the pose of its first scan the identity, at whatever instant that holds; here it is the
    first stamp's. Where that lies is known from the second scan on, when there is a velocity.
    """

    def __init__(self) -> None:
        self.T_odom_theirs: Pose | None = None
        self.T_theirs_last: Pose | None = None
        self.last_stamp_ns, self.last_held_s = 0, 0.0

    def move(self, T_theirs_held: Pose, stamp_ns: int, held_s: float) -> Pose:
        """T_odom_lidar at the stamp, of a pose in the baseline's own frame that holds ``held_s`` after it."""
        T_theirs_last, self.T_theirs_last = self.T_theirs_last, T_theirs_held
        interval_s = (stamp_ns - self.last_stamp_ns) * 1e-9 + held_s - self.last_held_s
        last_held_s = self.last_held_s
        self.last_stamp_ns, self.last_held_s = stamp_ns, held_s
        if T_theirs_last is None:
            return np.eye(4)
        motion = lie.log(lie.between(T_theirs_last, T_theirs_held))
        velocity = motion / interval_s if interval_s > 0.0 else np.zeros(6)
        if self.T_odom_theirs is None:
            self.T_odom_theirs = lie.inverse(T_theirs_last @ lie.exp(-last_held_s * velocity))
        return self.T_odom_theirs @ T_theirs_held @ lie.exp(-held_s * velocity)
