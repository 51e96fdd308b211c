"""``python -m scanchain.runs.warm_up 3``: compile what a run needs after its first scans, with synthetic ones.

A run whose kernels have to be compiled first starts this beside itself, on a core that it does not need yet.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Keyframe, KeyframeErrors, Matrix, Points, Prior, Scan, State
from scanchain.odometry import Located
from scanchain.odometry.tracked import Tracked, first_match
from scanchain.runs import results
from scanchain.settings import load_settings
from scanchain.slam import Slam

_SCANS = 3
_STEP_M = 1.0
_POINTS = 100


def graph(dimension: int) -> None:
    """Compile the optimization of a pose graph, errors of its poses, and the covariances that loops need."""
    slam = Slam(load_settings(dimension).config, lie.identity(dimension))
    for keyframe in _straight_on(dimension):
        slam.place(_located(keyframe, slam.config))
    slam.graph.pose_errors(1)
    slam.finish()
    slam.graph.relative_covariance(0, 1)
    slam.graph.covariances()
    slam.points.close()


def maps(dimension: int) -> None:
    """Compile what draws both maps."""
    keyframes = _straight_on(dimension)
    driven = _Driven(keyframes, np.array([each.T_odom_lidar for each in keyframes]))
    config = load_settings(dimension).config
    results.cloud_of(driven, config)
    results.grid_of(driven, config.maps)


class _Driven(NamedTuple):
    keyframes: Sequence[Keyframe]
    T_world_keyframes: Matrix


class _Held(NamedTuple):
    held: Points

    def read(self) -> Points:
        return self.held


def _straight_on(dimension: int) -> list[Keyframe]:
    """Keyframes of a lidar that drove straight on."""
    points = np.random.default_rng(0).uniform(2.0, 20.0, (_POINTS, dimension))
    points[:, 2:] *= 0.02  # into the slice of which the grid is drawn
    poses = np.tile(lie.identity(dimension), (_SCANS, 1, 1))
    poses[:, 0, -1] = traveled_m = _STEP_M * np.arange(_SCANS)
    return [Keyframe(k, k, k, _Held(points), poses[k], traveled_m[k]) for k in range(_SCANS)]


def _located(keyframe: Keyframe, config: Config) -> Located:
    points, k = keyframe.points, keyframe.index
    scan = Scan(k, k, k, points.astype(np.float32), np.empty(0, np.float32), 0, None)
    match = first_match(keyframe.T_odom_lidar, points, config.matching)
    prior = Prior(keyframe.T_odom_lidar, np.eye(len(match.information)), np.ones(len(match.information)))
    tracked = Tracked(scan, points, points, keyframe.T_odom_lidar, match, State.OK, "", prior, 0.0, 0.0, 0.0)
    errors = KeyframeErrors(1.0, np.zeros_like(match.information), 0.0)
    return Located(tracked, True, 1.0, points, match.information, errors, points)


if __name__ == "__main__":
    gc.disable()  # a process that compiles and ends
    graph(int(sys.argv[1]))
    maps(int(sys.argv[1]))
