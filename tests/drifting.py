"""Odometry with its drift turned up, so that loop closure has something to do on logs that are tracked well."""

from dataclasses import replace

import numpy as np

from pipeline import lie
from pipeline.slam import Slam


class DriftingOdometry:
    """The odometry of a run, every motion made longer by a share of itself and turned by so much a metre."""

    def __init__(self, odometry, longer, turn_rad_m):
        self.odometry = odometry
        self.longer, self.turn_rad_m = longer, turn_rad_m
        self.T_odom_lidar = self.T_drifted = lie.identity(odometry.dimension)

    @property
    def local_map(self):
        return self.odometry.local_map

    @property
    def first_points(self):
        return self.odometry.first_points

    def track(self, scan):
        tracked = self.odometry.track(scan)
        d = self.odometry.dimension
        motion = lie.log(lie.inverse(self.T_odom_lidar) @ tracked.T_odom_lidar)
        way_m = float(np.linalg.norm(motion[:d]))
        motion[:d] *= 1.0 + self.longer
        motion[-1] += self.turn_rad_m * way_m
        self.T_odom_lidar = tracked.T_odom_lidar
        self.T_drifted = lie.normalise(self.T_drifted @ lie.exp(motion))
        return replace(tracked, T_odom_lidar=self.T_drifted)


def drifting_slam(config, log, longer, turn_rad_m):
    slam = Slam(config, log.T_base_lidar)
    slam.odometry = DriftingOdometry(slam.odometry, longer, turn_rad_m)
    return slam
