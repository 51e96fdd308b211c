"""small_gicp (Koide 2024) as a baseline: voxelised GICP to a map, and GICP from scan to scan."""

from __future__ import annotations

import importlib
import os
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.baselines.at_stamp import AtStamp
from pipeline.baselines.baseline import finite, middle
from pipeline.data import Pose, RawPoints
from pipeline.errors import MissingExtraError

_THINNING_M, _VOXEL_M = 0.25, 1.0  # of small_gicp's own odometry example, as is the rest
_HORIZON, _CLEAR_CYCLE = 100, 10


class SmallGicpModel:
    """Scan to a map of Gaussian voxels (VGICP), started at constant velocity."""

    def __init__(self, threads: int = 0) -> None:
        self.library = _import_small_gicp()
        self.threads = threads or os.cpu_count() or 1
        self.map: Any = self.library.GaussianVoxelMap(_VOXEL_M)
        self.map.set_lru(horizon=_HORIZON, clear_cycle=_CLEAR_CYCLE)
        self.started = False
        self.T_odom_lidar = np.eye(4)
        self.T_previous_current = np.eye(4)
        self.at_stamp = AtStamp()

    @property
    def description(self) -> str:
        """What it does and with which parameters."""
        return (
            f"small_gicp VGICP, scan to map, thinned to {_THINNING_M:g} m, voxels of {_VOXEL_M:g} m, "
            f"{self.threads} threads, constant velocity, no deskewing"
        )

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan against the map, then add it."""
        frame, times = finite(points, times_s)
        cloud, _ = self.library.preprocess_points(
            frame, downsampling_resolution=_THINNING_M, num_threads=self.threads
        )
        if self.started:
            guess = self.T_odom_lidar @ self.T_previous_current
            answer = self.library.align(self.map, cloud, guess, num_threads=self.threads)
            T_odom_lidar = lie.normalise(np.array(answer.T_target_source))
            self.T_previous_current = lie.inverse(self.T_odom_lidar) @ T_odom_lidar
            self.T_odom_lidar = T_odom_lidar
        self.map.insert(cloud, self.T_odom_lidar)
        self.started = True
        return self.at_stamp.move(self.T_odom_lidar, stamp_ns, middle(times))


class SmallGicpPairs:
    """GICP from each scan to the one before, started at constant velocity."""

    def __init__(self, threads: int = 0) -> None:
        self.library = _import_small_gicp()
        self.threads = threads or os.cpu_count() or 1
        self.previous: Any = None
        self.T_odom_lidar = np.eye(4)
        self.T_previous_current = np.eye(4)
        self.at_stamp = AtStamp()

    @property
    def description(self) -> str:
        """What it does and with which parameters."""
        return (
            f"small_gicp GICP, scan to scan, thinned to {_THINNING_M:g} m, {self.threads} threads, "
            "constant velocity, no deskewing"
        )

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan against the last and chain the motions."""
        frame, times = finite(points, times_s)
        cloud, tree = self.library.preprocess_points(
            frame, downsampling_resolution=_THINNING_M, num_threads=self.threads
        )
        if self.previous is not None:
            target, target_tree = self.previous
            answer = self.library.align(
                target, cloud, target_tree, self.T_previous_current, num_threads=self.threads
            )
            self.T_previous_current = np.array(answer.T_target_source)
            self.T_odom_lidar = lie.normalise(self.T_odom_lidar @ self.T_previous_current)
        self.previous = cloud, tree
        return self.at_stamp.move(self.T_odom_lidar, stamp_ns, middle(times))


def _import_small_gicp() -> ModuleType:
    try:
        return importlib.import_module("small_gicp")
    except ImportError:
        raise MissingExtraError("small-gicp", "baselines") from None
