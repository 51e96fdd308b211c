"""Odometry with its drift turned up, so that loop closure has something to do on logs that are tracked well, and
closures that are wrong, to be found out by the back end."""

from dataclasses import replace

import msgspec
import numpy as np

from scanchain import lie
from scanchain.data import ClosureVerdict
from scanchain.slam import Slam

MADE_UP = "made up"  # the reason that is given for wrong closures


class DriftingOdometry:
    """The odometry of a run, every motion between two scans replaced by what ``drifted`` makes of it."""

    def __init__(self, odometry, drifted):
        self.odometry = odometry
        self.drifted = drifted
        self.T_odom_lidar = self.T_drifted = lie.identity(odometry.dimension)

    def __getattr__(self, name):
        return getattr(self.odometry, name)

    def process(self, scan):
        tracked = self.odometry.process(scan)
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


def false_closures(slam, share, seed=0):
    """So many that they are this share of all: two keyframes at random, the relative pose of another closure.

    Real ones that happen to be nearly right (within 1 m of what the graph says) are drawn again.
    """
    rng = np.random.default_rng(seed)
    true = [closure for closure in slam.closures if closure.verdict is ClosureVerdict.ACCEPTED]
    wrong = []
    while len(wrong) < share / (1.0 - share) * len(true):
        target, source = np.sort(rng.choice(len(slam.keyframes), 2, replace=False))
        model = true[rng.integers(len(true))]
        here = slam.back_end.graph.poses[target] @ model.match.T_target_source
        if np.linalg.norm((here - slam.back_end.graph.poses[source])[:-1, -1]) > 1.0:
            wrong.append(replace(model, target=int(target), source=int(source), reason=MADE_UP))
    return tuple(wrong)
