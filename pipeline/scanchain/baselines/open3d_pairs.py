"""Open3D's ICP from each scan to the one before, as a baseline."""

from __future__ import annotations

import ctypes
import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any, Literal

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from scanchain import lie
from scanchain.baselines.baseline import AtStamp, finite, middle
from scanchain.config import Count, Positive
from scanchain.data import Pose, RawPoints
from scanchain.errors import MissingExtraError

Residual = Literal["point-to-plane", "point-to-point", "plane-to-plane"]


class Open3dSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Voxels for downsampling, largest distance of correspondences, and neighborhood of normals."""

    voxel_size_m: Positive = 0.5
    max_distance_m: Positive = 1.0
    normal_radius_m: Positive = 1.5
    normal_neighbors: Count = 20
    max_iterations: Count = 30


OPEN3D = Open3dSettings()
PLANAR_OPEN3D = Open3dSettings(voxel_size_m=0.05, max_distance_m=0.5, normal_radius_m=0.5)


class Open3dPairs:
    """Scan-to-scan ICP on downsampled clouds, started at constant velocity."""

    def __init__(self, residual: Residual, settings: Open3dSettings = OPEN3D) -> None:
        self.open3d = _import_open3d()
        self.residual = residual
        self.settings = settings
        registration = self.open3d.pipelines.registration
        self.register, self.estimation = _registration(registration, residual)
        self.criteria: Any = registration.ICPConvergenceCriteria(max_iteration=settings.max_iterations)
        self.previous: Any = None
        self.T_odom_lidar = np.eye(4)
        self.T_previous_current = np.eye(4)
        self.at_stamp = AtStamp()

    @property
    def description(self) -> str:
        """Method and parameters."""
        return (
            f"Open3D {self.register.__name__}, {self.residual}, scan to scan, voxels of "
            f"{self.settings.voxel_size_m:g} m, correspondences within {self.settings.max_distance_m:g} m, "
            f"{self.settings.max_iterations} iterations, constant velocity, no deskewing"
        )

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan against the last and chain the motions."""
        frame, times = finite(points, times_s)
        cloud = self._cloud(frame)
        if self.previous is not None:
            result = self.register(
                cloud,
                self.previous,
                self.settings.max_distance_m,
                self.T_previous_current,
                self.estimation,
                self.criteria,
            )
            self.T_previous_current = np.array(result.transformation)
            self.T_odom_lidar = lie.normalize(self.T_odom_lidar @ self.T_previous_current)
        self.previous = cloud
        return self.at_stamp.move(self.T_odom_lidar, stamp_ns, middle(times))

    def _cloud(self, points: NDArray[np.float64]) -> Any:
        cloud = self.open3d.geometry.PointCloud(self.open3d.utility.Vector3dVector(points))
        cloud = cloud.voxel_down_sample(self.settings.voxel_size_m)
        if self.residual != "point-to-point":
            cloud.estimate_normals(
                self.open3d.geometry.KDTreeSearchParamHybrid(
                    self.settings.normal_radius_m, self.settings.normal_neighbors
                )
            )
        return cloud


def _registration(registration: Any, residual: Residual) -> tuple[Callable[..., Any], Any]:
    """Open3D's registration function for a residual, and its estimation object."""
    if residual == "plane-to-plane":
        return (
            registration.registration_generalized_icp,
            registration.TransformationEstimationForGeneralizedICP(),
        )
    if residual == "point-to-plane":
        return registration.registration_icp, registration.TransformationEstimationPointToPlane()
    return registration.registration_icp, registration.TransformationEstimationPointToPoint()


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
