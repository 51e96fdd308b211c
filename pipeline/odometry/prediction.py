"""Where the lidar should be now: by the wheels, by constant velocity, or where it was."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import OdometryConfig
from scanchain.data import Match, Matrix, Pose, Prior, Scan, State
from scanchain.errors import InputError
from scanchain.kernels.registration.observability import definite_inverse
from scanchain.odometry.experience import Experience
from scanchain.odometry.intervals import Intervals
from scanchain.odometry.motion_filter import MotionFilter

_EVEN = 2.0  # intervals whose ratio is below this tell an acceleration
_LEAST_WINDOW_M, _LEAST_WINDOW_RAD = 0.3, 0.3  # for stamps that lie too close
_LARGEST_WINDOW_M = 5.0


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where to look for the next pose.

    Attributes
    ----------
    prior : the expected pose and how surely
    experience : that the doubt comes from, of predictions by the same means
    is_guess : whether much time has passed, so that the pose may be far off
    """

    prior: Prior
    experience: Experience
    is_guess: bool

    @property
    def T_odom_lidar(self) -> Pose:
        """The expected pose."""
        return self.prior.T_target_source

    def moved(self, T: Pose) -> Prediction:
        """The same in an odometry frame whose origin stands elsewhere."""
        return Prediction(
            Prior(T @ self.T_odom_lidar, self.prior.covariance, self.prior.widest), self.experience, self.is_guess
        )


