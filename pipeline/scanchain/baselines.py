"""Third-party methods by name: KISS-ICP, KISS-SLAM, GenZ-ICP, RKO-LIO, small_gicp, Open3D's ICP from scan to scan.

A new one is a class, as ``Baseline`` describes it, and a line in ``BASELINES``. Outside of the package,
``scanchain compare --methods my_module:MyClass`` runs a class of yours, given its table of --config as keywords.
"""

from __future__ import annotations

import ctypes
import importlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Count, NonNegative, Positive
from scanchain.data import Inertial, Matrix, Pose, RawPoints
from scanchain.errors import MissingExtraError, NotApplicableError


class Baseline(Protocol):
    """A third-party odometry method, run on the same scans as ours.

    One with ``add_inertial`` is given the ``Inertial`` of a scan before the scan, on logs that have an IMU. What
    ``final_poses`` returns, where there is one, after the last scan, (N, 4, 4), is the trajectory then.
    """

    @property
    def description(self) -> str:
        """Method and parameters, for the footnote of a table."""
        ...

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """T_odom_lidar (4, 4) at the scan's stamp; the first is the identity.

        points : (N, 3) meters, lidar frame; times_s : (N,) seconds relative to the stamp, (0,) where unknown
        """
        ...


def finite(points: RawPoints, times_s: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points without NaN and inf as float64, and their times.

    Times that are all equal are dropped: KISS-ICP divides by their span.
    """
    times = times_s.astype(np.float64) if len(times_s) == len(points) else np.empty(0)
    if not (np.isfinite(points).all() and np.isfinite(times).all()):
        good = np.isfinite(points).all(axis=1)
        if len(times):
            good &= np.isfinite(times)
            times = times[good]
        points = points[good]
    unequal = len(times) > 0 and times.min() < times.max()
    return np.ascontiguousarray(points, dtype=np.float64), times if unequal else np.empty(0)


def middle(times_s: NDArray[np.float64]) -> float:
    """Seconds from the stamp to the middle of the sweep, where a distorted scan's pose holds; 0 if unknown."""
    return 0.5 * float(times_s.min() + times_s.max()) if len(times_s) else 0.0


class AtStamp:
    """Moves each pose back to its scan's stamp, at the velocity since the pose before.

    A baseline calls the pose of its first scan the identity, at whatever instant that holds; here it is the
    first stamp's. Where that lies is known from the second scan on, when there is a velocity.
    """

    def __init__(self) -> None:
        self.T_odom_theirs: Pose | None = None
        self.T_theirs_last: Pose | None = None
        self.last_stamp_ns, self.last_held_s = 0, 0.0

    def move(self, T_theirs_held: Pose, stamp_ns: int, held_s: float) -> Pose:
        """T_odom_lidar at the stamp, of a pose in the baseline's own frame that is valid ``held_s`` after it."""
        T_theirs_last, self.T_theirs_last = self.T_theirs_last, T_theirs_held
        interval_s = (stamp_ns - self.last_stamp_ns) * 1e-9 + held_s - self.last_held_s
        last_held_s = self.last_held_s
        self.last_stamp_ns, self.last_held_s = stamp_ns, held_s
        if T_theirs_last is None:
            return np.eye(4)
        motion = lie.log(lie.between(T_theirs_last, T_theirs_held))
        velocity = motion / interval_s if interval_s > 0.0 else np.zeros(6)
        if self.T_odom_theirs is None:
            self.T_odom_theirs = lie.inverse(T_theirs_last @ lie.exp(-last_held_s * velocity))
        return self.T_odom_theirs @ T_theirs_held @ lie.exp(-held_s * velocity)


_LEVELS, _STEP_M = 5, 0.1  # copies of a planar scan at different heights, and their spacing


class InPlane:
    """Feeds a 3D baseline with planar scans and brings its poses back into the plane.

    Points lie at z = 0 or, where the method looks for surfaces, are copied at several heights: walls, whose
    normals are horizontal. All levels are identical, so that the height is unobservable.
    """

    def __init__(self, baseline: Baseline, *, is_raised: bool) -> None:
        self.baseline = baseline
        self.heights_m = _STEP_M * (np.arange(_LEVELS) - _LEVELS // 2) if is_raised else np.zeros(1)
        how = f"{_LEVELS} copies {_STEP_M:g} m above each other" if is_raised else "at z = 0"
        self.description = f"{baseline.description}; 2D scans {how}"

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """T_odom_lidar (3, 3) of points (N, 2)."""
        levels = len(self.heights_m)
        raised = np.empty((levels * len(points), 3), np.float32)
        raised[:, :2] = np.tile(points, (levels, 1))
        raised[:, 2] = np.repeat(self.heights_m, len(points))
        return lie.flatten(self.baseline.track(raised, np.tile(times_s, levels), stamp_ns))


DISTORTED = 2  # first scans that KISS-ICP does not deskew, for lack of a previous motion


def _imported(module: str, package: str, extra: str = "baselines") -> Any:
    """A module of a package that only an extra installs."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingExtraError(package, extra) from None


class KissSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Its defaults; its own rule for voxels is a hundredth of the largest range. Threads: 0 are all."""

    min_range_m: NonNegative = 0.0
    max_range_m: Positive = 100.0
    voxel_size_m: Positive = 1.0
    max_points_per_voxel: Count = 20
    max_iterations: Count = 500
    threads: Annotated[int, Meta(ge=0)] = 0


KISS = KissSettings()
PLANAR_KISS = KissSettings(max_range_m=40.0, voxel_size_m=0.4)


class KissIcp:
    """KISS-ICP: point-to-point, scan to map, adaptive threshold."""

    def __init__(self, settings: KissSettings = KISS) -> None:
        library = _imported("kiss_icp.kiss_icp", "kiss-icp")
        config = _imported("kiss_icp.config.parser", "kiss-icp").load_config(None)
        self.description = f"KISS-ICP, {_configured_kiss(config, config.data, settings)}"
        self.odometry = library.KissICP(config)
        self.at_stamp = AtStamp()
        self.held = list[tuple[int, float]]()  # stamp of each scan, and seconds from it to the pose

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan; KISS-ICP's pose holds at the last point once it deskews, ours at the scan's stamp."""
        frame, times = finite(points, times_s)
        T_theirs_held = self._registered(frame, times)
        is_distorted = len(self.held) < DISTORTED or not len(times)
        self.held.append((stamp_ns, middle(times) if is_distorted else float(times.max())))
        return self.at_stamp.move(T_theirs_held, *self.held[-1])

    def _registered(self, frame: NDArray[np.float64], times: NDArray[np.float64]) -> Pose:
        self.odometry.register_frame(frame, times)
        return np.array(self.odometry.last_pose, np.float64)


def _configured_kiss(odometry: Any, data: Any, settings: KissSettings) -> str:
    """The description of these settings, which are written into KISS-ICP's configuration."""
    data.min_range, data.max_range = settings.min_range_m, settings.max_range_m
    odometry.mapping.voxel_size = settings.voxel_size_m
    odometry.mapping.max_points_per_voxel = settings.max_points_per_voxel
    odometry.registration.max_num_iterations = settings.max_iterations
    odometry.registration.max_num_threads = settings.threads
    return (
        f"point-to-point scan to map, {settings.min_range_m:g} to {settings.max_range_m:g} m, "
        f"voxels of {settings.voxel_size_m:g} m, {settings.threads or 'all'} threads, its own deskewing where "
        "the log has times"
    )


class KissSlamSettings(KissSettings, frozen=True, forbid_unknown_fields=True):
    """Its defaults; a local map ends so far from where it began, and one that a closure joins overlaps so much."""

    local_map_m: Positive = 100.0
    min_overlap: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.4


KISS_SLAM = KissSlamSettings()


class KissSlam(KissIcp):
    """KISS-SLAM: KISS-ICP, loop closures between local maps by MapClosures, pose graph."""

    def __init__(self, settings: KissSlamSettings = KISS_SLAM) -> None:
        config = _imported("kiss_slam.config", "kiss-slam", "slam").load_config(None)
        _import_open3d("slam")
        config.local_mapper.splitting_distance = settings.local_map_m
        config.loop_closer.overlap_threshold = settings.min_overlap
        odometry = _configured_kiss(config.odometry, config.odometry.preprocessing, settings)
        self.description = (
            f"KISS-SLAM, {odometry}; loops closed between local maps of {settings.local_map_m:g} m that "
            f"overlap by {settings.min_overlap:g}, pose graph optimized at the end"
        )
        self.slam = _imported("kiss_slam.slam", "kiss-slam", "slam").KissSLAM(config)
        self.at_stamp, self.T_odom_map = AtStamp(), np.eye(4)
        self.held = list[tuple[int, float]]()

    def final_poses(self) -> Matrix:
        """The poses at the stamps of all scans after the last optimization, which crashes on a single scan."""
        if len(self.held) == 1:
            return np.eye(4)[None]
        self.slam.generate_new_node()
        self.slam.local_map_graph.erase_last_local_map()
        poses, _ = self.slam.fine_grained_optimization()
        at_stamp = AtStamp()
        return np.array([at_stamp.move(pose, *held) for pose, held in zip(poses, self.held, strict=True)])

    def _registered(self, frame: NDArray[np.float64], times: NDArray[np.float64]) -> Pose:
        """The pose without the corrections of closures."""
        local_map = self.slam.local_map_graph.last_local_map
        self.slam.process_scan(frame, times)
        T_odom_lidar = self.T_odom_map @ local_map.local_trajectory[-1]
        if self.slam.local_map_graph.last_local_map is not local_map:
            self.T_odom_map = T_odom_lidar
        return T_odom_lidar


Preset = Literal["outdoor", "indoor", "kitti"]

# Settings of its outdoor.yaml, indoor.yaml and kitti.yaml that differ from its defaults.
_DATA = {"outdoor": {"min_range": 0.5}, "indoor": {"min_range": 0.3}, "kitti": {"min_range": 5.0}}
_OUTDOOR = {"voxel_size": 0.6, "desired_num_voxelized_points": 3000, "max_points_per_voxel": 3}
_MAPPING = {"outdoor": _OUTDOOR, "indoor": {}, "kitti": _OUTDOOR | {"planarity_threshold": 0.18}}


class GenzSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Preset of its authors, by kind of environment."""

    preset: Preset = "outdoor"


class GenzIcp:
    """GenZ-ICP with a preset of its authors.

    It lets its voxels grow and shrink until a scan has the desired number of points, and keeps their size in a
    static variable: a second odometry in the same process starts with the voxel size of the first.
    """

    def __init__(self, settings: GenzSettings) -> None:
        preset = settings.preset
        library = _imported("genz_icp.genz_icp", "genz-icp")
        config = _imported("genz_icp.config", "genz-icp").load_config(None)
        config.data = config.data.model_copy(update={"deskew": True} | _DATA[preset])
        config.mapping = config.mapping.model_copy(update=_MAPPING[preset])
        self.description = (
            f"GenZ-ICP, planes and points, scan to map, its {preset}.yaml: {config.data.min_range:g} to "
            f"{config.data.max_range:g} m, voxels of {config.mapping.voxel_size:g} m, about "
            f"{config.mapping.desired_num_voxelized_points} points a scan, all threads; its own deskewing, off in "
            "that file, on where the log has times"
        )
        self.odometry = library.GenZICP(config)
        self.at_stamp = AtStamp()

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan; GenZ-ICP wants times from 0 to 1 and its pose holds at 0.5, ours at the stamp."""
        frame, times = finite(points, times_s)
        share = (times - times.min()) / np.ptp(times) if len(times) else times
        self.odometry.register_frame(frame, share)
        return self.at_stamp.move(np.array(self.odometry.last_pose, np.float64), stamp_ns, middle(times))


class RkoSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Its defaults. Threads: 0 are all."""

    min_range_m: NonNegative = 1.0
    max_range_m: Positive = 100.0
    voxel_size_m: Positive = 1.0
    max_distance_m: Positive = 0.5
    max_iterations: Count = 100
    threads: Annotated[int, Meta(ge=0)] = 0


class RkoLio:
    """RKO-LIO: point-to-point, scan to map, with gyro and accelerometer."""

    def __init__(self, settings: RkoSettings) -> None:
        library = _imported("rko_lio.lio", "rko-lio")
        config = _imported("rko_lio.config", "rko-lio").LIOConfig(
            min_range=settings.min_range_m,
            max_range=settings.max_range_m,
            voxel_size=settings.voxel_size_m,
            max_correspondence_distance=settings.max_distance_m,
            max_iterations=settings.max_iterations,
            max_num_threads=settings.threads,
        )
        self.description = (
            f"RKO-LIO, point-to-point scan to map, with the IMU, {settings.min_range_m:g} to "
            f"{settings.max_range_m:g} m, voxels of {settings.voxel_size_m:g} m, {settings.threads or 'all'} "
            "threads, its own deskewing where the log has times"
        )
        self.odometry = library.LIO(config)
        self.at_stamp = AtStamp()
        self.scans, self.has_imu = 0, False

    def add_inertial(self, inertial: Inertial) -> None:
        """Add the samples since the scan before; without a transform the IMU is taken to lie in the lidar."""
        self.has_imu = True
        T_lidar_imu = np.eye(4) if inertial.T_lidar_imu is None else inertial.T_lidar_imu
        samples = (inertial.accelerations, inertial.rates, inertial.stamps_ns.tolist())
        for acceleration, rate, stamp_ns in zip(*samples, strict=True):
            self.odometry.add_imu_measurement(acceleration, rate, stamp_ns, T_lidar_imu)

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan; RKO-LIO's pose holds at the last point, ours at the scan's stamp.

        Raises InputError at the second scan if there has been no sample of an IMU.
        """
        if self.scans and not self.has_imu:
            raise NotApplicableError("needs an IMU, of which the log has no sample")
        self.scans += 1
        frame, times = finite(points, times_s)
        since_ns = np.rint(1e9 * times).astype(np.int64) if len(times) else np.zeros(len(frame), np.int64)
        self.odometry.register_scan(frame, stamp_ns + since_ns)
        return self.at_stamp.move(self.odometry.pose(), stamp_ns, float(times.max(initial=0.0)))


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


class _Chained:
    """Registration of each scan to those before, started at constant velocity."""

    def __init__(self) -> None:
        self.previous: Any = None
        self.T_odom_lidar, self.T_previous_current = np.eye(4), np.eye(4)
        self.at_stamp = AtStamp()

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan and chain the motions."""
        frame, times = finite(points, times_s)
        cloud = self._prepared(frame)
        if self.previous is not None:
            self.T_previous_current = self._registered(cloud)
            self.T_odom_lidar = lie.normalize(self.T_odom_lidar @ self.T_previous_current)
        self.previous = cloud
        return self.at_stamp.move(self.T_odom_lidar, stamp_ns, middle(times))

    def _prepared(self, points: NDArray[np.float64]) -> Any:
        """The preprocessed cloud that is registered."""
        raise NotImplementedError

    def _registered(self, cloud: Any) -> Pose:
        """T_previous_current (4, 4) of a prepared scan."""
        raise NotImplementedError


class _SmallGicp(_Chained):
    def __init__(self, settings: GicpSettings | VgicpSettings) -> None:
        super().__init__()
        self.library = _imported("small_gicp", "small-gicp")
        self.settings = settings
        self.threads = settings.threads or os.cpu_count() or 1

    def _prepared(self, points: NDArray[np.float64]) -> Any:
        """Downsampled points with covariances, and their tree."""
        return self.library.preprocess_points(
            points,
            downsampling_resolution=self.settings.downsampling_m,
            num_neighbors=self.settings.neighbors,
            num_threads=self.threads,
        )


class SmallGicpPairs(_SmallGicp):
    """GICP from each scan to the one before."""

    def __init__(self, settings: GicpSettings = GICP) -> None:
        super().__init__(settings)
        self.max_distance_m = settings.max_distance_m
        self.description = (
            f"small_gicp GICP, scan to scan, downsampled to {settings.downsampling_m:g} m, correspondences within "
            f"{settings.max_distance_m:g} m, {self.threads} threads, constant velocity, no deskewing"
        )

    def _registered(self, cloud: Any) -> Pose:
        (target, target_tree), (source, _) = self.previous, cloud
        result = self.library.align(
            target,
            source,
            target_tree,
            self.T_previous_current,
            max_correspondence_distance=self.max_distance_m,
            num_threads=self.threads,
        )
        return np.array(result.T_target_source)


class SmallGicpModel(_SmallGicp):
    """Scan to a map of Gaussian voxels (VGICP), into which the previous scan is inserted first."""

    def __init__(self, settings: VgicpSettings = VGICP) -> None:
        super().__init__(settings)
        self.map: Any = self.library.GaussianVoxelMap(settings.voxel_size_m)
        self.map.set_lru(horizon=settings.horizon, clear_cycle=10)
        self.description = (
            f"small_gicp VGICP, scan to map, downsampled to {settings.downsampling_m:g} m, voxels of "
            f"{settings.voxel_size_m:g} m, {self.threads} threads, constant velocity, no deskewing"
        )

    def _registered(self, cloud: Any) -> Pose:
        self.map.insert(self.previous[0], self.T_odom_lidar)
        guess = self.T_odom_lidar @ self.T_previous_current
        result = self.library.align(self.map, cloud[0], guess, num_threads=self.threads)
        return lie.between(self.T_odom_lidar, lie.normalize(np.array(result.T_target_source)))


Residual = Literal["point-to-plane", "point-to-point", "plane-to-plane"]

# Open3D's registration function for a residual, and its estimation object.
_REGISTRATIONS: dict[Residual, tuple[str, str]] = {
    "point-to-plane": ("registration_icp", "TransformationEstimationPointToPlane"),
    "point-to-point": ("registration_icp", "TransformationEstimationPointToPoint"),
    "plane-to-plane": ("registration_generalized_icp", "TransformationEstimationForGeneralizedICP"),
}


class Open3dSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Voxels for downsampling, largest distance of correspondences, and neighborhood of normals.

    scales : multiples of voxels and distance at which scans are registered, one after the other
    """

    voxel_size_m: Positive = 0.5
    max_distance_m: Positive = 1.0
    normal_radius_m: Positive = 1.5
    normal_neighbors: Count = 20
    max_iterations: Count = 30
    scales: Annotated[tuple[Positive, ...], Meta(min_length=1)] = (1.0,)


OPEN3D, MULTISCALE = Open3dSettings(), Open3dSettings(scales=(4.0, 2.0, 1.0))
PLANAR_OPEN3D = Open3dSettings(voxel_size_m=0.05, max_distance_m=0.5, normal_radius_m=0.5)


class Open3dPairs(_Chained):
    """Scan-to-scan ICP on downsampled clouds."""

    def __init__(self, residual: Residual, settings: Open3dSettings = OPEN3D) -> None:
        super().__init__()
        self.open3d = _import_open3d()
        self.residual = residual
        self.settings = settings
        registration = self.open3d.pipelines.registration
        register, estimation = _REGISTRATIONS[residual]
        self.register, self.estimation = getattr(registration, register), getattr(registration, estimation)()
        self.criteria: Any = registration.ICPConvergenceCriteria(max_iteration=settings.max_iterations)
        scales = ", ".join(f"{scale:g}" for scale in settings.scales)
        self.description = (
            f"Open3D {register}, {residual}, scan to scan, voxels of {settings.voxel_size_m:g} m, correspondences "
            f"within {settings.max_distance_m:g} m{f', both times {scales}' if len(settings.scales) > 1 else ''}, "
            f"{settings.max_iterations} iterations, constant velocity, no deskewing"
        )

    def _registered(self, cloud: Any) -> Pose:
        T = self.T_previous_current
        for scale, source, target in zip(self.settings.scales, cloud, self.previous, strict=True):
            distance_m = scale * self.settings.max_distance_m
            T = self.register(source, target, distance_m, T, self.estimation, self.criteria).transformation
        return np.array(T)

    def _prepared(self, points: NDArray[np.float64]) -> Any:
        """A cloud for each scale."""
        whole = self.open3d.geometry.PointCloud(self.open3d.utility.Vector3dVector(points))
        clouds = [whole.voxel_down_sample(scale * self.settings.voxel_size_m) for scale in self.settings.scales]
        for scale, cloud in zip(self.settings.scales, clouds, strict=True):
            if self.residual != "point-to-point":
                radius_m, neighbors = scale * self.settings.normal_radius_m, self.settings.normal_neighbors
                cloud.estimate_normals(self.open3d.geometry.KDTreeSearchParamHybrid(radius_m, neighbors))
        return clouds


def _import_open3d(extra: str = "baselines") -> Any:
    """Open3D, with the libusb it needs, which slim machines lack, loaded from the package that ships it."""
    try:
        libusb = importlib.import_module("libusb_package")
        path = libusb.get_library_path()
    except ImportError:
        path = None
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    open3d = _imported("open3d", "open3d, or the libusb-package that it needs,", extra)
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


@dataclass(frozen=True, slots=True)
class Entry:
    """A registered baseline.

    make : constructor, given the settings; the package is imported there and not before
    package : distribution whose version is reported
    settings : for 3D scans; planar: for 2D ones, None where it makes no sense for these: nothing sets point-to-
        plane the height, and GenZ-ICP's voxels grow until a scan has thousands of points
    is_raised : whether a 2D scan must be given height, because surfaces are looked for
    forgets : whether a second instance in a process is independent of the first
    wants_imu : whether it needs a log with an IMU
    """

    make: Callable[[Any], Baseline]
    package: str
    settings: Struct
    planar: Struct | None
    is_raised: bool = False
    forgets: bool = True
    wants_imu: bool = False


BASELINES: dict[str, Entry] = {
    "open3d-p2p": Entry(partial(Open3dPairs, "point-to-point"), "open3d", OPEN3D, PLANAR_OPEN3D),
    "open3d-p2l": Entry(partial(Open3dPairs, "point-to-plane"), "open3d", OPEN3D, None),
    "open3d-multiscale": Entry(partial(Open3dPairs, "point-to-plane"), "open3d", MULTISCALE, None),
    "open3d-gicp": Entry(partial(Open3dPairs, "plane-to-plane"), "open3d", OPEN3D, PLANAR_OPEN3D, is_raised=True),
    "kiss-icp": Entry(KissIcp, "kiss-icp", KISS, PLANAR_KISS),
    "kiss-slam": Entry(KissSlam, "kiss-slam", KISS_SLAM, None),
    "small-gicp": Entry(SmallGicpPairs, "small-gicp", GICP, PLANAR_GICP, is_raised=True),
    "small-vgicp": Entry(SmallGicpModel, "small-gicp", VGICP, PLANAR_VGICP, is_raised=True),
    "genz-icp": Entry(GenzIcp, "genz-icp", GenzSettings(), None, forgets=False),
    "genz-icp-indoor": Entry(GenzIcp, "genz-icp", GenzSettings("indoor"), None, forgets=False),
    "genz-icp-kitti": Entry(GenzIcp, "genz-icp", GenzSettings("kitti"), None, forgets=False),
    "rko-lio": Entry(RkoLio, "rko-lio", RkoSettings(), None, wants_imu=True),
}
