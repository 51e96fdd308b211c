"""Scan-to-map odometry: predict, match against the local map, extend it."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.clock import working_s
from scanchain.config import Config, MatchingConfig
from scanchain.data import FEWEST_COPIED, LEAST_FIT, Match, Points, Pose, Prior, RaySpan, Scan, State, brief
from scanchain.errors import InputError, counted, shown
from scanchain.growing_array import read_only
from scanchain.kernels.geometry import largest_magnitude
from scanchain.odometry.elevation import ElevationCalibration
from scanchain.odometry.intervals import LiveStamps
from scanchain.odometry.prediction import Prediction, Predictor, Source
from scanchain.odometry.recovery import CLEARLY, Recovery, is_sound
from scanchain.odometry.standstill import Standstill
from scanchain.preprocess import Prepared, Resolution, ScanMotion, Sweep, prepare
from scanchain.registration import MapKeeper, VoxelMap, create_matcher
from scanchain.registration.align import as_ambiguous, with_source_frame
from scanchain.settings import check_dimension, check_order, load_settings

COPY = "bitwise copy of the previous scan: same pose, no information on the motion since"
NEW_MAP = "a new map begins"  # in the reason of a scan whose motion from the one before is unknown


class Tracked(msgspec.Struct, frozen=True):
    """A scan with its pose in the odometry frame.

    ``points`` (M, d) are all that went into the map, ``matched`` those that were aligned, both deskewed to the
    scan's stamp, at which ``T_odom_lidar`` holds, in the lidar frame; the seconds are the run times by stage.
    ``prior`` is that of this pose, its covariance that at the middle of the scan; ``gained`` as in ``Prediction``;
    ``elsewhere_m`` is how far away it may be where its motion is unknown, else 0;
    ``is_repeated`` if its points are those of the scan before;
    ``spans`` are the origins of the rays of ``points``, () where all start at that of the lidar frame;
    ``innovations`` as in ``Step``.
    """

    __repr__ = brief
    scan: Scan
    points: Points
    matched: Points
    T_odom_lidar: Pose
    match: Match
    state: State
    reason: str
    prior: Prior
    preprocess_s: float
    match_s: float
    map_s: float
    gained: NDArray[np.float64] | None = None
    elsewhere_m: float = 0.0
    is_repeated: bool = False
    spans: tuple[RaySpan, ...] = ()
    innovations: dict[str, float] = {}


class _Registered(msgspec.Struct, frozen=True):
    """The match of a scan, the points (N, d) that were aligned, deskewed to its middle, and the prediction.

    ``elsewhere_m`` as in ``Tracked``, ``rival`` the twist (k,) to another pose that fits nearly as well;
    ``is_standing`` if the lidar has not moved since the scan before.
    """

    points: Points
    match: Match
    state: State
    prediction: Prediction
    elsewhere_m: float = 0.0
    is_standing: bool = False
    rival: NDArray[np.float64] | None = None


class Odometry:
    """Scan-to-map odometry: scans in, one after another, their poses out."""

    def __init__(
        self, config: Config | None = None, T_base_lidar: Pose | None = None, *, dimension: int | None = None
    ) -> None:
        """Start before the first scan.

        config : the preset of the dimension where left out
        T_base_lidar : pose of the lidar on the robot, (3, 3) for laser scans, (4, 4) for clouds; it matters only
            where wheel odometry is given, and is estimated from that where left out
        dimension : 2 for laser scans, 3 for clouds; that of ``T_base_lidar``, or 3, where left out
        """
        is_mounted = T_base_lidar is not None
        config, T_base_lidar = checked_start(config, T_base_lidar, dimension)
        self.config = config
        self.dimension = T_base_lidar.shape[0] - 1
        self.resolution = Resolution(config.preprocess, config.local_map.voxel_size_m)
        self.predictor = Predictor(config.odometry, T_base_lidar, is_mounted=is_mounted)
        self.matcher = create_matcher(config.matching)
        self.recovery = Recovery(config.matching, self.matcher)
        self.standstill = Standstill(self.dimension)
        self.map = MapKeeper(self.dimension, config.local_map)
        is_wanted = self.dimension == 3 and config.preprocess.calibrate_elevation
        self.elevation = ElevationCalibration(is_wanted=is_wanted)
        self.calibrated_from = 0  # number of the first scan whose points are corrected; 0 for none
        self.first_sweep = Sweep(np.empty((0, self.dimension)), np.empty(0), 0.0)
        self.first_points = self.first_sweep.points  # deskewed to its stamp once the second one is there
        self.live_stamps = LiveStamps()
        self.scans = 0
        self.last: Tracked | None = None
        self.last_sample = b""  # of its raw points

    def __repr__(self) -> str:
        return f"{type(self).__name__}({counted(self.scans, f'{self.dimension}D scan')})"

    @property
    def noise_m(self) -> float:
        """Measured standard deviation of the ranges where it is above the one configured, else 0."""
        measured_m = self.resolution.noise.sigma_m
        return measured_m if measured_m > self.config.matching.sensor_noise_m else 0.0

    @property
    def local_map(self) -> VoxelMap:
        """The map that scans are aligned to, odom frame."""
        return self.map.surfaces

    def process(self, scan: Scan | Prepared) -> Tracked:
        """Predict, correct by registration, extend the map; a bitwise copy of the last scan changes nothing.

        Raises InputError, and ignores the scan, if it has another dimension; one of ``Scan.of`` also if its stamp
        is not after the last one, and if stamps or point times cannot be seconds.
        """
        given = scan.scan if isinstance(scan, Prepared) else scan
        self._check_dimension(given)
        if given.index >= 0:
            return self._tracked(scan)
        return self.live_stamps.passed(replace(given, index=self.scans), self._tracked)

    def _tracked(self, scan: Scan | Prepared) -> Tracked:
        prepared = scan if isinstance(scan, Prepared) else prepare(scan, self.resolution)
        scan, self.resolution = prepared.scan, prepared.after
        if self.config.odometry.imu:
            self.predictor.gyro.add(scan)
        self.scans += 1
        sample = scan.points[:: len(scan.points) // 1000 + 1].tobytes()  # at most 1000 points
        if self.last is not None and sample == self.last_sample and len(scan.points) >= FEWEST_COPIED:
            repeated = scan if scan.is_copy else replace(scan, is_copy=True)
            changed = {"reason": COPY, "is_repeated": True, "elsewhere_m": 0.0, "innovations": {}}
            return _owned(msgspec.structs.replace(self.last, scan=repeated, **changed))
        self.last_sample = sample
        self.last = self._placed(prepared)
        return _owned(self.last)

    def _placed(self, prepared: Prepared) -> Tracked:
        started, scan = working_s(), prepared.scan
        sweep, sparse = self.elevation.corrected(prepared.sweep), self.elevation.corrected(prepared.sparse)
        self.map.resize(self.resolution.scale, self.noise_m)
        began = working_s()
        prediction = self._predicted(scan, sparse)
        registered = self._register(scan, sweep, sparse, prediction)
        aligned = working_s()
        self.predictor.correct(scan, registered.prediction, registered.match, registered.state)
        points = sweep.from_middle(self.predictor.scan_motion)
        self._extend(points, registered)
        self._calibrate(points[: sweep.own], registered.state)
        match = registered.match if registered.rival is None else spread(registered.match, registered.rival)
        tracked = Tracked(
            scan=replace(scan, T_odom_base=None)
            if self.predictor.wheels.is_contradicted or scan.clock_jump_s
            else scan,
            points=points,
            matched=registered.points,
            T_odom_lidar=self.predictor.T_odom_lidar,
            match=match,
            state=_reported(registered),
            reason=match.reason,
            prior=prediction.prior,
            gained=prediction.gained,
            preprocess_s=prepared.seconds + began - started,
            match_s=aligned - began,
            map_s=working_s() - aligned,
            elsewhere_m=registered.elsewhere_m,
            spans=sweep.spans,
            innovations=self.predictor.innovations,
        )
        tracked = self._at_stamp(tracked, sweep, prediction)
        is_open = tracked.state is not State.OK
        self.predictor.wheels.update(tracked.scan, tracked.T_odom_lidar, tracked.match, is_open=is_open)
        return tracked

    def _predicted(self, scan: Scan, sparse: Sweep) -> Prediction:
        """The predicted pose; without wheel odometry where it jumps and the scan fits better without it.

        A wheel motion that no vehicle can make is rejected in any case. The scan does not count where most of the
        last ones were lost or contradicted.
        """
        prediction = self.predictor.predict(scan, sparse)
        if prediction.jump_m == 0.0 or not len(self.map.surfaces):
            return prediction
        free = self.predictor.predict(scan, sparse, by_wheels=False)
        is_wrong = lie.apart(prediction.T_odom_last, prediction.T_odom_lidar)[0] > free.farthest_m
        points = sparse.from_middle(free.scan_motion)
        if not is_wrong and len(points) and not self.predictor.doubts_scans:
            there, here = (
                self.matcher.align(points, self.local_map, each.T_odom_lidar, each.prior, wide=True)
                for each in (prediction, free)
            )
            is_wrong = is_sound(here) and here.cost < CLEARLY * there.cost
        if not is_wrong:
            return prediction
        self.predictor.wheels.reject(scan, prediction.jump_m)
        return free

    def _register(self, scan: Scan, sweep: Sweep, sparse: Sweep, prediction: Prediction) -> _Registered:
        """The match of a scan: aligned from the prediction, deskewed with the motion found, aligned again."""
        is_first = not len(self.map.surfaces)
        if is_first:
            self._check_range(scan, sparse)
        points = sparse.from_middle(prediction.scan_motion)
        if not len(points):
            match = nothing_to_match(prediction, self.config)
            return _Registered(points, match, State.LOST, prediction)
        if is_first:
            match = first_match(prediction.T_odom_last, points, self.config.matching)
            self.first_sweep, self.first_points = sweep, sweep.points
            return _Registered(points, match, State.OK, prediction)
        if scan.clock_jump_s:
            return self._reset_map(points, prediction, f"its stamp jumps by {scan.clock_jump_s:+.3g} s")
        usual_cost = self.recovery.usual_cost
        match, rival = self.recovery.align(points, sweep, self.local_map, prediction)
        is_placed = match.inlier_share >= self.config.matching.min_inlier_share
        may_stand = self.dimension == 3 and prediction.source is not Source.WHEELS
        if is_placed and may_stand and self.standstill.confirms(match):
            match = replace(match, T_target_source=self.standstill.T_odom_lidar)
            return _Registered(points, match, self._judge(match), prediction, is_standing=True)
        if sparse.is_distorted and is_placed:
            points, match, prediction = self._deskewed(sparse, match, prediction)
        state = self._judge(match)
        if not may_stand:
            self.standstill.end()
        elif state is not State.LOST:
            self.standstill.update(match)
        if prediction.is_out_of_reach and self.recovery.fits_badly(match, state, usual_cost):
            may_be = f"may be {prediction.reach_m:.0f} m away after a time without scans"
            return self._reset_map(points, prediction, may_be)
        return _Registered(points, match, state, prediction, rival=None if state is State.LOST else rival)

    def _deskewed(self, sparse: Sweep, match: Match, prediction: Prediction) -> tuple[Points, Match, Prediction]:
        """Deskew again with the motion by the match, and align again.

        The second scan also gives the velocity of the first one, which is distorted in the map until then.
        """
        T_odom_middle, prior = match.T_target_source, prediction.prior
        motion = prediction.scan_motion_by(lie.log(lie.between(prediction.T_odom_last, T_odom_middle)))
        if prediction.is_second:
            T_moved = motion.over(self.first_sweep.middle_s)  # the pose at its stamp stays the same
            self.first_points = lie.transform(T_moved, self.first_sweep.from_middle(motion))
            self.map.replace([(self.first_points, lie.identity(self.dimension))])
            T_odom_middle = T_moved @ T_odom_middle
            prior = prior._replace(T_target_source=T_moved @ prior.T_target_source)
            prediction = msgspec.structs.replace(prediction, T_odom_last=T_moved)
        points = sparse.from_middle(motion)
        match = self.matcher.align(points, self.local_map, T_odom_middle, prior)
        error = prediction.deskewing_error(match.T_target_source, sparse.duration_s)
        return points, blurred(match, error), prediction

    def _reset_map(self, points: Points, prediction: Prediction, why: str) -> _Registered:
        """Clear the map, which the scan does not fit; a new one begins at the pose of the last scan."""
        self.map.replace([])
        self.recovery.reset()
        self.elevation.reset()
        self.standstill.begin(prediction.T_odom_last)
        reason = f"{why}: {NEW_MAP}"
        match = first_match(prediction.T_odom_last, points, self.config.matching)
        match = replace(match, converged=False, reason=reason)
        return _Registered(points, match, State.OK, prediction, prediction.reach_m)

    def _judge(self, match: Match) -> State:
        is_placed = match.inlier_share >= self.config.matching.min_inlier_share
        if not is_placed or not math.isfinite(largest_magnitude(match.T_target_source)):
            return State.LOST
        return State.DEGENERATE if match.observability < 1.0 else State.OK

    def _extend(self, points: Points, registered: _Registered) -> None:
        """Insert a scan whose pose is known, or, after many lost scans, one at its predicted pose."""
        if self.recovery.needs_extension(registered.state):
            self.map.insert(points, self.predictor.T_odom_lidar)
        if registered.state is State.LOST:
            return
        if registered.is_standing or not self.standstill.is_standing:  # else biased by objects that move past
            self.map.extend(points, self.predictor.T_odom_lidar, is_standing=registered.is_standing)

    def _calibrate(self, points: Points, state: State) -> None:
        """Add the points of the scan's own lidar to the elevation calibration; rebuild the map if it changes."""
        if state is State.LOST:
            self.elevation.reset()
        if state is State.LOST or not self.predictor.scan_motion.twist.any():  # the first scan cannot be deskewed
            return
        corrected = self.elevation.update(points, self.predictor.T_odom_lidar)
        if corrected:
            self.calibrated_from = self.calibrated_from or self.scans
            self.map.replace(corrected)

    def _at_stamp(self, tracked: Tracked, sweep: Sweep, prediction: Prediction) -> Tracked:
        """A scan aligned in the frame of its middle, moved to the frame of its stamp.

        The stamp lies between two middles, or just beyond: the scan moves by the mean velocity between them. In
        rotation, unless a gyro measures it, this changes at the rate of the last two motions, with an error as
        large as the change; in translation the change would be noise.
        """
        if sweep.middle_s == 0.0 or prediction.lasted_s <= 0.0:
            return tracked
        motion, mean = self.predictor.scan_motion, lie.log(self.predictor.T_previous_current) / prediction.lasted_s
        change = (1.0 - sweep.middle_s / prediction.lasted_s) * (motion.twist - mean)
        change[: self.dimension] = 0.0
        if motion.turning is None:
            T_stamp_middle = lie.exp(sweep.middle_s * (mean + change))
        else:
            T_stamp_middle = lie.inverse(ScanMotion(mean, motion.turning).over(-sweep.middle_s))
            change[self.dimension :] = 0.0
        T_middle_stamp = lie.inverse(T_stamp_middle)
        return msgspec.structs.replace(
            tracked,
            points=lie.transform(T_stamp_middle, tracked.points),
            matched=lie.transform(T_stamp_middle, tracked.matched),
            T_odom_lidar=tracked.T_odom_lidar @ T_middle_stamp,
            match=with_source_frame(blurred(tracked.match, sweep.middle_s * change), T_stamp_middle),
            prior=tracked.prior._replace(T_target_source=tracked.prior.T_target_source @ T_middle_stamp),
        )

    def _check_dimension(self, scan: Scan) -> None:
        checks.instance(
            scan, Scan, "scan", "Scan(index, stamp_ns, log_time_ns, points, times_s, dropped, T_odom_base)"
        )
        if scan.points.shape[1] != self.dimension:
            raise InputError(
                f"scan {scan.index} has {scan.points.shape[1]}D points; wanted (N, {self.dimension}), because "
                f"T_base_lidar is a pose of SE({self.dimension})"
            )

    def _check_range(self, scan: Scan, sparse: Sweep) -> None:
        """Raise InputError for a first scan without a point between the minimum and maximum range."""
        if len(sparse.points):
            return
        if not len(scan.points):
            raise InputError(f"scan {scan.index}, the first one, has no points; begin with one that has some")
        raise InputError(
            f"scan {scan.index} has none of its {len(scan.points)} points between preprocess.min_range_m "
            f"({self.config.preprocess.min_range_m:g}) and preprocess.max_range_m "
            f"({self.config.preprocess.max_range_m:g}); give meters, or widen them"
        )


