"""``python -m scanchain.runs.warm_up 3 fit results``: compile parts of what a run needs, with synthetic scans.

A run whose kernels have to be compiled first starts this beside itself, on cores that it does not need yet; what
one process is compiling the others wait for.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from scanchain import lie
from scanchain.data import Points, Pose, Prior, Scan, State
from scanchain.kernels.registration.icp import Fit, Problem, align, fit_at
from scanchain.kernels.registration.observability import Spectrum, add_signals, agreement
from scanchain.kernels.registration.residuals import gradient_spread
from scanchain.odometry import Located
from scanchain.odometry.tracked import Tracked, first_match
from scanchain.registration import VoxelMap
from scanchain.registration.correlative import CorrelativeMap, Window
from scanchain.registration.plicp import settings_of
from scanchain.runs.results import cloud_of, grid_of
from scanchain.settings import load_settings
from scanchain.slam import Slam

_SCANS = 3
_STEP_M = 1.0
_POINTS = 100


def fit(dimension: int) -> None:
    """Compile the alignment of points to a voxel map, the largest of the kernels."""
    problem, T = _problem(dimension)
    align(problem, T, np.zeros(lie.twist_size(T)), 1.0, 1.0)


def judge(dimension: int) -> None:
    """Compile what tells the reliability of an alignment, and the search for one in the plane."""
    problem, T = _problem(dimension)
    k = lie.twist_size(T)
    if dimension == 2:
        grid = CorrelativeMap(VoxelMap(2, load_settings(2).config.local_map), T)
        grid.search(np.ones((1, 2)), T, Window(0.0, 0.0, 1.0, 1.0, answers=1))
    gradient_spread(problem.voxels, problem.points, T, problem.origin, problem.correspondence, problem.weight, 1.0)
    agreement(np.eye(k), np.eye(k), 1.0)
    spectrum = Spectrum(np.ones(k), np.ones(k), np.eye(k), np.ones(k))
    add_signals(problem, T, spectrum)
    fit_at(problem, T, Fit(np.eye(k), np.eye(k), 0.0, 0.0, 0.0, 0, 0, 0))


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
        settings_of(config.matching, target, wide=False),
    )
    return problem, T


def graph(dimension: int) -> None:
    """Compile what the errors of a pose graph take: its linearization and the factor of that."""
    slam = _straight_on(dimension)
    slam.graph.position_errors(1)
    slam.points.close()


def results(dimension: int) -> None:
    """Compile what follows the odometry: the end of the pose graph, and both maps."""
    slam = _straight_on(dimension)
    result = slam.finish()
    cloud_of(result, slam.config)
    grid_of(result, slam.config.maps)
    slam.points.close()


def _straight_on(dimension: int) -> Slam:
    """SLAM after a few scans of a lidar that drove straight on."""
    config = load_settings(dimension).config
    slam = Slam(config, lie.identity(dimension))
    points = np.random.default_rng(0).uniform(2.0, 20.0, (_POINTS, dimension))
    points[:, 2:] *= 0.02  # into the slice of which the grid is drawn
    for index in range(_SCANS):
        T_odom_lidar = lie.identity(dimension)
        T_odom_lidar[0, -1] = _STEP_M * index
        slam.place(_located(index, points, T_odom_lidar, slam))
    return slam


def _located(index: int, points: Points, T_odom_lidar: Pose, slam: Slam) -> Located:
    scan = Scan(index, index, index, points.astype(np.float32), np.empty(0, np.float32), 0, None)
    match = first_match(T_odom_lidar, points, slam.config.matching)
    prior = Prior(T_odom_lidar, np.eye(len(match.information)), np.ones(len(match.information)))
    tracked = Tracked(scan, points, points, T_odom_lidar, match, State.OK, "", prior, 0.0, 0.0, 0.0)
    return Located(tracked, True, 1.0, points, match.information, points)


_PARTS: Mapping[str, Callable[[int], None]] = MappingProxyType(
    {"fit": fit, "judge": judge, "results": results, "graph": graph}
)


def beside(dimension: int, cores: int) -> Sequence[Sequence[str]]:
    """Arguments of ``python -m`` of the processes beside a run that compiles, by the order of first use.

    There are as many as cores, as the run itself often waits for them.
    """
    count = min(cores, len(_PARTS))
    return [("scanchain.runs.warm_up", str(dimension), *list(_PARTS)[first::count]) for first in range(count)]


if __name__ == "__main__":
    gc.disable()  # a compiler makes much that lasts, and this process ends soon
    for part in sys.argv[2:]:
        _PARTS[part](int(sys.argv[1]))
