"""The records that pass between the stages; frozen, and nobody writes into their arrays.

A pose is a homogeneous matrix: (3, 3) for SE(2) in a 2D log, (4, 4) for SE(3) in a 3D log. ``T_a_b`` maps
coordinates in frame b to frame a. The dimension d of a log is 2 or 3; a twist has k = 3 or 6 entries, ordered
(translation, rotation). Time is ``int`` nanoseconds, lengths are meters, angles radians.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sized
from dataclasses import dataclass, field, replace
from enum import StrEnum
from io import StringIO
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain.errors import FREEDOM, InputError, counted

Pose = NDArray[np.float64]
Points = NDArray[np.float64]
RawPoints = NDArray[np.float32]
AnyPoints = NDArray[np.floating]  # as arguments, converted where they enter
Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

_set = object.__setattr__  # sets a field of a frozen record that checks itself

GRAVITY_M_S2, _UNIT = 9.81, 1.3  # and largest ratio of it and the specific force at rest
BRIDGED_S = 0.15  # longest time between two samples of an IMU in use
LEAST_FIT = 0.6  # of ``Match.fit``: on real logs it is above 0.8 at true poses and below 0.5 at wrong ones
GAP_INTERVALS = 2.5  # time between scans, in usual intervals, above which scans are missing
SIMILAR_INTERVALS = 1.4  # largest ratio of two intervals between scans that agree: stamps jitter
FEWEST_COPIED = 10  # least number of points of a scan that counts as a copy: fewer can be equal by chance
MOST_COPIES = 5  # largest number of identical scans in a row that a driver that publishes too often produces

_WHOLE = (
    ("index", "the number of the scan, from 0, or -1", -1),
    ("stamp_ns", "nanoseconds as int; of seconds int(1e9 * stamp_s)", None),
    ("log_time_ns", "nanoseconds as int; of seconds int(1e9 * time_s)", None),
    ("dropped", "a number of returns, from 0", 0),
)


def brief(self: object) -> str:
    """A record on one line, for its ``repr``: arrays by their shape, long values by their type and length."""
    names = getattr(self, "__dataclass_fields__", ()) or getattr(self, "__struct_fields__", ())
    values = ((name, getattr(self, name)) for name in names)
    return f"{type(self).__name__}({', '.join(f'{name}={_brief(value)}' for name, value in values)})"


def _brief(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"<{' × '.join(map(str, value.shape))}>"
    text = f"{value:.6g}" if isinstance(value, float) else repr(value)
    size = f" of {len(value):,}" if isinstance(value, Sized) else ""
    return text if len(text) <= 60 else f"<{type(value).__name__}{size}>"


class OtherPoints(NamedTuple):
    """Points (N, d) of another lidar in the frame of a scan, and where it is in that frame.

    times_s : (N,) seconds after the scan's stamp
    origin : (d,) meters
    moves_middle : whether the middle of the scan, where it is aligned, is that of these points too
    """

    points: RawPoints
    times_s: NDArray[np.float32]
    origin: Vector
    moves_middle: bool = True


class RaySpan(NamedTuple):
    """Consecutive points of a scan that one lidar measured: a number of rays from its ``origin`` (d,), meters."""

    origin: Vector
    rays: int

    @staticmethod
    def among(spans: tuple[RaySpan, ...], chosen: NDArray[np.integer]) -> tuple[RaySpan, ...]:
        """The spans of chosen points, whose numbers (M,) ascend."""
        if not spans:
            return spans
        ends = np.searchsorted(chosen, np.cumsum([span.rays for span in spans]))
        rays = np.diff(ends, prepend=0).tolist()
        return tuple(RaySpan(span.origin, count) for span, count in zip(spans, rays, strict=True))


def unit_of(force: float) -> float:
    """Unit in m/s² of accelerations of this size at rest: 1, or 9.81 if they are in g; 0 if gravity is missing."""
    units = (unit for unit in (1.0, GRAVITY_M_S2) if 1.0 / _UNIT < force * unit / GRAVITY_M_S2 < _UNIT)
    return next(units, 0.0)


class Inertial(NamedTuple):
    """Samples of an IMU from the scan before to the end of a scan.

    stamps_ns : (M,) ascending, by the clock of the scans
    rates : (M, 3) rad/s
    accelerations : (M, 3) m/s², at rest 9.8 upwards
    T_lidar_imu : (4, 4) pose of the IMU in the lidar's frame; None where it is unknown
    """

    stamps_ns: Integers
    rates: Matrix
    accelerations: Matrix
    T_lidar_imu: Pose | None = None

    def checked(self) -> Inertial:
        """The same, converted if nothing is lost. Raises InputError for any other shape, dtype or value."""
        from scanchain import checks

        stamps_ns = checks.whole_numbers(self.stamps_ns, "inertial.stamps_ns", "nanoseconds")
        if not (np.diff(stamps_ns) > 0).all():
            raise InputError("inertial.stamps_ns do not ascend")
        rates, accelerations = (
            checks.matrices(getattr(self, name), f"inertial.{name}", (len(stamps_ns), 3))
            for name in ("rates", "accelerations")
        )
        T = self.T_lidar_imu
        T = None if T is None else checks.pose(T, "inertial.T_lidar_imu", 3)
        return Inertial(stamps_ns, rates, accelerations, T)


class RestForce(NamedTuple):
    """Specific force at rest by an accelerometer, along the axes of the lidar, in m/s².

    force, covariance : specific force (3,), its bias included, and covariance (3, 3)
    bias, bias_covariance : (3,) as far as it is known, and covariance (3, 3)
    """

    force: Vector
    covariance: Matrix
    bias: Vector
    bias_covariance: Matrix


class Fixes(NamedTuple):
    """Fixes of a GNSS receiver.

    stamps_ns : (M,) by the clock of the scans
    positions : (M, 3) latitude and longitude in degrees, altitude above the ellipsoid in m
    covariances : (M, 3, 3) of east, north and up, m²
    antenna_m : (3,) position of the antenna in the frame of the lidar; None where it is unknown
    """

    stamps_ns: Integers
    positions: Matrix
    covariances: Matrix
    antenna_m: Vector | None = None

    def checked(self) -> Fixes:
        """The same, converted if nothing is lost. Raises InputError for any other shape, dtype or value."""
        from scanchain import checks

        stamps_ns = checks.whole_numbers(self.stamps_ns, "fixes.stamps_ns", "nanoseconds")
        positions = checks.matrices(self.positions, "fixes.positions", (len(stamps_ns), 3))
        covariances = checks.matrices(self.covariances, "fixes.covariances", (len(stamps_ns), 3, 3))
        if len(stamps_ns) and not np.linalg.eigvalsh(covariances)[:, 0].min() > 0.0:
            raise InputError("fixes.covariances are not positive definite")
        antenna = self.antenna_m
        antenna = None if antenna is None else checks.matrices(antenna, "fixes.antenna_m", (3,))
        return Fixes(stamps_ns, positions, covariances, antenna)


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan as the log holds it, invalid returns removed.

    index : position of the scan in the order of log time, from 0; −1 of ``Scan.of``: it is numbered when processed
    stamp_ns : header stamp; the instant at which the scan's pose holds
    log_time_ns : when it was recorded; scans are processed in this order
    points : (N, d) float32, meters, lidar frame
    times_s : (N,) float32, seconds of each point relative to ``stamp_ns``; (0,) where the log has none
    dropped : returns removed because they were NaN, infinite or out of range
    T_odom_base : pose of the robot in the wheel-odometry frame at ``stamp_ns``; None where the log has none
    waited_s : seconds that the reader of the log made its consumer wait for this scan
    is_copy : whether its points are bitwise equal to those of the previous scan in the log
    clock_jump_s : jump of the stamp since the previous scan for which no time passed; usually 0
    others : points of other lidars that publish on the topic, measured just before; usually none
    origin : (d,) meters, where the lidar is in the frame of its points; None where it is the origin of that frame
    inertial : samples of an IMU; None where the log has none
    fixes : of a GNSS receiver, since the scan before; None where there are none

    Arrays are converted if nothing is lost; any other shape, dtype or value raises InputError.
    """

    __repr__ = brief
    index: int
    stamp_ns: int
    log_time_ns: int
    points: RawPoints
    times_s: NDArray[np.float32]
    dropped: int
    T_odom_base: Pose | None
    waited_s: float = 0.0
    is_copy: bool = False
    clock_jump_s: float = 0.0
    others: tuple[OtherPoints, ...] = ()
    origin: Vector | None = None
    inertial: Inertial | None = None
    fixes: Fixes | None = None

    def __post_init__(self) -> None:
        """Check and convert; the class is frozen, so that the checks stay valid."""
        from scanchain import checks  # imports compiled kernels, which --help does not need

        for name, wanted, least in _WHOLE:
            _set(self, name, checks.integer(getattr(self, name), name, wanted, least=least))
        d = checks.dimension_of(self.points, "points")
        points = checks.points(self.points, "points", d, dtype=np.float32)
        _set(self, "points", points)
        _set(self, "times_s", checks.point_times(self.times_s, "times_s", len(points)))
        if self.origin is not None:
            _set(self, "origin", checks.matrices(self.origin, "origin", (d,)))
        if self.inertial is not None:
            wanted = "Inertial(stamps_ns, rates, accelerations, T_lidar_imu)"
            checks.instance(self.inertial, Inertial, "inertial", wanted)
            _set(self, "inertial", self.inertial.checked())
        if self.fixes is not None:
            checks.instance(self.fixes, Fixes, "fixes", "Fixes(stamps_ns, positions, covariances, antenna_m)")
            _set(self, "fixes", self.fixes.checked())
        if self.T_odom_base is not None:
            _set(self, "T_odom_base", checks.pose(self.T_odom_base, "T_odom_base", d))

    @classmethod
    def of(
        cls,
        points: AnyPoints,
        stamp_s: float,
        times_s: NDArray[np.floating] | None = None,
        *,
        index: int = -1,
        T_odom_base: Pose | None = None,
        inertial: Inertial | None = None,
        fixes: Fixes | None = None,
    ) -> Scan:
        """A scan as a driver gives it.

        points : (N, d) meters, lidar frame; rows that are not finite are invalid returns, counted in ``dropped``
        stamp_s : seconds since any fixed instant; the pose holds then
        times_s : (N,) seconds of each point relative to ``stamp_s``, for deskewing; none where left out
        index : if it is left out, odometry numbers the scan, and checks its stamp against the last ones
        T_odom_base : pose of the robot by its wheels at ``stamp_s``
        inertial : samples of an IMU since the scan before
        fixes : of a GNSS receiver since the scan before
        """
        from scanchain import checks

        stamp_ns = round(1e9 * checks.seconds(stamp_s, "stamp_s"))
        valid, is_valid = checks.valid_points(points, "points", dtype=np.float32)
        seconds = checks.point_times(times_s, "times_s", len(is_valid))
        seconds = seconds[is_valid] if len(seconds) else seconds
        dropped = len(is_valid) - len(valid)
        sensors = {"inertial": inertial, "fixes": fixes}
        return cls(index, stamp_ns, stamp_ns, valid, seconds, dropped, T_odom_base, **sensors)