def _reported(registered: _Registered) -> State:
    """State of a scan as it is reported.

    LOST for the first scan of a new map, CONTRADICTED for a pose that its correspondences contradict, DEGENERATE
    for one of several poses that fit.
    """
    if registered.elsewhere_m > 0.0:
        return State.LOST
    if registered.state is not State.OK:
        return registered.state
    if registered.match.fit < LEAST_FIT:
        return State.CONTRADICTED
    return State.OK if registered.rival is None else State.DEGENERATE


def checked_start(config: Config | None, T_base_lidar: Pose | None, dimension: int | None) -> tuple[Config, Pose]:
    """Configuration and mounting, with defaults for those left out.

    Raises InputError where they are invalid or contradict each other.
    """
    if T_base_lidar is not None:
        d = 2 if checks.shape(T_base_lidar, "T_base_lidar") == (3, 3) else 3
        T_base_lidar = checks.pose(T_base_lidar, "T_base_lidar", d)
        if dimension not in (None, d):
            raise InputError(f"dimension is {shown(dimension)}, but T_base_lidar is a pose of SE({d})")
    else:
        T_base_lidar = lie.identity(3 if dimension is None else checks.dimension(dimension))
    if config is None:
        config = load_settings(len(T_base_lidar) - 1).config
    checks.instance(config, Config, "config", "load_settings(dimension).config, or dimension=2 or 3")
    check_order(config)
    check_dimension(config, len(T_base_lidar) - 1)
    return config, T_base_lidar


