"""Drives with exact truth, tracked by odometry alone."""

from dataclasses import dataclass

import numpy as np

from scanchain.data import Pose, Scan, Trajectory
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from tests.benchmarks.harness import ate_m
from tests.support.scenes import configured

NO_WHEELS = {"odometry.prior": "constant-velocity"}


@dataclass(frozen=True)
class Drive:
    """Scans of a drive, the mounting of the lidar, and its true trajectory."""

    scans: list[Scan]
    T_base_lidar: Pose
    truth: Trajectory

    @classmethod
    def of(cls, path, **options):
        """The scans of a log, with the keys of its section."""
        log = open_log(path, **options)
        return cls(list(log.scans()), log.T_base_lidar, log.ground_truth())

    @property
    def dimension(self):
        return len(self.T_base_lidar) - 1

    def tracked(self, scans=None, changes=None):
        """Odometry's results for its scans, or for others in their place, some keys changed."""
        odometry = Odometry(configured(self.dimension, changes), self.T_base_lidar)
        return [odometry.process(scan) for scan in (self.scans if scans is None else scans)]

    def error_m(self, steps):
        """Absolute trajectory error."""
        stamps_ns = np.array([step.scan.stamp_ns for step in steps])
        return ate_m(Trajectory(stamps_ns, np.array([step.T_odom_lidar for step in steps])), self.truth)
