"""The configuration: frozen structs; units in the keys, ranges in the types, unknown keys refused."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct
from msgspec.structs import fields, force_setattr

from scanchain.config_keys import section_keys
from scanchain.errors import InputError, shown

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Percent = Annotated[float, Meta(ge=0.0, le=100.0)]
Count = Annotated[int, Meta(ge=1)]


Optimizer = Literal["levenberg-marquardt", "gauss-newton", "newton", "gradient-descent"]


class Section(Struct, frozen=True, forbid_unknown_fields=True):
    """A branch of the configuration; made in Python it is checked like one read from a file."""

    def __post_init__(self) -> None:
        """Convert what converts without loss. Raises InputError naming the key, its value and its limits."""
        for key in section_keys(type(self)):
            leaf = key.name.rpartition(".")[2]
            force_setattr(self, leaf, key.check(getattr(self, leaf), type(self).__name__))


class LogConfig(Section, frozen=True, forbid_unknown_fields=True):
    """What is read from the log. Empty topics are found automatically.

    Scans that are malformed or have no valid point are left out, counted and reported; a run stops when they are
    more than ``max_bad_scans_percent`` of all, rounded up: 0 allows none, anything above at least one.
    ``rate_hz`` is how often the scans of a folder come whose files are not named by their stamps.
    ``point_times`` is the unit of the per-point times, or the sense in which a lidar without any spins; it takes
    ``revolution_s`` for a turn that begins, at the stamp, at the azimuth ``revolution_start_rad`` (π is the rear).
    """

    topic: str = ""
    odometry_topic: str = ""
    ground_truth_topic: str = "/ground_truth"
    start_s: NonNegative = 0.0
    end_s: Positive = float("inf")
    every: Count = 1
    rate_hz: NonNegative = 0.0
    max_bad_scans_percent: Percent = 10.0
    min_range_m: NonNegative = 0.0
    max_range_m: Positive = float("inf")
    point_times: Literal["auto", "none", "s", "ms", "us", "ns", "clockwise", "counterclockwise"] = "auto"
    revolution_s: Positive = 0.1
    revolution_start_rad: float = 3.141592653589793
    prefetch_chunks: Count = 4


class PreprocessConfig(Section, frozen=True, forbid_unknown_fields=True):
    """What is done to a scan before it is matched: cropped, thinned out, freed of the lidar's own motion.

    Voxels are as large as said where the place is wide, and down to ``min_scale`` times that where it is narrow:
    the median range spans about ``range_voxels`` voxels of the local map, or more. Those of matching shrink
    further, to those of the map at the least, until about ``match_points`` are matched.
    """

    min_range_m: NonNegative = 0.5
    max_range_m: Positive = 100.0
    deskew: bool = True
    map_voxel_m: Positive = 0.5
    match_voxel_m: Positive = 1.5
    match_points: Count = 2500
    range_voxels: Positive = 14.0
    min_scale: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.125


class LocalMapConfig(Section, frozen=True, forbid_unknown_fields=True):
    """The map that scans are matched against."""

    voxel_size_m: Positive = 1.0
    max_distance_m: Positive = 100.0
    max_insertions: Count = 1000
    insert_distance_m: NonNegative = 0.0
    insert_angle_rad: NonNegative = 0.0
    min_points_alone: Count = 10


class MatchingConfig(Section, frozen=True, forbid_unknown_fields=True):
    """How a scan is aligned; the first scans, and those after a loss, search wide.

    A scan is degenerate where a direction has less than ``min_information``, a share of what all points together
    could tell of it, or where, in 3D, the points tell less than ``min_signal`` times what the errors of the map's
    normals alone would feign.
    """

    matcher: Literal["plicp", "svd"] = "plicp"
    optimizer: Optimizer = "levenberg-marquardt"
    max_iterations: Count = 50
    reach_voxels: Annotated[int, Meta(ge=1, le=8)] = 1
    max_distance_m: Positive = 2.0
    kernel_scale_m: Positive = 0.2
    wide_reach_voxels: Annotated[int, Meta(ge=1, le=8)] = 2
    wide_max_distance_m: Positive = 3.0
    wide_kernel_scale_m: Positive = 2.0
    tolerance_m: Positive = 1e-3
    tolerance_rad: Positive = 1e-4
    sensor_noise_m: Positive = 0.03
    min_inlier_share: Share = 0.3
    min_information: NonNegative = 1e-6
    min_signal: NonNegative = 3.0


class OdometryConfig(Section, frozen=True, forbid_unknown_fields=True):
    """How the motion is predicted, how far off the prediction may be, and when a keyframe is made.

    ``wheel_sigma`` and ``velocity_sigma`` are standard deviations of a prediction at the worst; how good it is as
    a rule is learned while running. ``max_speed`` and ``max_turn`` are how far a planar scan that fits badly is
    looked for, per second since the last one.
    """

    prior: Literal["auto", "wheel", "constant-velocity"] = "auto"
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
    """How revisits are found and verified.

    The search radius is what odometry may have drifted since the place was seen, ``drift`` meters a meter, at
    least ``min_radius_m`` and at most ``max_radius_m``.

    ``recognizer`` proposes places seen before, however far the map has drifted: "auto" (descriptors of submaps
    seen from above in 3D, none in the plane), "none", or a class of your own, ``module:Class``. Submaps reach
    ``place_radius_m`` around a keyframe where voxels have their full size; a closure is plausible within
    ``place_drift`` meters a meter of where odometry has it. In 3D, descriptors are similar from
    ``min_similarity`` on, and submaps are of one place if ``min_place_overlap`` of the points lie on surfaces,
    ``min_agreement`` of as many of those in sight do so as within either submap alone, and the match has
    ``min_place_information`` in every direction.

    In the plane ``refine`` aligns every scan once more, at the end, to the map of all keyframes.
    """

    enabled: bool = True
    drift: Positive = 0.03
    min_radius_m: Positive = 5.0
    max_radius_m: Positive = 30.0
    min_travel_m: Positive = 30.0
    submap_keyframes: Count = 5
    min_overlap: Share = 0.6
    min_information: NonNegative = 0.01
    edge_sigma_m: Positive = 0.05
    edge_sigma_rad: Positive = 0.005
    optimize_every: Count = 10
    recognizer: str = "auto"
    place_radius_m: Positive = 32.0
    place_drift: Positive = 0.1
    min_similarity: Share = 0.45
    min_place_overlap: Share = 0.4
    min_place_information: NonNegative = 0.005
    min_agreement: Share = 0.87
    refine: bool = True


class GraphConfig(Section, frozen=True, forbid_unknown_fields=True):
    """How the pose graph is optimized."""

    optimizer: Literal["levenberg-marquardt", "gauss-newton", "dogleg", "newton", "gradient-descent"] = (
        "levenberg-marquardt"
    )
    max_iterations: Count = 50
    tolerance: Positive = 1e-6
    robust: Literal["none", "huber", "cauchy", "geman-mcclure", "tukey", "truncated"] = "truncated"
    robust_scale: Positive = 3.0


class MapsConfig(Section, frozen=True, forbid_unknown_fields=True):
    """The maps that are written at the end.

    Without what ``remove_moving`` finds to have moved, the cloud has one point a voxel; it is written as PLY, and
    as PCD and LAZ where asked for.
    """

    voxel_size_m: Positive = 0.2
    remove_moving: bool = True
    write_pcd: bool = False
    write_laz: bool = False
    grid_resolution_m: Positive = 0.2
    grid_max_range_m: Positive = 80.0
    slice_min_z_m: float = -0.5
    slice_max_z_m: float = 0.5


class RecordingConfig(Section, frozen=True, forbid_unknown_fields=True):
    """What goes into the rerun recording."""

    local_map_every: Count = 20
    max_map_points: Count = 20000


class OutputsConfig(Section, frozen=True, forbid_unknown_fields=True):
    """What a run directory holds beside the files that are always there.

    ``mcap`` adds results.mcap, the poses and maps as ROS 2 messages.
    """

    mcap: bool = False


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
