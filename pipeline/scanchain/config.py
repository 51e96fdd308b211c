"""The configuration: frozen structs; units in the keys, ranges in the types, unknown keys refused.

``scanchain config show`` and the reference show the line that the docstring of a section has for each of its keys.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct
from msgspec.structs import fields, force_setattr

from scanchain.config_keys import LARGEST, section_keys
from scanchain.errors import InputError, shown
from scanchain.plugins import CLASS_NAME

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Meta(gt=0.0, le=LARGEST)]
NonNegative = Annotated[float, Meta(ge=0.0, le=LARGEST)]
Limit = Annotated[float, Meta(gt=0.0)]  # infinite: no limit
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Percent = Annotated[float, Meta(ge=0.0, le=100.0)]
Count = Annotated[int, Meta(ge=1)]


def _one_of(choices: dict[str, str]) -> Meta:
    """One of these words, or a class."""
    return Meta(pattern=rf"^({'|'.join(choices)}|{CLASS_NAME})\Z", extra={"choices": tuple(choices)})


NO_TOPIC = "none"  # of ``log.ground_truth_topic``, ``log.imu_topic`` and ``log.gnss_topic``

MATCHERS = {
    "plicp": "scanchain.registration.plicp:PointToShapeMatcher",
    "svd": "scanchain.registration.svd_icp:SvdMatcher",
}
Matcher = Annotated[str, _one_of(MATCHERS)]  # or a user's own, MODULE:CLASS
LOSSES = {  # of loop edges
    "none": "scanchain.graph.losses:Quadratic",
    "huber": "scanchain.graph.losses:Huber",
    "cauchy": "scanchain.graph.losses:Cauchy",
    "geman-mcclure": "scanchain.graph.losses:GemanMcClure",
    "tukey": "scanchain.graph.losses:Tukey",
    "truncated": "scanchain.graph.losses:Truncated",
}
Loss = Annotated[str, _one_of(LOSSES)]  # likewise
Optimizer = Literal["levenberg-marquardt", "gauss-newton", "newton", "gradient-descent"]


class Section(Struct, frozen=True, forbid_unknown_fields=True):
    """A branch of the configuration; one made in Python is checked like one read from a file."""

    def __post_init__(self) -> None:
        """Convert what converts without loss. Raises InputError naming the key, its value and its limits."""
        for key in section_keys(type(self)):
            leaf = key.name.rpartition(".")[2]
            force_setattr(self, leaf, key.check(getattr(self, leaf), type(self).__name__))


class LogConfig(Section, frozen=True, forbid_unknown_fields=True):
    """Reading of the log.

    format : log format: found automatically, a known one by name, or ``module:Class`` of your own
    topic : lidar topic; found automatically where empty; several, separated by commas, combine lidars: the points
        of the others are added to the scans of the first, in its frame
    odometry_topic : wheel odometry, ``nav_msgs/Odometry``, stamped poses, or transforms with odom → base_link;
        found automatically where empty
    ground_truth_topic : true poses, used for evaluation only; ``none`` leaves those of the log unused
    imu_topic : IMU, ``sensor_msgs/Imu``, used where it predicts motions better than the scans; found
        automatically where empty, ``none`` leaves it unused
    gnss_topic : GNSS receiver (``NavSatFix``, ``GPSFix``, ``LocationFix``), which gives the result its place on
        Earth, see ``graph.gnss``; found automatically where empty, ``none`` leaves it unused
    lidar_pose : pose of the lidar on its base, ``x y z qx qy qz qw``; by the transforms where empty
    other_lidar_poses : poses of the other lidars in the frame of the first one, separated by commas; by the
        transforms where empty
    elevation_offset_rad : angle by which the points of the (first) lidar are raised, a constant error of its own
    range_offset_m : length that is added to its ranges
    imu_rotation : rotation of the IMU in the lidar's frame, ``qx qy qz qw``; by the transforms where empty
    imu_delay_s : how late the stamps of the IMU are
    odometry_delay_s : how late the stamps of the wheel odometry are, as ``scanchain doctor`` finds it
    odometry_scale : distances by the wheels over true ones; they are divided by it
    odometry_turn_scale : turns by the wheels over true ones
    upside_down : whether a planar lidar hangs upside down although no transform says so: its scans are mirrored
    start_s : everything before this time, counted from the first message, is skipped
    end_s : everything after this time, counted from the first message, is skipped
    every : only every N-th scan is used
    rate_hz : scan rate of a folder of clouds whose files are not named by their stamps; 0 where they are
    bin_columns : number of float32 columns of a cloud in a .bin file, x y z first
    max_bad_scans_percent : share of scans that may be malformed or empty, rounded up; such scans are left out
        and counted, and a run stops when there are more
    min_range_m : returns nearer than this are dropped by the reader and counted
    max_range_m : returns farther than this are dropped by the reader and counted
    point_times : unit of the per-point times, or ``none``; ``clockwise`` or ``counterclockwise`` time the points
        of a spinning lidar by azimuth, ``azimuth`` in the direction that fits better; ``auto`` does so where
        clouds have no times and the scans clearly support it
    revolution_s : duration of a revolution, for points timed by azimuth
    revolution_start_rad : azimuth at which a revolution begins, at the stamp; π is the rear
    """

    format: str = "auto"
    topic: str = ""
    odometry_topic: str = ""
    ground_truth_topic: str = "/ground_truth"
    imu_topic: str = ""
    gnss_topic: str = ""
    lidar_pose: str = ""
    other_lidar_poses: str = ""
    elevation_offset_rad: Number = 0.0
    range_offset_m: Number = 0.0
    imu_rotation: str = ""
    imu_delay_s: Number = 0.0
    odometry_delay_s: Number = 0.0
    odometry_scale: Positive = 1.0
    odometry_turn_scale: Positive = 1.0
    upside_down: bool = False
    start_s: NonNegative = 0.0
    end_s: Limit = float("inf")
    every: Count = 1
    rate_hz: NonNegative = 0.0
    bin_columns: Annotated[int, Meta(ge=3, le=16)] = 4
    max_bad_scans_percent: Percent = 10.0
    min_range_m: NonNegative = 0.0
    max_range_m: Limit = float("inf")
    point_times: Literal["auto", "none", "s", "ms", "us", "ns", "azimuth", "clockwise", "counterclockwise"] = (
        "auto"
    )
    revolution_s: Positive = 0.1
    revolution_start_rad: Number = 3.141592653589793


class PreprocessConfig(Section, frozen=True, forbid_unknown_fields=True):
    """Preparation of a scan for matching: cropping, downsampling, deskewing.

    min_range_m : returns nearer than this are not used
    max_range_m : returns farther than this are not used
    deskew : whether the motion of the lidar during a scan is removed, where its points have times
    calibrate_elevation : whether a constant error of the lidar's vertical angles is estimated as it moves, through
        the whole log, and corrected
    map_voxel_m : voxel size to which scans are downsampled before they are inserted into the local map
    match_voxel_m : largest voxel size to which scans are downsampled before they are matched
    match_points : number of points to match; the voxels of matching shrink, down to those of the map, until
        about that many remain
    min_scale : smallest factor by which voxels shrink in narrow surroundings; 1 keeps their size fixed
    """

    min_range_m: NonNegative = 0.5
    max_range_m: Limit = 100.0
    deskew: bool = True
    calibrate_elevation: bool = True
    map_voxel_m: Positive = 0.5
    match_voxel_m: Positive = 1.5
    match_points: Count = 2500
    min_scale: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.125


class LocalMapConfig(Section, frozen=True, forbid_unknown_fields=True):
    """The voxel map that scans are matched against.

    voxel_size_m : edge length of its voxels
    max_distance_m : voxels farther than this from the lidar are removed
    max_insertions : voxels that none of this many last insertions has touched are removed
    insert_distance_m : a scan is inserted once the lidar has moved this far since the last insertion; 0
        inserts every scan
    insert_angle_rad : a scan is inserted once the lidar has turned this far; 0 inserts every scan
    """

    voxel_size_m: Positive = 1.0
    max_distance_m: Limit = 100.0
    max_insertions: Count = 1000
    insert_distance_m: NonNegative = 0.0
    insert_angle_rad: NonNegative = 0.0


class MatchingConfig(Section, frozen=True, forbid_unknown_fields=True):
    """Scan-to-map alignment; the first scans, and those after a loss, are matched with the ``wide_`` limits.

    matcher : ``plicp``: point-to-plane or point-to-line by Levenberg-Marquardt; ``svd``: point-to-point in
        closed form
    optimizer : method of the nonlinear least squares of ``plicp``
    max_iterations : limit of the iterations of one alignment
    max_distance_m : largest distance of a correspondence; it shrinks with the voxels
    kernel_scale_m : scale of the Geman-McClure kernel on the residuals
    wide_max_distance_m : ``max_distance_m`` of a wide search
    wide_kernel_scale_m : scale at which the kernel of a wide search begins, before it narrows to
        ``kernel_scale_m``
    tolerance_m : translation of a step below which an alignment has converged
    tolerance_rad : rotation of a step below which an alignment has converged
    sensor_noise_m : least standard deviation of a range, which scales information and covariance; a larger one
        measured on the first scans replaces it, and enlarges voxels and kernel
    min_inlier_share : share of the points with a correspondence below which a scan is lost
    min_information : information per inlier, 0 to 1, below which a direction is degenerate
    min_signal : signal-to-noise ratio of the information below which a direction is degenerate,
        where noise is the information that errors of the map's normals alone would induce
    """

    matcher: Matcher = "plicp"
    optimizer: Optimizer = "levenberg-marquardt"
    max_iterations: Count = 50
    max_distance_m: Positive = 2.0
    kernel_scale_m: Positive = 0.2
    wide_max_distance_m: Positive = 3.0
    wide_kernel_scale_m: Positive = 2.0
    tolerance_m: Positive = 1e-3
    tolerance_rad: Positive = 1e-4
    sensor_noise_m: Positive = 0.03
    min_inlier_share: Share = 0.3
    min_information: NonNegative = 1e-6
    min_signal: NonNegative = 3.0


class OdometryConfig(Section, frozen=True, forbid_unknown_fields=True):
    """Motion prediction, search width after a failed match, and spacing of keyframes.

    prior : motion prediction: by wheel odometry, at constant velocity, or by the wheels where the log has them
    imu : whether an IMU is used, where it predicts motions better than the scans do
    wheel_sigma_m : largest standard deviation of a translation predicted by the wheels; the usual one is
        estimated while running
    wheel_sigma_rad : the same for a rotation
    velocity_sigma_m : largest standard deviation of a translation predicted at constant velocity; the usual
        one is estimated while running
    velocity_sigma_rad : the same for a rotation
    max_speed_m_s : speed of the robot, which limits how far a planar scan that matched badly is searched for,
        and any scan after a gap
    max_turn_rad_s : turn rate of the robot, which limits the heading of searches in the plane and from above
    keyframe_distance_m : a keyframe is made once the lidar has moved this far since the last one
    keyframe_angle_rad : a keyframe is made once the lidar has turned this far
    edge_sigma_m : translational standard deviation added to that of an odometry edge of the pose graph
    edge_sigma_rad : rotational standard deviation added to that of an odometry edge
    """

    prior: Literal["auto", "wheel", "constant-velocity"] = "auto"
    imu: bool = True
    wheel_sigma_m: Positive = 0.05
    wheel_sigma_rad: Positive = 0.05
    velocity_sigma_m: Positive = 0.5
    velocity_sigma_rad: Positive = 0.2
    max_speed_m_s: Positive = 1.5
    max_turn_rad_s: Positive = 2.0
    keyframe_distance_m: Positive = 2.0
    keyframe_angle_rad: Positive = 0.35
    edge_sigma_m: Positive = 0.02
    edge_sigma_rad: Positive = 0.002


class LoopsConfig(Section, frozen=True, forbid_unknown_fields=True):
    """Loop closing: proposal and verification of revisits.

    enabled : whether loops are closed
    drift : drift of the odometry in meters per meter, which sets the search radius along the shortest path of
        the graph
    min_radius_m : smallest search radius
    max_radius_m : largest search radius, and largest correction by one closure
    min_travel_m : shortest path between two keyframes that may close a loop
    min_overlap : smallest share of the points on surfaces of the submap with which a closure is accepted
    min_information : smallest information per inlier of the worst direction with which a closure is accepted
    edge_sigma_m : translational standard deviation added to that of a loop edge
    edge_sigma_rad : rotational standard deviation added to that of a loop edge
    recognizer : proposes places seen before, however far the map has drifted: "auto" ("outline", the
        upright structure of submaps, in 3D, none in the plane), "none", or ``module:Class`` of your own
    place_radius_m : radius of a submap that is recognized; it shrinks with the voxels
    refine : whether at the end every planar scan is aligned once more, to the map of all keyframes
    """

    enabled: bool = True
    drift: Positive = 0.03
    min_radius_m: Positive = 5.0
    max_radius_m: Positive = 30.0
    min_travel_m: Positive = 30.0
    min_overlap: Share = 0.6
    min_information: NonNegative = 0.01
    edge_sigma_m: Positive = 0.05
    edge_sigma_rad: Positive = 0.005
    recognizer: str = "auto"
    place_radius_m: Positive = 32.0
    refine: bool = True


class GraphConfig(Section, frozen=True, forbid_unknown_fields=True):
    """Pose graph optimization.

    optimizer : method of the nonlinear least squares
    max_iterations : limit of the iterations
    tolerance : relative change of χ², step length, and relative gradient below which it has converged
    robust : loss of loop edges; ``truncated`` also gives each of them a verdict, by graduated non-convexity
    robust_scale : normalized error above which the loss downweights an edge, in standard deviations
    gnss : use of the fixes of a GNSS receiver: ``constrain`` corrects drift of the trajectory that they show,
        ``datum`` only gives the result its place on Earth
    ground : prior that the vehicle moves in planes, where the lidar does not contradict it: ``auto`` in 3D logs
        with wheel odometry, ``on`` in others, too
    """

    optimizer: Literal["levenberg-marquardt", "gauss-newton", "gradient-descent"] = "levenberg-marquardt"
    max_iterations: Count = 50
    tolerance: Positive = 1e-6
    robust: Loss = "truncated"
    robust_scale: Positive = 3.0
    gnss: Literal["constrain", "datum"] = "constrain"
    ground: Literal["auto", "on", "off"] = "auto"


class MapsConfig(Section, frozen=True, forbid_unknown_fields=True):
    """The maps that are written at the end.

    voxel_size_m : edge length of the voxels of the point cloud, which has one point in each
    remove_moving : whether points that other scans saw through are removed
    write_pcd : whether the point cloud is also written as ``map.pcd``
    write_laz : whether the point cloud is also written as ``map.laz``
    grid_resolution_m : edge length of a cell of the occupancy grid
    grid_max_range_m : range up to which beams are traced into the occupancy grid
    slice_min_z_m : lower limit of the slice that the occupancy grid of a 3D log shows, relative to the lidar
    slice_max_z_m : upper limit of that slice
    """

    voxel_size_m: Positive = 0.2
    remove_moving: bool = True
    write_pcd: bool = False
    write_laz: bool = False
    grid_resolution_m: Positive = 0.2
    grid_max_range_m: Positive = 80.0
    slice_min_z_m: Number = -0.5
    slice_max_z_m: Number = 0.5


class RecordingConfig(Section, frozen=True, forbid_unknown_fields=True):
    """Contents of the rerun recording.

    local_map_every : keyframes between two recordings of the local map
    max_map_points : largest number of points recorded of the local map; that of the final map is no less
    """

    local_map_every: Count = 20
    max_map_points: Count = 20000


class OutputsConfig(Section, frozen=True, forbid_unknown_fields=True):
    """Optional files of a run directory.

    mcap : whether ``results.mcap`` is written: poses and maps as ROS 2 messages
    map : whether the folder ``map`` is written, which other logs are localized in and merged with
    error_bars : quick omits the systematic errors; full estimates them by running odometry once more without each
        of several groups of directions, on all of a short log or parts of a long one
    """

    mcap: bool = False
    map: bool = True
    error_bars: Literal["full", "quick"] = "full"


class Config(Struct, frozen=True, forbid_unknown_fields=True):
    """The whole tree; a module receives its own branch."""

    log: LogConfig = LogConfig()
    preprocess: PreprocessConfig = PreprocessConfig()
    local_map: LocalMapConfig = LocalMapConfig()
    matching: MatchingConfig = MatchingConfig()
    odometry: OdometryConfig = OdometryConfig()
    loops: LoopsConfig = LoopsConfig()
    graph: GraphConfig = GraphConfig()
    maps: MapsConfig = MapsConfig()
    recording: RecordingConfig = RecordingConfig()
    outputs: OutputsConfig = OutputsConfig()

    def __post_init__(self) -> None:
        """Raises InputError where a branch is of another kind."""
        for field in fields(Config):
            branch = getattr(self, field.name)
            if not isinstance(branch, field.type):
                raise InputError(
                    f"Config: {field.name} is {shown(branch)}; wanted a {field.type.__name__}, as in "
                    f"Config({field.name}={field.type.__name__}())"
                )
