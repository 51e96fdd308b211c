"""Odometry with its drift turned up, so that loop closure has something to do on logs that are tracked well."""

import msgspec
import numpy as np

from scanchain import lie
from scanchain.slam import Slam


class DriftingOdometry:
    """The odometry of a run, every motion between two scans replaced by what ``drifted`` makes of it."""

    def __init__(self, odometry, drifted):
        self.odometry = odometry
        self.drifted = drifted
        self.T_odom_lidar = self.T_drifted = lie.identity(odometry.dimension)

    def __getattr__(self, name):
        return getattr(self.odometry, name)

    def place(self, scan):
        tracked = self.odometry.place(scan)
        motion = lie.inverse(self.T_odom_lidar) @ tracked.T_odom_lidar
        self.T_odom_lidar = tracked.T_odom_lidar
        self.T_drifted = lie.normalize(self.T_drifted @ self.drifted(motion))
        return msgspec.structs.replace(tracked, T_odom_lidar=self.T_drifted)


def drifting_slam(config, T_base_lidar, drifted):
    """A chain whose odometry drifts."""
    slam = Slam(config, T_base_lidar)
    slam.front_end.odometry = DriftingOdometry(slam.front_end.odometry, drifted)
    return slam


def stretched(longer, turn_rad_m):
    """Motions made longer by a share of themselves and turned by so much a meter."""

    def drifted(motion):
        d = len(motion) - 1
        twist = lie.log(motion)
        way_m = float(np.linalg.norm(twist[:d]))
        twist[:d] *= 1.0 + longer
        twist[-1] += turn_rad_m * way_m
        return lie.exp(twist)

    return drifted


def off_by(error_per_m):
    """Motions followed by a twist (k,) a meter."""
    return lambda motion: motion @ lie.exp(float(np.linalg.norm(motion[:-1, -1])) * error_per_m)