class State(StrEnum):
    """Reliability of a pose."""

    OK = "ok"
    CONTRADICTED = "contradicted"
    DEGENERATE = "degenerate"
    LOST = "lost"


class Prior(NamedTuple):
    """Prior of a pose before it is matched; a tuple, which compiled code takes as it is.

    T_target_source : (d+1, d+1) the expected pose
    covariance : (k, k) of a twist ξ in the source's own frame, T exp(ξ); m², rad m, rad²
    widest : (k,) standard deviations that hold in every case, for example when the vehicle brakes
    is_measured : True where another sensor measured the motion, False where it is extrapolated
    """

    T_target_source: Pose
    covariance: Matrix
    widest: NDArray[np.float64]
    is_measured: bool = False

    @property
    def information(self) -> Matrix:
        """(k, k) inverse covariance."""
        return np.linalg.inv(self.covariance).astype(np.float64, copy=False)


@dataclass(frozen=True, slots=True)
class Match:
    """Result of a registration.

    T_target_source : (d+1, d+1) pose of the source in the target's frame
    information : (k, k) inverse covariance of a twist ξ in the source's own frame, T exp(ξ), as a pose-graph
        edge takes it; m⁻², rad⁻¹m⁻¹, rad⁻²
    cost : robust cost in m², each point without correspondence counted at the kernel's limit; compares two
        alignments of the same scan to the same map
    inliers : source points with a correspondence within ``matching.max_distance_m``, also after a wide search
    points : number of source points
    iterations : linearizations used
    residual_m : root of the weighted mean squared residual over the inliers
    fit : share of the information that the robust kernel leaves to the direction that loses most: near 1 where the
        correspondences agree with the pose, below 0.6 where those that determine a direction contradict it
    at_minimum : whether the last step was below the tolerance
    converged : whether the pose is a minimum that the points fit (``inlier_share`` and ``fit``) and that is
        observable in every direction (``observability``)
    reason : why it did not converge, in words
    degeneracy_eigenvalue : smallest eigenvalue of the information per inlier, lengths scaled so that
        translation and rotation compare; 0 is unobservable, 1 is a direction that every residual constrains
    observability : of the worst direction, ratio of its information to the least that ``matching.min_information``
        and ``matching.min_signal`` require; below 1 the scan is degenerate
    degeneracy_direction : (k,) unit eigenvector of the worst direction, twist order, source's frame, or empty
    cause : the reason without its figures, the same for all of its kind
    variance_factor : ratio of ``covariance`` to the inverse of ``information``, at most 1: in the plane the latter
        assumes ``matching.sensor_noise_m`` where residuals are smaller
    systematic : (k, k) covariance in the source's own frame of errors that poses aligned to the same map have in
        common, by the disagreement of eight sectors of the scan; (0, 0) from a matcher without an estimate
    """

    __repr__ = brief
    T_target_source: Pose
    information: Matrix
    cost: float
    inliers: int
    points: int
    iterations: int = 1
    residual_m: float = math.nan
    fit: float = 1.0
    at_minimum: bool = True
    converged: bool = True
    reason: str = "converged"
    degeneracy_eigenvalue: float = 1.0
    observability: float = 1.0
    degeneracy_direction: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    cause: str = ""
    variance_factor: float = 1.0
    systematic: Matrix = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def covariance(self) -> Matrix:
        """(k, k) of a twist in the source's own frame, by the residuals; infinite where these leave it open."""
        return np.asarray(self.variance_factor * np.linalg.pinv(self.information, hermitian=True), np.float64)

    @property
    def inlier_share(self) -> float:
        """Share of the source points that have a correspondence."""
        return self.inliers / max(self.points, 1)

    @property
    def is_fit(self) -> bool:
        """True if the pose is a minimum that the correspondences agree with, observable everywhere or not."""
        return self.at_minimum and self.fit >= LEAST_FIT


