"""small_gicp (Koide 2024) as a baseline: voxelized GICP to a map, and GICP from scan to scan."""

from __future__ import annotations

import importlib
import os
from types import ModuleType
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from scanchain import lie
from scanchain.baselines.baseline import AtStamp, finite, middle
from scanchain.config import Count, Positive
from scanchain.data import Pose, RawPoints
from scanchain.errors import MissingExtraError

_CLEAR_CYCLE = 10  # of small_gicp's own odometry example, as are the defaults below


class GicpSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the scan-to-scan odometry; 0 threads are all."""

    downsampling_m: Positive = 0.25
    max_distance_m: Positive = 1.0
    neighbors: Count = 20
    threads: Annotated[int, Meta(ge=0)] = 0


class VgicpSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the scan-to-map odometry; 0 threads are all. Voxels unseen for ``horizon`` scans go."""

    downsampling_m: Positive = 0.25
    voxel_size_m: Positive = 1.0
    horizon: Count = 100
    neighbors: Count = 20
    threads: Annotated[int, Meta(ge=0)] = 0


GICP, PLANAR_GICP = GicpSettings(), GicpSettings(downsampling_m=0.05, max_distance_m=0.5)
VGICP, PLANAR_VGICP = VgicpSettings(), VgicpSettings(downsampling_m=0.05, voxel_size_m=0.3)


class SmallGicpModel:
    """Scan to a map of Gaussian voxels (VGICP), started at constant velocity."""

    def __init__(self, settings: VgicpSettings = VGICP) -> None:
        self.library = _import_small_gicp()
        self.settings = settings
        self.threads = settings.threads or os.cpu_count() or 1
        self.map: Any = self.library.GaussianVoxelMap(settings.voxel_size_m)
        self.map.set_lru(horizon=settings.horizon, clear_cycle=_CLEAR_CYCLE)
        self.started = False
        self.T_odom_lidar = np.eye(4)
        self.T_previous_current = np.eye(4)
        self.at_stamp = AtStamp()

    @property
    def description(self) -> str:
        """Method and parameters."""
        return (
            f"small_gicp VGICP, scan to map, downsampled to {self.settings.downsampling_m:g} m, voxels of "
            f"{self.settings.voxel_size_m:g} m, "
            f"{self.threads} threads, constant velocity, no deskewing"
        )

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan against the map, then add it."""
        frame, times = finite(points, times_s)
        cloud, _ = self.library.preprocess_points(
            frame,
            downsampling_resolution=self.settings.downsampling_m,
            num_neighbors=self.settings.neighbors,
            num_threads=self.threads,
        )
        if self.started:
            guess = self.T_odom_lidar @ self.T_previous_current
            result = self.library.align(self.map, cloud, guess, num_threads=self.threads)
            T_odom_lidar = lie.normalize(np.array(result.T_target_source))
            self.T_previous_current = lie.between(self.T_odom_lidar, T_odom_lidar)
            self.T_odom_lidar = T_odom_lidar
        self.map.insert(cloud, self.T_odom_lidar)
        self.started = True
        return self.at_stamp.move(self.T_odom_lidar, stamp_ns, middle(times))


class SmallGicpPairs:
    """GICP from each scan to the one before, started at constant velocity."""

    def __init__(self, settings: GicpSettings = GICP) -> None:
        self.library = _import_small_gicp()
        self.settings = settings
        self.threads = settings.threads or os.cpu_count() or 1
        self.previous: Any = None
        self.T_odom_lidar = np.eye(4)
        self.T_previous_current = np.eye(4)
        self.at_stamp = AtStamp()

    @property
    def description(self) -> str:
        """Method and parameters."""
        return (
            f"small_gicp GICP, scan to scan, downsampled to {self.settings.downsampling_m:g} m, "
            "correspondences within "
            f"{self.settings.max_distance_m:g} m, {self.threads} threads, constant velocity, no deskewing"
        )

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan against the last and chain the motions."""
        frame, times = finite(points, times_s)
        cloud, tree = self.library.preprocess_points(
            frame,
            downsampling_resolution=self.settings.downsampling_m,
            num_neighbors=self.settings.neighbors,
            num_threads=self.threads,
        )
        if self.previous is not None:
            target, target_tree = self.previous
            result = self.library.align(
                target,
                cloud,
                target_tree,
                self.T_previous_current,
                max_correspondence_distance=self.settings.max_distance_m,
                num_threads=self.threads,
            )
            self.T_previous_current = np.array(result.T_target_source)
            self.T_odom_lidar = lie.normalize(self.T_odom_lidar @ self.T_previous_current)
        self.previous = cloud, tree
        return self.at_stamp.move(self.T_odom_lidar, stamp_ns, middle(times))


def _import_small_gicp() -> ModuleType:
    try:
        return importlib.import_module("small_gicp")
    except ImportError:
        raise MissingExtraError("small-gicp", "baselines") from None
