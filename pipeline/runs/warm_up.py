"""``python -m scanchain.runs.warm_up 3 fit maps``: compile parts of what a run needs, with synthetic scans.

A run whose kernels have to be compiled first starts this beside itself, on cores that it does not need yet; what
one process is compiling the others wait for. Each part imports what it needs, as it is to begin at once.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Keyframe, KeyframeErrors, Matrix, Points, Pose, Prior, Scan, State
from scanchain.kernels.registration.icp import Fit, align, fit_at
from scanchain.kernels.registration.observability import agreement, signal_along
from scanchain.kernels.registration.residuals import Problem, gradient_spread
from scanchain.odometry import Located
from scanchain.odometry.tracked import Tracked, first_match
from scanchain.registration import VoxelMap
from scanchain.registration.correlative import CorrelativeMap, Window
from scanchain.registration.plicp import settings_of
from scanchain.settings import load_settings

_SCANS = 3
_STEP_M = 1.0
_POINTS = 100


def fit(dimension: int) -> None:
    """Compile the alignment of points to a voxel map, the largest of the kernels."""
    problem, T = _problem(dimension)
    align.compile_inner(problem, T, np.zeros(lie.twist_size(T)), 1.0)


def judge(dimension: int) -> None:
    """Compile what tells the reliability of an alignment, and the search for one in the plane."""
    problem, T = _problem(dimension)
    k = lie.twist_size(T)
    if dimension == 2:
        grid = CorrelativeMap(VoxelMap(2, load_settings(2).config.local_map), T)
        grid.search(np.ones((1, 2)), T, Window(0.0, 0.0, 1.0, 1.0, answers=1))
    gradient_spread.compile_inner(problem, T, 1.0)
    agreement.compile_inner(np.eye(k), np.eye(k), 1.0)
    signal_along.compile_inner(problem, T, np.zeros(k))
    fit_at.compile_inner(problem, T, Fit(np.eye(k), np.eye(k), 0.0, 0.0, 0.0, 0, 0, 0))


def _problem(dimension: int) -> tuple[Problem, Pose]:
    """The alignment of no points to an empty map, and the pose it begins at."""
    config = load_settings(dimension).config
    target = VoxelMap(dimension, config.local_map)
    T = lie.identity(dimension)
    k = lie.twist_size(T)
    problem = Problem(
        target.voxels,
        np.empty((0, dimension)),
        np.zeros(3),
        np.eye(k),
        np.empty(0, np.int32),
        np.empty(0),
        np.zeros((8, k)),
        1.0,
        settings_of(config.matching, target, wide=False),
    )
    return problem, T


def graph(dimension: int) -> None:
    """Compile the optimization of a pose graph, errors of its poses, and the covariances that loops need."""
    from scanchain.slam import Slam

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
    from scanchain.runs import results

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


_PARTS: Mapping[str, Callable[[int], None]] = MappingProxyType(
    {"fit": fit, "judge": judge, "graph": graph, "maps": maps}
)


def beside(dimension: int, cores: int) -> Sequence[Sequence[str]]:
    """Arguments of ``python -m`` of the processes beside a run that compiles, by the order of first use.

    There are as many as cores, as the run itself often waits for them.
    """
    count = min(cores, len(_PARTS))
    return [("scanchain.runs.warm_up", str(dimension), *list(_PARTS)[first::count]) for first in range(count)]


if __name__ == "__main__":
    gc.disable()  # a process that compiles and ends
    for part in sys.argv[2:]:
        _PARTS[part](int(sys.argv[1]))