@dataclass(frozen=True, slots=True)
class Influence:
    """Changes of motions when each of G groups of directions is left out: twists in the later scan's frame.

    of_keyframes : (G, K−1, k) from each keyframe to the next
    of_scans : (G, N, k) from the last keyframe to each scan
    is_measured : (N,) whether both were measured; other motions are extrapolated
    kinds : (G,) kind of each group: 0 for azimuths, 1 for elevations
    """

    of_keyframes: Matrix
    of_scans: Matrix
    is_measured: NDArray[np.bool_]
    kinds: NDArray[np.int64]


class KeyframeErrors(NamedTuple):
    """Errors of a keyframe's pose relative to the map, and of the map since the previous keyframe.

    variance_factor : of the covariance by the residuals, as in ``Match``
    systematic : (k, k) covariance of a twist in the lidar's own frame, by the disagreement of sectors of the scans
    renewal : share of the map in the lidar's view that is new since the previous keyframe, 0 to 1
    """

    variance_factor: float
    systematic: Matrix
    renewal: float


class KeyframePoints(Protocol):
    """Points of a keyframe that lie on disk."""

    @property
    def spans(self) -> tuple[RaySpan, ...]:
        """Origins of their rays; () where all start at the origin of the keyframe's frame."""
        ...

    def read(self) -> Points:
        """(M, d) meters."""
        ...


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A scan that is a node of the pose graph.

    index : its number in the graph
    scan_index, stamp_ns : the scan it was made of
    stored : its points, which ``points`` reads
    T_odom_lidar : pose in the odometry frame
    traveled_m : length of the path up to it, by odometry
    scale : factor on the voxel sizes that odometry used there, 1 for those of the configuration; without that of
        dense scans, so that places seen by different lidars are comparable
    noise_m : standard deviation of its ranges where it is above ``matching.sensor_noise_m``, else 0
    """

    __repr__ = brief
    index: int
    scan_index: int
    stamp_ns: int
    stored: KeyframePoints
    T_odom_lidar: Pose
    traveled_m: float
    scale: float = 1.0
    noise_m: float = 0.0

    @property
    def points(self) -> Points:
        """(M, d) deskewed points, lidar frame; read from disk each time."""
        return self.stored.read()

    def views(self, T_frame_lidar: Pose) -> Iterator[tuple[Pose, Points]]:
        """The points by the lidar that measured them: pose of its origin in a frame, and points (M, d) from there.

        T_frame_lidar : pose of the keyframe in that frame
        """
        points, start = self.points, 0
        if not self.stored.spans:
            yield T_frame_lidar, points
        for origin, rays in self.stored.spans:
            T_frame_origin = T_frame_lidar.copy()
            T_frame_origin[:-1, -1] += T_frame_lidar[:-1, :-1] @ origin
            yield T_frame_origin, points[start : start + rays] - origin
            start += rays


class Problem(NamedTuple):
    """Why a match did not converge, or why a loop closure is rejected.

    ``cause`` is the same for all of its kind, ``text`` the whole reason with its figures.
    """

    cause: str
    text: str

    @classmethod
    def plain(cls, text: str) -> Problem:
        """A problem without figures."""
        return cls(text, text)


class ClosureVerdict(StrEnum):
    """Verdict on a proposed loop closure."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"


