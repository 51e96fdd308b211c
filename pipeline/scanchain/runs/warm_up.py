"""``python -m scanchain.runs.warm_up 3``: compile what a run needs after its first scans, with synthetic ones.

A run whose kernels have to be compiled first starts this beside itself, on a core that it does not need yet.
"""

from __future__ import annotations

import gc
import sys

import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import KeyframeErrors, Points, Prior, Scan, State
from scanchain.odometry import Located
from scanchain.odometry.tracked import Tracked, first_match
from scanchain.runs import results
from scanchain.settings import load_settings
from scanchain.slam import Slam

_SCANS = 3
_STEP_M = 1.0
_POINTS = 100


def compile_the_rest(dimension: int) -> None:
    """Compile the optimization of a pose graph, the covariances of its poses, and what draws both maps."""
    slam = Slam(load_settings(dimension).config, lie.identity(dimension))
    points = np.random.default_rng(0).uniform(2.0, 20.0, (_POINTS, dimension))
    points[:, 2:] *= 0.02  # into the slice of which the grid is drawn
    for k in range(_SCANS):
        slam.place(_located(k, points, slam.config))
    slam.graph.pose_errors(1)
    result = slam.finish()
    slam.graph.relative_covariance(0, 1)
    slam.graph.covariances()
    results.cloud_of(result.keyframes, result.T_world_keyframes, slam.config)
    results.grid_of(result.keyframes, result.T_world_keyframes, slam.config.maps)
    slam.points.close()


def _located(k: int, points: Points, config: Config) -> Located:
    """A keyframe of a lidar that drives straight on."""
    T = lie.identity(points.shape[1])
    T[0, -1] = k * _STEP_M
    scan = Scan(k, k, k, points.astype(np.float32), np.empty(0, np.float32), 0, None)
    match = first_match(T, points, config.matching)
    prior = Prior(T, np.eye(len(match.information)), np.ones(len(match.information)))
    tracked = Tracked(scan, points, points, T, match, State.OK, "", prior, 0.0, 0.0, 0.0)
    errors = KeyframeErrors(1.0, np.zeros_like(match.information), 0.0)
    return Located(tracked, True, 1.0, points, match.information, errors, points)


if __name__ == "__main__":
    gc.disable()  # a process that compiles and ends
    compile_the_rest(int(sys.argv[1]))
