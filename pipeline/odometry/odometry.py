"""Scan-to-map odometry: predict, match against the local map, extend it."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.clock import working_s
from scanchain.config import Config
from scanchain.data import Match, Points, Pose, RawPoints, Scan, State
from scanchain.errors import InputError, shown
from scanchain.kernels.geometry.validity import largest_magnitude
from scanchain.matching import CorrelativeMap, VoxelMap, create_matcher
from scanchain.odometry.prediction import Prediction, Predictor
from scanchain.odometry.tracked import Tracked, blurred, first_match, nothing_to_match, seen_from
from scanchain.preprocess import Resolution, Sweep
from scanchain.settings import check_order, load_settings

_WIDE_SCANS = 3  # searched wide at the start and after a loss, while no velocity is known
_PATIENCE = 5  # lost scans in a row before the map goes on from the prediction
_DOUBT = 2.0  # cost per point over its running mean, from which on other guesses are tried
_ELSEWHERE = 3.0  # the same, from which on a scan after a long gap has no place in the map
_ROUGH = 0.05  # share of the cost of a point without a partner, below which nothing is doubted
_RECENT = 20  # scans that a map with other voxels starts from
_MEMORY = 0.9  # of that running mean, per scan


class Odometry:
    """Scan-to-map odometry: one scan after another in, the pose of each out; keeps the local map."""

    def __init__(
        self, config: Config | None = None, T_base_lidar: Pose | None = None, *, dimension: int | None = None
    ) -> None:
        """Start before the first scan.

        config : the preset of the dimension where left out
        T_base_lidar : pose of the lidar on the robot, (3, 3) for laser scans, (4, 4) for clouds; it matters only
            where wheel odometry is given, the identity where left out
        dimension : 2 for laser scans, 3 for clouds; that of ``T_base_lidar``, or 3, where left out
        """
        config, T_base_lidar = checked_start(config, T_base_lidar, dimension)
        self.config = config
        self.dimension = T_base_lidar.shape[0] - 1
        self.predictor = Predictor(config.odometry, T_base_lidar)
        self.matcher = create_matcher(config.matching)
        self.local_map = VoxelMap(self.dimension, config.local_map)
        self.resolution = Resolution(config.preprocess, config.local_map.voxel_size_m)
        self.recent: deque[tuple[Points, Pose]] = deque(maxlen=_RECENT)
        self.T_odom_inserted = self.predictor.T_odom_lidar
        self.wide_scans = _WIDE_SCANS
        self.lost_scans = 0
        self.usual_cost = 0.0
        self.first_sweep = Sweep(np.empty((0, self.dimension)), np.empty(0), 0.0)
        self.first_points = self.first_sweep.points  # as seen from its stamp, once the second scan is there
        self.scans = 0

    def track(
        self,
        points: RawPoints,
        stamp_s: float,
        times_s: NDArray[np.float32] | None = None,
        *,
        T_odom_base: Pose | None = None,
    ) -> Tracked:
        """Place a scan as a driver gives it; arguments as in ``Scan.of``."""
        return self.process(Scan.of(points, stamp_s, times_s, index=self.scans, T_odom_base=T_odom_base))

    def process(self, scan: Scan) -> Tracked:
        """Predict, correct by registration, extend the map. Raises InputError for a scan of another dimension."""
        checks.instance(
            scan, Scan, "scan", "Scan(index, stamp_ns, log_time_ns, points, times_s, dropped, T_odom_base)"
        )
        if scan.points.shape[1] != self.dimension:
            raise InputError(
                f"scan {scan.index} has {scan.points.shape[1]}D points; wanted (N, {self.dimension}), because "
                f"T_base_lidar is a pose of SE({self.dimension})"
            )
        self.scans += 1
        started = working_s()
        sweep, sparse = self.resolution.look(scan)
        if self.resolution.scale != self.local_map.scale:
            self._remake_map()
        if not len(sparse.points) and not len(self.local_map):
            raise InputError(
                f"scan {scan.index} has none of its {len(scan.points)} points between preprocess.min_range_m "
                f"({self.config.preprocess.min_range_m:g}) and preprocess.max_range_m "
                f"({self.config.preprocess.max_range_m:g}); widen them"
            )
        prepared = working_s()
        prediction = self.predictor.predict(scan)
        matched = sparse.from_middle(self.predictor.velocity)
        usual_cost, elsewhere_m = self.usual_cost, 0.0
        if not len(matched):
            match = nothing_to_match(prediction, self.config.preprocess)
            state, reason = State.LOST, match.reason
        elif len(self.local_map):
            match = self._align(scan, matched, prediction)
            if sparse.is_distorted and match.inlier_share >= self.config.matching.min_inlier_share:
                matched, match = self._deskewed(scan, sparse, match, prediction)
            state, reason = self._judge(match)
            if self.predictor.is_out_of_reach(scan) and self._fits_badly(match, state, usual_cost):
                elsewhere_m = self.predictor.reach_m(scan)
                match, state = self._begin_anew(matched), State.OK
                reason = f"may be {elsewhere_m:.0f} m away after a time without scans: a new map begins"
        else:
            match = first_match(self.predictor.T_odom_lidar, matched, self.config.matching)
            state, reason = State.OK, match.reason
            self.first_sweep, self.first_points = sweep, sweep.points
        T_odom_middle = prediction.T_odom_lidar if state is State.LOST else match.T_target_source
        aligned = working_s()
        T_stamp_middle = self._from_middle_to_stamp(scan, sweep, T_odom_middle)
        self.predictor.correct(scan, prediction, match, state)
        points = sweep.from_middle(self.predictor.velocity)
        self._extend(points, T_odom_middle, state)
        tracked = Tracked(
            scan=scan,
            points=points,
            matched=matched,
            T_odom_lidar=T_odom_middle,
            match=match,
            state=state,
            reason=reason,
            preprocess_s=prepared - started,
            match_s=aligned - prepared,
            map_s=working_s() - aligned,
            elsewhere_m=elsewhere_m,
        )
        return tracked if T_stamp_middle is None else seen_from(tracked, T_stamp_middle)

    def _deskewed(self, scan: Scan, sparse: Sweep, match: Match, prediction: Prediction) -> tuple[Points, Match]:
        """Deskew once more with the velocity that the match tells, and align once more.

        The second scan tells the velocity of the first one too, which stands distorted in the map until then.
        """
        T_odom_middle = match.T_target_source
        velocity = self.predictor.velocity_at(scan, T_odom_middle)
        if self.predictor.is_new:
            T_moved = self._restart(velocity)
            T_odom_middle = T_moved @ T_odom_middle
            prediction = prediction.moved(T_moved)
        points = sparse.from_middle(velocity)
        match = self.matcher.align(points, self.local_map, T_odom_middle, prediction.prior)
        return points, blurred(
            match, self.predictor.deskewing_error(scan, match.T_target_source, sparse.duration_s)
        )

    def _restart(self, velocity: NDArray[np.float64]) -> Pose:
        """Make the map anew of the first scan, deskewed; returns the pose of its middle. Its stamp stays put."""
        T_odom_middle = lie.exp(self.first_sweep.middle_s * velocity)
        self.first_points = lie.transform(T_odom_middle, self.first_sweep.from_middle(velocity))
        self.recent.clear()
        self.recent.append((self.first_points, lie.identity(self.dimension)))
        self._remake_map()
        self.predictor.place(T_odom_middle)
        return T_odom_middle

    def _from_middle_to_stamp(self, scan: Scan, sweep: Sweep, T_odom_middle: Pose) -> Pose | None:
        """T_stamp_middle by the velocity from the last scan's middle to this one's; None where they are one.

        Scans are matched as seen from their middle; the stamp lies between two middles, or just beyond.
        """
        interval_s = self.predictor.intervals.to(scan)
        if sweep.middle_s == 0.0 or interval_s <= 0.0:
            return None
        motion = lie.between(self.predictor.T_odom_lidar, T_odom_middle)
        return lie.exp(sweep.middle_s / interval_s * lie.log(motion))

    def _align(self, scan: Scan, points: Points, prediction: Prediction) -> Match:
        """The alignment from the expected pose or, where that one is doubtful, the best from other guesses too."""
        wide = self.wide_scans > 0 or prediction.is_guess
        best = self.matcher.align(points, self.local_map, prediction.T_odom_lidar, prediction.prior, wide=wide)
        if self._is_doubtful(best.cost / len(points), prediction):
            for guess in self._guesses(scan, points, prediction):
                other = self.matcher.align(points, self.local_map, guess, wide=True)
                if self._cost(other, prediction) < self._cost(best, prediction):
                    best = other
        cost = best.cost / len(points)
        self.usual_cost = _MEMORY * self.usual_cost + (1.0 - _MEMORY) * cost if self.usual_cost else cost
        return best

    def _fits_badly(self, match: Match, state: State, usual_cost: float) -> bool:
        """Whether a scan that may be anywhere is not where it was found."""
        least = _ROUGH * 0.5 * self.config.matching.kernel_scale_m**2
        return state is State.LOST or match.cost / match.points > max(_ELSEWHERE * usual_cost, least)

    def _begin_anew(self, points: Points) -> Match:
        """Forget the map, in which there is no place for the scan; a new one begins where the last scan was."""
        self.local_map = VoxelMap(self.dimension, self.config.local_map, self.resolution.scale)
        self.recent.clear()
        self.usual_cost = 0.0
        return first_match(self.predictor.T_odom_lidar, points, self.config.matching)

    def _cost(self, match: Match, prediction: Prediction) -> float:
        """What speaks against a match, m²: its own cost, and how far from the expected pose it is."""
        prior = prediction.prior
        away = lie.log(lie.between(prior.T_target_source, match.T_target_source)) / prior.widest
        return match.cost + 0.5 * self.config.matching.sensor_noise_m**2 * float(away @ away)

    def _is_doubtful(self, cost: float, prediction: Prediction) -> bool:
        """Whether the cost per point is far above what it used to be, and a share of the most it could be."""
        if not self.usual_cost:
            return False
        if prediction.is_guess:
            return cost > self.usual_cost
        return cost > max(_DOUBT * self.usual_cost, _ROUGH * 0.5 * self.config.matching.kernel_scale_m**2)

    def _guesses(self, scan: Scan, points: Points, prediction: Prediction) -> tuple[Pose, ...]:
        """Other poses to start from; in the plane also the best of a window around the expected one."""
        alternatives = self.predictor.alternatives(scan)
        if self.dimension == 3:
            return alternatives
        half_width_m, half_width_rad = self.predictor.window(scan)
        reach_m = float(np.abs(points).max()) * math.sqrt(2.0) + half_width_m
        T_expected = prediction.T_odom_lidar
        seed = CorrelativeMap(self.local_map, T_expected, reach_m).best(
            points, T_expected, half_width_m=half_width_m, half_width_rad=half_width_rad
        )
        return (*alternatives, seed.T_target_source)

    def _judge(self, match: Match) -> tuple[State, str]:
        config = self.config.matching
        if match.inlier_share < config.min_inlier_share or not math.isfinite(
            largest_magnitude(match.T_target_source)
        ):
            return State.LOST, match.reason
        return State.DEGENERATE if match.observability < 1.0 else State.OK, match.reason

    def _extend(self, points: Points, T_odom_lidar: Pose, state: State) -> None:
        """Insert the scan where it is known well and brings something new."""
        if state is State.LOST:
            self.lost_scans += 1
            self.wide_scans = _WIDE_SCANS
            if self.lost_scans < _PATIENCE:
                return
        else:
            self.lost_scans = 0
            self.wide_scans -= self.wide_scans > 0
        if len(self.local_map) and not self._moved_enough(T_odom_lidar) and state is not State.LOST:
            return
        self.local_map.insert(points, T_odom_lidar)
        self.recent.append((points, T_odom_lidar))
        self.T_odom_inserted = T_odom_lidar

    def _remake_map(self) -> None:
        """Make the map anew of the last scans, with voxels of the present size."""
        self.local_map = VoxelMap(self.dimension, self.config.local_map, self.resolution.scale)
        for points, T_odom_lidar in self.recent:
            self.local_map.insert(points, T_odom_lidar)

    def _moved_enough(self, T_odom_lidar: Pose) -> bool:
        config = self.config.local_map
        distance_m, angle_rad = lie.apart(self.T_odom_inserted, T_odom_lidar)
        return distance_m >= config.insert_distance_m or angle_rad >= config.insert_angle_rad


def checked_start(config: Config | None, T_base_lidar: Pose | None, dimension: int | None) -> tuple[Config, Pose]:
    """Configuration and mounting, the ones that are left out filled in.

    Raises InputError where they are none, or contradict each other or themselves.
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
    checks.instance(config, Config, "config", "load_settings(dimension).config")
    check_order(config)
    return config, T_base_lidar