class Proposal(StrEnum):
    """Reason why a loop closure was tried."""

    POSITION = "position"
    PLACE = "place"


VERIFICATION, BACK_END = "verification", "back end"  # either may reject a closure


@dataclass(frozen=True, slots=True)
class Closure:
    """A proposed loop closure: the later keyframe ``source`` seen from the earlier ``target``.

    ``match.T_target_source`` is the pose of keyframe ``source`` in the frame of keyframe ``target``.
    ``overlap`` is the share of source points that lie on the target's surfaces after matching. ``cause`` is the
    reason without its figures, the same for all closures of its kind. ``chi2_before`` is its χ² in the graph as it
    was before it became an edge, NaN if it never did; ``weight`` and ``chi2_after`` are the final
    robust weight and χ² of the edge: 0 and NaN if there is none, 1 and NaN until it is optimized.
    """

    __repr__ = brief
    target: int
    source: int
    match: Match
    overlap: float
    verdict: ClosureVerdict
    reason: str
    proposed_by: Proposal = Proposal.POSITION
    chi2_before: float = float("nan")
    cause: str = ""
    weight: float = 0.0
    chi2_after: float = float("nan")

    @property
    def rejected_by(self) -> str:
        """Verification by matching, or the back end where it contradicts the graph; empty if accepted."""
        if self.verdict is ClosureVerdict.ACCEPTED:
            return ""
        return VERIFICATION if math.isnan(self.chi2_after) else BACK_END

    def rejected(self, problem: Problem) -> Closure:
        """The same closure, rejected."""
        return replace(self, verdict=ClosureVerdict.REJECTED, cause=problem.cause, reason=problem.text)