def _owned(tracked: Tracked) -> Tracked:
    """The same with poses copied and points read-only: writing into them changes no later pose."""
    match, prior = tracked.match, tracked.prior
    return msgspec.structs.replace(
        tracked,
        points=read_only(tracked.points),
        matched=read_only(tracked.matched),
        T_odom_lidar=tracked.T_odom_lidar.copy(),
        match=replace(match, T_target_source=match.T_target_source.copy(), information=match.information.copy()),
        prior=Prior(prior[0].copy(), prior[1].copy(), prior[2].copy(), prior.is_measured),
    )


def first_match(T_odom_lidar: Pose, points: Points, config: MatchingConfig) -> Match:
    """Match of the first scan, where there is no map yet: the frame starts at this scan."""
    k = lie.twist_size(T_odom_lidar)
    return Match(
        T_target_source=T_odom_lidar,
        information=np.diag(np.full(k, len(points) / config.sensor_noise_m**2)),
        cost=0.0,
        inliers=len(points),
        points=len(points),
        iterations=0,
        residual_m=0.0,
        fit=1.0,
        at_minimum=True,
        converged=True,
        reason="first scan: the frame starts here",
        degeneracy_eigenvalue=1.0,
        observability=np.inf,
        degeneracy_direction=np.eye(k)[0],
    )


