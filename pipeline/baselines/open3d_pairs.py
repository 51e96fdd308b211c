"""Open3D's ICP from each scan to the one before, as a baseline."""

from __future__ import annotations

import ctypes
import importlib
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.baselines.at_stamp import AtStamp
from pipeline.baselines.baseline import finite, middle
from pipeline.data import Pose, RawPoints
from pipeline.errors import MissingExtraError

Residual = Literal["point-to-plane", "point-to-point"]

_VOXEL_M = 0.5
_MAX_DISTANCE_M = 1.0
_NORMAL_RADIUS_M, _NORMAL_NEIGHBOURS = 1.5, 20
_ITERATIONS = 30  # Open3D's default


class Open3dPairs:
    """Scan-to-scan ICP on thinned clouds, started at constant velocity."""

    def __init__(self, residual: Residual) -> None:
        self.open3d = _import_open3d()
        self.residual = residual
        estimation = self.open3d.pipelines.registration
        planes = residual == "point-to-plane"
        self.estimation: Any = (
            estimation.TransformationEstimationPointToPlane()
            if planes
            else estimation.TransformationEstimationPointToPoint()
        )
        self.criteria: Any = estimation.ICPConvergenceCriteria(max_iteration=_ITERATIONS)
        self.previous: Any = None
        self.T_odom_lidar = np.eye(4)
        self.T_previous_current = np.eye(4)
        self.at_stamp = AtStamp()

    @property
    def description(self) -> str:
        """What it does and with which parameters."""
        return (
            f"Open3D registration_icp, {self.residual}, scan to scan, voxels of {_VOXEL_M:g} m, pairs within "
            f"{_MAX_DISTANCE_M:g} m, {_ITERATIONS} iterations, constant velocity, no deskewing"
        )

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan against the last and chain the motions."""
        frame, times = finite(points, times_s)
        cloud = self._cloud(frame)
        if self.previous is not None:
            answer = self.open3d.pipelines.registration.registration_icp(
                cloud, self.previous, _MAX_DISTANCE_M, self.T_previous_current, self.estimation, self.criteria
            )
            self.T_previous_current = np.array(answer.transformation)
            self.T_odom_lidar = lie.normalise(self.T_odom_lidar @ self.T_previous_current)
        self.previous = cloud
        return self.at_stamp.move(self.T_odom_lidar, stamp_ns, middle(times))

    def _cloud(self, points: NDArray[np.float64]) -> Any:
        cloud = self.open3d.geometry.PointCloud(self.open3d.utility.Vector3dVector(points))
        cloud = cloud.voxel_down_sample(_VOXEL_M)
        if self.residual == "point-to-plane":
            cloud.estimate_normals(
                self.open3d.geometry.KDTreeSearchParamHybrid(_NORMAL_RADIUS_M, _NORMAL_NEIGHBOURS)
            )
        return cloud


def _import_open3d() -> ModuleType:
    """Open3D, with the libusb it needs, which slim machines lack, loaded from the package that ships it."""
    try:
        libusb = importlib.import_module("libusb_package")
        path = libusb.get_library_path()
    except ImportError:
        path = None
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    try:
        open3d = importlib.import_module("open3d")
    except ImportError:
        raise MissingExtraError("open3d, or the libusb-package that it needs,", "baselines") from None
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
