"""``python -m scanchain.runs.warm_up 3``: compile what comes after odometry with a few synthetic scans.

A run whose kernels have to be compiled first starts this beside itself, on a core that it does not need yet.
"""

from __future__ import annotations

import sys

import numpy as np

from scanchain import lie
from scanchain.data import Points, Pose, Prior, Scan, State
from scanchain.odometry import Located
from scanchain.odometry.tracked import Tracked, first_match
from scanchain.runs.results import cloud_of, grid_of
from scanchain.settings import load_settings
from scanchain.slam import Slam

_SCANS = 3
_STEP_M = 1.0
_POINTS = 100


def warm_up(dimension: int) -> None:
    """Compile by processing scans of a lidar that drives straight on: pose graph and both maps; write nothing."""
    config = load_settings(dimension).config
    slam = Slam(config, lie.identity(dimension))
    points = np.random.default_rng(0).uniform(2.0, 20.0, (_POINTS, dimension))
    points[:, 2:] *= 0.02  # into the slice of which the grid is drawn
    for index in range(_SCANS):
        T_odom_lidar = lie.identity(dimension)
        T_odom_lidar[0, -1] = _STEP_M * index
        slam.place(_located(index, points, T_odom_lidar, slam))
    result = slam.finish()
    cloud_of(result, config)
    grid_of(result, config.maps)
    slam.points.close()


def _located(index: int, points: Points, T_odom_lidar: Pose, slam: Slam) -> Located:
    scan = Scan(index, index, index, points.astype(np.float32), np.empty(0, np.float32), 0, None)
    match = first_match(T_odom_lidar, points, slam.config.matching)
    prior = Prior(T_odom_lidar, np.eye(len(match.information)), np.ones(len(match.information)))
    tracked = Tracked(scan, points, points, T_odom_lidar, match, State.OK, "", prior, 0.0, 0.0, 0.0)
    return Located(tracked, True, 1.0, points, match.information, points)


if __name__ == "__main__":
    warm_up(int(sys.argv[1]))
