"""The predicted pose of a scan: by the wheels, at constant velocity, or where the last scan was."""

from __future__ import annotations

import math
from enum import StrEnum

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import OdometryConfig
from scanchain.data import LEAST_FIT, Match, Matrix, Pose, Prior, RestForce, Scan, State
from scanchain.kernels.geometry import largest_magnitude
from scanchain.kernels.matrices import definite_inverse
from scanchain.kernels.registration.observability import WEAK
from scanchain.odometry.accelerometer import FASTEST_M_S, Accelerometer
from scanchain.odometry.gyro import Gyro
from scanchain.odometry.intervals import Intervals
from scanchain.odometry.motion_filter import MEMORY, ErrorStatistics, MotionFilter
from scanchain.odometry.wheels import Wheels
from scanchain.preprocess import ScanMotion, Sweep

_CERTAIN = 5.0  # largest standard deviations within which the pose is that an IMU predicts
_EVEN = 2.0  # largest ratio of two intervals from which an acceleration is computed
_LEAST_WINDOW = 0.3  # m and rad, least half width where stamps are too close
_LARGEST_WINDOW_M = 5.0  # largest half width of the search window
_ACCELERATION_M_S2 = 4.0  # of a car; limits the search window around the predicted pose in space
_LARGEST_REACH_M = 30.0  # largest half width in space
_LEAST_M = 0.05  # least of the largest standard deviations of a translation by an IMU
_BURST = 0.05  # of the usual interval: a shorter one is due to a burst and gives no velocity
_JUMP = 1.0  # m and rad, difference of two motions per scan, above which the wheels may have jumped
_LEAST_TURN = 0.3  # of a rotation in the worst direction of a scan, a unit twist, that leaves the rotation open
_MOST_DOUBTFUL = 0.5  # share of lost or contradicted scans, above which scans cannot refute the wheels


class Source(StrEnum):
    """Source of the predicted motion to a scan."""

    CONSTANT_VELOCITY = "constant velocity"
    IMU = "IMU"  # rotation by its gyro, translation by its accelerometer
    GYRO = "gyro"  # the rotation; the translation at constant velocity
    WHEELS = "wheels"

    @property
    def is_measured(self) -> bool:
        """True if a sensor other than the lidar measures the whole motion."""
        return self in (Source.WHEELS, Source.IMU)

    @property
    def turns(self) -> bool:
        """True if a gyro measures the rotation."""
        return self in (Source.GYRO, Source.IMU)