DOWNWEIGHTED = 0.5  # robust weight below which an edge is contradicted by the rest, rejected or not
REJECTED_WEIGHT = 1e-6  # robust weight below which an edge is not in force


@dataclass(frozen=True, slots=True)
class GraphState:
    """The pose graph after an optimization.

    poses : (K, d+1, d+1) T_world_lidar of every keyframe
    stamps_ns : (K,) int64
    edges : (E, 2) int64 keyframe pairs (i, j), loops last; i is −1 for a prior on a single keyframe
    is_loop : (E,) bool
    weight : (E,) robust weight in [0, 1] after the optimization; 1 for edges without a robust loss
    chi2 : Σ w eᵀΩe of the edges in force: all but the rejected ones
    edge_chi2 : (E,) eᵀΩe of each edge, without its robust weight
    degrees_of_freedom : number of measured values of the edges in force, minus that of the unknowns
    """

    __repr__ = brief
    poses: Matrix
    stamps_ns: NDArray[np.int64]
    edges: NDArray[np.int64]
    is_loop: NDArray[np.bool_]
    weight: NDArray[np.float64]
    chi2: float
    edge_chi2: NDArray[np.float64]
    degrees_of_freedom: int = 0

    @property
    def is_rejected(self) -> NDArray[np.bool_]:
        """Edges with a robust loss that contradict the rest and are not in force, (E,)."""
        return self.weight < REJECTED_WEIGHT

    @property
    def drawn_edges(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Edges (n, 2) between poses: those in force of successive ones, those of others, and rejected ones."""
        is_relative, is_rejected = self.edges[:, 0] >= 0, self.is_rejected
        skips = np.abs(self.edges[:, 0] - self.edges[:, 1]) != 1
        groups = (~skips & ~is_rejected, skips & ~is_rejected, is_rejected)
        chain, loops, rejected = (self.edges[group & is_relative] for group in groups)
        return chain, loops, rejected


def fit_text(chi2: float, degrees_of_freedom: int, rejected: str, *, has_loops: bool) -> str:
    """Fit of the edges in force as text: χ², its degrees of freedom, number of rejected edges.

    rejected : how many edges are not in force, in words; empty for none
    Loops that measure too little to leave degrees of freedom have a χ² all the same: see ``has_loops``.
    """
    left_out = rejected and f", {rejected}"
    if degrees_of_freedom == 0 and not has_loops:
        return f"no loops {'in force ' if rejected else ''}to check{left_out}"
    shown = f"{chi2:,.0f}" if 100.0 <= chi2 < 1e7 else f"{chi2:.3g}"
    return f"χ² {shown} over {counted(degrees_of_freedom, *FREEDOM)}{left_out}"


class Timing(msgspec.Struct, frozen=True):
    """Time of one scan by stage, seconds."""

    read_s: float
    preprocess_s: float
    match_s: float
    map_s: float
    loops_s: float


@dataclass(frozen=True, slots=True)
class Step:
    """Result of one scan.

    scan : the scan itself
    points : (M, d) float64 deskewed, downsampled points that were matched, lidar frame
    T_odom_lidar : pose before optimization: smooth, drifts
    T_world_lidar : current best estimate; jumps at closures
    match : the registration against the local map
    state, reason : reliability of the pose, and the reason if it is not ok
    keyframe : index of the keyframe made of this scan, -1 if none was
    local_map : (L, d) float64 points of the local map in the odom frame; filled on keyframes, else (0, d)
    closures : loop closures tried at this scan
    graph : the optimized graph if this scan led to an optimization, else None
    timing : seconds by stage
    starts_segment : True if its motion from the scan before is unknown
    innovations : normalized innovation of each other sensor that was compared with the match: the Mahalanobis
        distance over the square root of its degrees of freedom, about 1 if the covariances are right
    """

    __repr__ = brief
    scan: Scan
    points: Points
    T_odom_lidar: Pose
    T_world_lidar: Pose
    match: Match
    state: State
    reason: str
    keyframe: int
    local_map: Points
    closures: tuple[Closure, ...]
    graph: GraphState | None
    timing: Timing
    starts_segment: bool = False
    innovations: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time: ``stamps_ns`` (N,) int64 and ``poses`` (N, d+1, d+1), in the order they were taken."""

    stamps_ns: NDArray[np.int64]
    poses: Matrix

    def __post_init__(self) -> None:
        """Check and convert. Raises InputError where there is not one rigid pose for each stamp."""
        from scanchain import checks  # compiled, as above

        stamps, poses = checks.shape(self.stamps_ns, "stamps_ns"), checks.shape(self.poses, "poses")
        if len(stamps) != 1 or len(poses) != 3 or poses[1:] not in ((3, 3), (4, 4)) or poses[0] != stamps[0]:
            raise InputError(
                f"poses has the shape {poses}, stamps_ns {stamps}; wanted (N, 3, 3) or (N, 4, 4) and (N,)"
            )
        object.__setattr__(self, "stamps_ns", checks.whole_numbers(self.stamps_ns, "stamps_ns", "nanoseconds"))
        object.__setattr__(self, "poses", checks.poses(self.poses, "poses", poses[1] - 1))

    def __repr__(self) -> str:
        span_s = 1e-9 * float(np.ptp(self.stamps_ns)) if len(self) else 0.0
        return f"Trajectory({counted(len(self), 'pose')} of SE({self.dimension}) over {span_s:.1f} s)"

    @property
    def dimension(self) -> int:
        """2 for SE(2) poses, 3 for SE(3)."""
        return self.poses.shape[-1] - 1

    @property
    def positions(self) -> Points:
        """(N, d) meters."""
        return self.poses[:, :-1, -1]

    def to_dataframe(self) -> Any:
        """A pandas DataFrame: ``stamp_ns``, ``x_m`` …, then ``yaw_rad`` in the plane, ``qx`` … ``qw`` in space.

        Raises InputError where pandas is not installed.
        """
        try:
            from pandas import DataFrame
        except ImportError:
            raise InputError("pandas is not installed; install it with: pip install pandas") from None
        from scipy.spatial.transform import Rotation

        names, turned = "x_m y_m yaw_rad", np.arctan2(self.poses[:, 1:2, 0], self.poses[:, :1, 0])
        if self.dimension == 3:
            names = "x_m y_m z_m qx qy qz qw"
            turned = Rotation.from_matrix(self.poses[:, :3, :3]).as_quat(canonical=True)
        frame = DataFrame(np.hstack([self.positions, turned]), columns=names.split())
        frame.insert(0, "stamp_ns", self.stamps_ns)
        return frame

    def plot(self, axes: Any = None) -> Any:
        """Draw the path, seen from above, by matplotlib; returns the axes, new ones where left out."""
        if axes is None:
            from matplotlib import pyplot

            axes = pyplot.figure().add_subplot(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        axes.plot(*self.positions[:, :2].T)
        return axes

    def _repr_html_(self) -> str:
        """The path as SVG, which a notebook shows."""
        from matplotlib.figure import Figure

        figure, file = Figure(figsize=(5.0, 4.0), layout="constrained"), StringIO()
        self.plot(figure.add_subplot(xlabel="x [m]", ylabel="y [m]", aspect="equal", title=repr(self)))
        figure.savefig(file, format="svg")
        return file.getvalue()[file.getvalue().index("<svg") :]

    def __len__(self) -> int:
        return len(self.stamps_ns)