def nothing_to_match(prediction: Prediction, config: Config) -> Match:
    """Match of a scan without points after preprocessing: the prediction."""
    limits = config.preprocess
    return replace(
        first_match(prediction.T_odom_lidar, np.empty((0, 0)), config.matching),
        information=prediction.prior.information,
        fit=0.0,
        at_minimum=False,
        converged=False,
        reason=f"no point lies between preprocess.min_range_m ({limits.min_range_m:g}) and "
        f"preprocess.max_range_m ({limits.max_range_m:g})",
        degeneracy_eigenvalue=0.0,
        observability=0.0,
    )


def blurred(match: Match, error: NDArray[np.float64]) -> Match:
    """The same match with an additional error (k,), one standard deviation, that the residuals do not show."""
    blur = np.diag(error**2)
    return replace(
        match, information=match.information @ np.linalg.inv(np.eye(len(blur)) + blur @ match.information)
    )


def spread(match: Match, rival: NDArray[np.float64]) -> Match:
    """The same match with a covariance that covers another pose, a twist (k,) away, that fits as well."""
    Omega_rival = match.information @ rival
    information = match.information - np.outer(Omega_rival, Omega_rival) / (1.0 + rival @ Omega_rival)
    T_rival = match.T_target_source @ lie.exp(rival)
    return as_ambiguous(replace(match, information=information), *lie.apart(match.T_target_source, T_rival))