class Prediction(msgspec.Struct, frozen=True):
    """The predicted pose of a scan, and the motion before it, for other initial poses and for deskewing.

    prior : predicted pose and its covariance
    gained : (k, k) covariance that the motion adds to that of the motions before, which it is independent of; None
        where errors are correlated from scan to scan
    source : what predicts it
    is_guess : whether scans are missing before this one, so that the error may be large
    scan_motion : that during the last scan, with the rotation during this one where a gyro measures it
    T_odom_last, T_previous_current : pose of the last scan, (d+1, d+1), and its motion since the one before
    interval_s, last_s, usual_s : the interval since the last scan, the one before, the usual one; 0 where unknown
    silence_s : since the last scan by stamps that log times confirm, else 0
    lost_s : for how long scans have been lost
    jump_m : distance between the motion by the wheels and the last motion continued; 0 where plausible
    config : largest speed and turn rate
    """

    prior: Prior
    gained: Matrix | None
    source: Source
    is_guess: bool
    scan_motion: ScanMotion
    T_odom_last: Pose
    T_previous_current: Pose
    interval_s: float
    last_s: float
    usual_s: float
    silence_s: float
    lost_s: float
    jump_m: float
    config: OdometryConfig

    @property
    def T_odom_lidar(self) -> Pose:
        """The predicted pose."""
        return self.prior.T_target_source

    @property
    def lasted_s(self) -> float:
        """The interval to compute a velocity with: in a burst of stamps the usual one."""
        return self.usual_s if self.interval_s < _BURST * self.usual_s else self.interval_s

    @property
    def before_s(self) -> float:
        """The same for the interval before."""
        return self.usual_s if self.last_s < _BURST * self.usual_s else self.last_s

    @property
    def is_second(self) -> bool:
        """True if no motion is known yet: at most one scan has been corrected."""
        return self.last_s == 0.0

    @property
    def reach_m(self) -> float:
        """Largest distance from the last scan."""
        speed_m_s = float(np.linalg.norm(self.T_previous_current[:-1, -1])) / max(self.usual_s, 1e-3)
        return self.silence_s * max(self.config.max_speed_m_s, speed_m_s)

    @property
    def farthest_m(self) -> float:
        """Largest plausible distance of a vehicle from the predicted pose."""
        elapsed_s = max(self.interval_s, self.usual_s, self.silence_s) + self.lost_s
        return 1.0 + elapsed_s * max(self.config.max_speed_m_s, FASTEST_M_S)

    @property
    def is_out_of_reach(self) -> bool:
        """True if the gap is so long that the scan may be outside any search window."""
        return not self.source.is_measured and self.silence_s * self.config.max_speed_m_s > _LARGEST_WINDOW_M

    def windows(self) -> tuple[tuple[float, float], ...]:
        """Half widths of the search windows around the predicted pose, the likeliest first, meters and radians.

        In space the first follows from a vehicle's acceleration, the second, for where that fails, from its speed.
        """
        elapsed_s = max(self.interval_s, self.usual_s) + self.lost_s
        half_width_rad = min(max(elapsed_s * self.config.max_turn_rad_s, _LEAST_WINDOW), math.pi)
        if self.source.turns:
            half_width_rad = _CERTAIN * float(self.prior.widest[-1])
        if self.source is Source.IMU:
            return ((_CERTAIN * float(self.prior.widest[:3].max()), half_width_rad),)
        if len(self.T_odom_last) == 3:
            half_width_m = min(max(elapsed_s * self.config.max_speed_m_s, _LEAST_WINDOW), _LARGEST_WINDOW_M)
            return ((half_width_m, half_width_rad),)
        by_speed = min(elapsed_s * max(self.config.max_speed_m_s, FASTEST_M_S), _LARGEST_REACH_M), half_width_rad
        if self.is_second or self.is_guess:
            return (by_speed,)
        by_acceleration = min(max(elapsed_s**2 * _ACCELERATION_M_S2, 1.0), by_speed[0]), half_width_rad
        return by_acceleration, by_speed

    def alternatives(self) -> tuple[Pose, ...]:
        """Other initial poses within the search window.

        The last motion again, the same velocity over 0.5, 1 and 1.5 times the interval by the stamps, and no
        motion.
        """
        T = self.T_odom_last
        moving = (self.T_previous_current, self.interval_s, self.last_s, self.usual_s)
        scaled = tuple(T @ _motion_over(*moving, share=share) for share in (0.5, 1.0, 1.5))
        return tuple(filter(self.is_possible, (T @ self.T_previous_current, *scaled, T)))

    def is_possible(self, T: Pose) -> bool:
        """True if a pose is within the search window, where an IMU measures the motion; else always."""
        if not self.source.turns:
            return True
        half_width_m, half_width_rad = self.windows()[-1]
        away_m, away_rad = lie.apart(self.T_odom_lidar, T)
        return away_m < half_width_m and away_rad < half_width_rad

    def scan_motion_by(self, motion: NDArray[np.float64]) -> ScanMotion:
        """Motion during a scan after this motion (k,) to it; that of the last one if stamps do not increase.

        The mean since the last scan, extrapolated by half an interval with the acceleration between the last two.
        """
        lasted_s, before_s = self.lasted_s, self.before_s
        if lasted_s <= 0.0:
            return self.scan_motion
        mean = motion / lasted_s
        if not 0.0 < lasted_s < _EVEN * before_s < _EVEN**2 * lasted_s:
            return ScanMotion(mean, self.scan_motion.turning)
        change = mean - lie.log(self.T_previous_current) / before_s
        return ScanMotion(mean + lasted_s / (lasted_s + before_s) * change, self.scan_motion.turning)

    def deskewing_error(self, T_odom_lidar: Pose, duration_s: float) -> NDArray[np.float64]:
        """(k,) approximate error of a scan of this duration after deskewing at constant velocity.

        At acceleration a, points are off by ½ a t² at the time t from the middle, on average a T²/24 over a
        scan of T seconds; a is taken from the last two motions.
        """
        if self.lasted_s <= 0.0 or self.is_second:
            return np.zeros(len(self.scan_motion.twist))
        mean = lie.log(lie.between(self.T_odom_last, T_odom_lidar)) / self.lasted_s
        acceleration = (mean - lie.log(self.T_previous_current) / self.before_s) / self.lasted_s
        if self.scan_motion.turning is not None:
            acceleration[len(T_odom_lidar) - 1 :] = 0.0
        return acceleration * duration_s**2 / 24.0