class Predictor:
    """Remembers the last pose, the last motion and the last wheel reading, and how sure these were.

    Without wheels the motion goes on as it was, by a filter whose noise is learned from the errors of the
    predictions. Where a scan tells nothing along a direction, the motion there goes on and its variance grows.
    """

    def __init__(self, config: OdometryConfig, T_base_lidar: Pose) -> None:
        self.config = config
        self.T_base_lidar = T_base_lidar
        self.T_odom_lidar = lie.identity(T_base_lidar.shape[0] - 1)
        self.T_previous_current = self.T_odom_lidar
        k = lie.twist_size(T_base_lidar)
        self.velocity = np.zeros(k)
        self.by_velocity = Experience(lie.by_component(k, config.velocity_sigma_m, config.velocity_sigma_rad))
        self.by_wheels = Experience(lie.by_component(k, config.wheel_sigma_m, config.wheel_sigma_rad))
        self.filter = MotionFilter(np.diag(self.by_velocity.first_sigma**2))
        self.intervals = Intervals()
        self.lost_s = 0.0

    def predict(self, scan: Scan) -> Prediction:
        """The expected pose of a scan that follows the last one corrected."""
        wheel = self._wheel_motion(scan)
        if wheel is not None:
            return self._prediction(wheel, np.diag(self.by_wheels.variances), self.by_wheels)
        if self.intervals.has_gap_before(scan):
            return self._prediction(self._stretched(scan), self.filter.any_motion, self.by_velocity, is_guess=True)
        covariance = self.filter.predicted_covariance(self.by_velocity.variances)
        return self._prediction(self.filter.motion, covariance, self.by_velocity)

    def _prediction(
        self, motion: Pose, covariance: Matrix, experience: Experience, *, is_guess: bool = False
    ) -> Prediction:
        prior = Prior(lie.normalize(self.T_odom_lidar @ motion), covariance, experience.first_sigma)
        return Prediction(prior, experience, is_guess)

    def alternatives(self, scan: Scan) -> tuple[Pose, ...]:
        """Poses worth trying where the expected one leads nowhere good.

        The last motion again, the same over the time that passed by the stamps or half of that, half as much more,
        and standing still.
        """
        T = self.T_odom_lidar
        stretched = tuple(T @ self._stretched(scan, share) for share in (0.5, 1.0, 1.5))
        return T @ self.T_previous_current, *stretched, T

    def window(self, scan: Scan) -> tuple[float, float]:
        """How far from the expected pose a scan may be at the most, in the plane: meters and radians."""
        elapsed_s = max(self.intervals.to(scan), self.intervals.usual_s) + self.lost_s
        return (
            min(max(elapsed_s * self.config.max_speed_m_s, _LEAST_WINDOW_M), _LARGEST_WINDOW_M),
            min(max(elapsed_s * self.config.max_turn_rad_s, _LEAST_WINDOW_RAD), math.pi),
        )

    def reach_m(self, scan: Scan) -> float:
        """How far a scan may be from the last one at the most."""
        speed_m_s = float(np.linalg.norm(self.T_previous_current[:-1, -1])) / max(self.intervals.usual_s, 1e-3)
        return self.intervals.silence_s(scan) * max(self.config.max_speed_m_s, speed_m_s)

    def is_out_of_reach(self, scan: Scan) -> bool:
        """Whether a scan may be further off than it can be looked for: so long have there been none."""
        return self.intervals.silence_s(scan) * self.config.max_speed_m_s > _LARGEST_WINDOW_M

    def correct(self, scan: Scan, prediction: Prediction, match: Match, state: State) -> None:
        """Take the pose that the scan turned out to have: that of its match or, where it is lost, the expected."""
        T_odom_lidar = prediction.T_odom_lidar if state is State.LOST else match.T_target_source
        self.lost_s = self.lost_s + self.intervals.to(scan) if state is State.LOST else 0.0
        if self.intervals.last_scan is not None:
            self.velocity = self.velocity_at(scan, T_odom_lidar)
            self.T_previous_current = lie.between(self.T_odom_lidar, T_odom_lidar)
            self._learn(scan, prediction, match, state)
        self.intervals.take(scan)
        self.T_odom_lidar = T_odom_lidar

    def _learn(self, scan: Scan, prediction: Prediction, match: Match, state: State) -> None:
        """Let filter and experience know how far a scan was from where it was expected."""
        if state is State.LOST:
            self.filter.begin(self.T_previous_current)
        elif prediction.is_guess:
            share = self.intervals.usual_s / self.intervals.to(scan)
            self.filter.begin(lie.exp(share * lie.log(self.T_previous_current)))
        else:
            surprise = lie.log(lie.between(prediction.T_odom_lidar, match.T_target_source))
            if prediction.experience is self.by_velocity:
                self.filter.correct(surprise, match.information, self.by_velocity.variances)
            else:
                self.filter.begin(self.T_previous_current)
            if state is State.OK and not self.is_new:
                prediction.experience.learn(surprise, np.diag(definite_inverse(match.information)))

    @property
    def is_new(self) -> bool:
        """Whether no motion is known yet: one scan at most has been corrected."""
        return self.intervals.last_s == 0.0

    def place(self, T_odom_lidar: Pose) -> None:
        """Move the last pose, before any motion is known."""
        self.T_odom_lidar = T_odom_lidar

    def velocity_at(self, scan: Scan, T_odom_lidar: Pose) -> NDArray[np.float64]:
        """Twist (k,) per second at a scan of this pose, in its own frame; the last one where stamps stand still.

        The mean since the last scan, carried on by half an interval with the acceleration between the last two.
        """
        interval_s = self.intervals.to(scan)
        if interval_s <= 0.0:
            return self.velocity
        mean = self._motion_to(T_odom_lidar) / interval_s
        if not 0.0 < interval_s < _EVEN * self.intervals.last_s < _EVEN**2 * interval_s:
            return mean
        return mean + interval_s / (interval_s + self.intervals.last_s) * (mean - self._velocity_before())

    def deskewing_error(self, scan: Scan, T_odom_lidar: Pose, duration_s: float) -> NDArray[np.float64]:
        """(k,) by how much a scan of this duration is off after deskewing at constant velocity, about.

        Under an acceleration a the points lie ½ a t² off at the time t from the middle, on average a T²/24 over a
        scan of T seconds; a by the last two motions.
        """
        interval_s = self.intervals.to(scan)
        if interval_s <= 0.0 or self.is_new:
            return np.zeros(len(self.velocity))
        mean = self._motion_to(T_odom_lidar) / interval_s
        return (mean - self._velocity_before()) / interval_s * duration_s**2 / 24.0

    def _motion_to(self, T_odom_lidar: Pose) -> NDArray[np.float64]:
        """Twist (k,) from the last pose."""
        return lie.log(lie.between(self.T_odom_lidar, T_odom_lidar))

    def _velocity_before(self) -> NDArray[np.float64]:
        """Mean twist (k,) per second between the last two poses."""
        return lie.log(self.T_previous_current) / self.intervals.last_s

    def _stretched(self, scan: Scan, share: float = 1.0) -> Pose:
        """The motion at the same velocity over a share of the time that passed.

        The shortest intervals tell a velocity badly.
        """
        last_s = max(self.intervals.last_s, 0.5 * self.intervals.usual_s)
        if last_s <= 0.0:
            return self.T_previous_current
        return lie.exp(share * self.intervals.to(scan) / last_s * lie.log(self.T_previous_current))

    def _wheel_motion(self, scan: Scan) -> Pose | None:
        """Motion of the lidar since the last scan by the wheels; None without a reading at both ends."""
        if self.config.prior == "constant-velocity" or self.intervals.last_scan is None:
            return None
        last, now = self.intervals.last_scan.T_odom_base, scan.T_odom_base
        if last is None or now is None:
            if self.config.prior == "wheel":
                raise InputError(
                    f"scan {scan.index} has no wheel odometry although odometry.prior is 'wheel'; "
                    "set log.odometry_topic, or odometry.prior to 'auto'"
                )
            return None
        return lie.between(self.T_base_lidar, lie.between(last, now) @ self.T_base_lidar)