class Predictor:
    """Prediction from the last pose, motion and wheel reading, with their uncertainties.

    Without wheels, a constant-velocity filter predicts, whose noise is estimated from its prediction errors.
    Along a direction that a scan does not constrain, the motion continues and its variance grows.
    """

    def __init__(self, config: OdometryConfig, T_base_lidar: Pose, *, is_mounted: bool) -> None:
        """is_mounted : whether ``T_base_lidar`` is known; else it is estimated as the lidar moves."""
        self.config = config
        self.T_odom_lidar = lie.identity(T_base_lidar.shape[0] - 1)
        self.T_previous_current = self.T_odom_lidar
        k = lie.twist_size(T_base_lidar)
        self.scan_motion = ScanMotion(np.zeros(k))
        self.wheels = Wheels(config, T_base_lidar, is_mounted=is_mounted)
        self.gyro, self.accelerometer = Gyro(len(T_base_lidar) - 1), Accelerometer()
        sigma = lie.by_component(k, config.velocity_sigma_m, config.velocity_sigma_rad)
        self.statistics = {Source.WHEELS: self.wheels.statistics}
        self.statistics |= {source: ErrorStatistics(sigma) for source in Source if source is not Source.WHEELS}
        self.filter = MotionFilter(np.diag(sigma**2))
        self.intervals = Intervals()
        self.lost_s = 0.0
        self.scans, self.doubtful = 0, 0.0  # the latter: share of lost or contradicted scans, 1 after a jump

    def predict(self, scan: Scan, sweep: Sweep, *, by_wheels: bool = True) -> Prediction:
        """The predicted pose, at its middle, of a scan that follows the last one corrected."""
        times, turning = self.intervals, self.gyro.predict(scan, sweep)
        self.accelerometer.predict(self.T_odom_lidar, self.gyro)
        interval_s = times.to(scan)
        gained: Matrix | None = None
        wheel = self.wheels.motion(scan) if by_wheels and times.last_scan is not None else None
        source, is_guess, jump_m = Source.CONSTANT_VELOCITY if wheel is None else Source.WHEELS, False, 0.0
        self.wheels.is_contradicted = False
        if wheel is not None:
            motion, covariance = wheel, self.wheels.statistics.covariance
            scans = max(interval_s / times.usual_s, 1.0) if times.usual_s else 1.0
            is_second = times.last_s == 0.0  # no motion is known that a jump would contradict
            if not is_second and largest_magnitude(wheel - self.filter.motion) > _JUMP * scans:
                jump_m = float(np.linalg.norm(wheel[:-1, -1] - scans * self.filter.motion[:-1, -1]))
        elif turning is not None and self.accelerometer.is_used:
            source, motion, covariance = Source.IMU, *self._by_imu()
            gained = covariance.copy()
            gained[:3, :3] = self.accelerometer.gained
        elif times.is_gap(interval_s):
            motion = _motion_over(self.T_previous_current, interval_s, times.last_s, times.usual_s)
            covariance, is_guess = self.filter.any_motion, True
        else:
            if turning is not None:
                source = Source.GYRO
                self.filter.turn(self.gyro.rotation)
            noise = self.statistics[source].covariance
            motion, covariance = self.filter.motion, self.filter.predicted(noise)[0]
        widest = self.statistics[source].first_sigma
        if source.turns:
            widest = widest.copy()
            widest[-self.gyro.size :] = self.gyro.sigma_rad
        if source is Source.IMU:
            widest[:3] = np.minimum(widest[:3], _LEAST_M + _CERTAIN * np.sqrt(np.diag(covariance)[:3]))
        T_predicted = lie.normalize(self.T_odom_lidar.dot(motion))  # here and below: half the time of @
        return Prediction(
            prior=Prior(T_predicted, covariance, widest, is_measured=source.is_measured),
            gained=gained,
            source=source,
            is_guess=is_guess,
            scan_motion=ScanMotion(self.scan_motion.twist, turning),
            T_odom_last=self.T_odom_lidar,
            T_previous_current=self.T_previous_current,
            interval_s=interval_s,
            last_s=times.last_s,
            usual_s=times.usual_s,
            silence_s=times.silence_s(scan),
            lost_s=self.lost_s,
            jump_m=jump_m,
            config=self.config,
        )

    def _by_imu(self) -> tuple[Pose, Matrix]:
        """T_previous_current and its covariance (6, 6)."""
        away, sigma_rad = self.accelerometer.position - self.T_odom_lidar[:3, 3], self.gyro.sigma_rad
        motion = lie.exp(np.concatenate([np.zeros(3), self.gyro.rotation]))
        motion[:3, 3] = self.T_odom_lidar[:3, :3].T @ away
        covariance = sigma_rad**2 * np.eye(6)
        covariance[:3, :3] = self.accelerometer.covariance
        return motion, covariance

    def at_rest(self, T_odom_lidar: Pose) -> RestForce | None:
        """Specific force at rest; None while the accelerometer is not used, and without a stated mounting."""
        return self.accelerometer.at_rest(T_odom_lidar) if self.gyro.is_mounted else None

    @property
    def doubts_scans(self) -> bool:
        """True if most of the last scans were lost or contradicted, or one jumped: they cannot refute wheels."""
        return self.doubtful > _MOST_DOUBTFUL

    @property
    def innovations(self) -> dict[str, float]:
        """Normalized innovation of each sensor at the last scan, NaN where it was not compared."""
        found = {"wheels": self.wheels.innovation}
        if self.gyro.blocks:
            found |= {"gyro": self.gyro.innovation, "accelerometer": self.accelerometer.innovation}
        return found

    def warnings(self) -> tuple[str, ...]:
        """Defects of wheels and IMU, one per line."""
        return self.wheels.warnings() + self.gyro.warnings() + self.accelerometer.warnings()

    def notes(self) -> tuple[str, ...]:
        """Notes on wheels and IMU, one per line."""
        by_wheels = self.wheels.mounting.finish(), self.wheels.note()
        return tuple(filter(None, (*by_wheels, self.gyro.note(), self.accelerometer.note())))

    def correct(self, scan: Scan, prediction: Prediction, match: Match, state: State) -> None:
        """Update by the pose of a scan: that of its match or, if lost, the predicted one."""
        T_odom_lidar = prediction.T_odom_lidar if state is State.LOST else match.T_target_source
        before, self.wheels.innovation = self.T_previous_current, math.nan
        self.lost_s = self.lost_s + prediction.interval_s if state is State.LOST else 0.0
        if self.intervals.last_scan is not None:
            self.T_previous_current = lie.between(prediction.T_odom_last, T_odom_lidar)
            self.scan_motion = prediction.scan_motion_by(lie.log(self.T_previous_current))
            self._update(prediction, match, state)
        if self.gyro.blocks:
            is_known = self.scans > 0 and not scan.clock_jump_s and _shows_rotation(match, state)
            self.gyro.correct(self.T_previous_current if is_known else None)
            if self.gyro.size == 3:
                continued = prediction.T_odom_last @ before
                self.accelerometer.correct(T_odom_lidar, None if state is State.LOST else match, continued[:3, 3])
        self.scans += 1
        is_doubtful = state is State.LOST or (state is State.OK and match.fit < LEAST_FIT)
        self.doubtful += max(1.0 - MEMORY, 1.0 / self.scans) * (is_doubtful - self.doubtful)
        is_known = not (prediction.is_guess or prediction.is_second)
        if is_known and largest_magnitude(T_odom_lidar - prediction.T_odom_lidar) > _JUMP:
            self.doubtful = 1.0
        self.intervals.update(scan, prediction.interval_s)
        self.wheels.advance(scan)
        self.T_odom_lidar = T_odom_lidar

    def _update(self, prediction: Prediction, match: Match, state: State) -> None:
        """Correct the filter and the error statistics by the innovation."""
        if state is State.LOST:
            self.filter.begin(self.T_previous_current)
        elif prediction.is_guess:
            share = self.intervals.usual_s / prediction.interval_s
            self.filter.begin(lie.exp(share * lie.log(self.T_previous_current)))
        else:
            innovation = lie.log(lie.between(prediction.T_odom_lidar, match.T_target_source))
            is_measured, statistics = prediction.source.is_measured, self.statistics[prediction.source]
            if is_measured:
                self.filter.begin(self.T_previous_current)
            else:
                self.filter.correct(innovation, match.information, statistics.covariance)
            is_independent = not is_measured or match.observability >= WEAK
            if state is State.OK and is_independent and not prediction.is_second:
                covariance = definite_inverse(match.information)
                statistics.update(innovation, covariance.diagonal())
                if prediction.source is Source.WHEELS:
                    information = definite_inverse(prediction.prior.covariance + covariance)
                    square = innovation.dot(information).dot(innovation)
                    self.wheels.innovation = math.sqrt(square / len(innovation))


def _shows_rotation(match: Match, state: State) -> bool:
    """True if a scan determines the rotation, at least: its worst direction may be a translation."""
    turn = match.degeneracy_direction[3 if len(match.T_target_source) == 4 else 2 :]
    is_open = state is State.DEGENERATE and match.is_fit and float(np.abs(turn).max(initial=0.0)) < _LEAST_TURN
    return is_open or (state is State.OK and match.converged)


def _motion_over(
    T_previous_current: Pose, interval_s: float, last_s: float, usual_s: float, share: float = 1.0
) -> Pose:
    """The motion at the last velocity over a share of the interval.

    Very short intervals give a poor velocity: it is computed over half the usual one at least.
    """
    last_s = max(last_s, 0.5 * usual_s)
    if last_s <= 0.0:
        return T_previous_current
    return lie.exp(share * interval_s / last_s * lie.log(T_previous_current))
