"""Where the lidar should be now: by the wheels, by constant velocity, or where it was."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.config import OdometryConfig
from pipeline.data import Match, Matrix, Pose, Prior, Scan, State
from pipeline.errors import InputError
from pipeline.kernels.evidence import informed
from pipeline.odometry.experience import Experience

_EVEN = 2.0  # intervals whose ratio is below this tell an acceleration
_GAP = 5.0  # times the usual interval, from which on scans are missing
_ALIKE = 1.4  # ratio up to which two intervals agree
_LONGEST = 100.0  # times the usual interval, beyond which stamps make no sense
_MEMORY = 0.9  # of the usual interval, per scan
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

    Without wheels the motion goes on as it was: a Kalman filter whose state is the velocity, whose process noise
    is learnt from the errors of the predictions, and whose measurement is the match (its information is added to
    that of the prediction). Where a scan tells nothing along a direction, the velocity there is carried on and
    its variance grows.
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
        self.any_motion = np.diag(self.by_velocity.first_sigma**2)
        self.motion_covariance = self.any_motion
        self.interval_s = 0.0
        self.usual_s = 0.0
        self.lost_s = 0.0
        self.last_scan: Scan | None = None

    def predict(self, scan: Scan) -> Prediction:
        """The expected pose of a scan that follows the last one corrected."""
        wheel = self._wheel_motion(scan)
        if wheel is not None:
            return self._prediction(wheel, np.diag(self.by_wheels.variances), self.by_wheels)
        if self._has_gap_before(scan):
            return self._prediction(self._stretched(scan), self.any_motion, self.by_velocity, is_guess=True)
        covariance = self.motion_covariance + np.diag(self.by_velocity.variances)
        return self._prediction(self.T_previous_current, covariance, self.by_velocity)

    def _prediction(
        self, motion: Pose, covariance: Matrix, experience: Experience, *, is_guess: bool = False
    ) -> Prediction:
        prior = Prior(lie.normalise(self.T_odom_lidar @ motion), covariance, experience.first_sigma)
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
        """How far from the expected pose a scan may be at the most, in the plane: metres and radians."""
        elapsed_s = max(self.interval_to(scan), self.usual_s) + self.lost_s
        return (
            min(max(elapsed_s * self.config.max_speed_m_s, _LEAST_WINDOW_M), _LARGEST_WINDOW_M),
            min(max(elapsed_s * self.config.max_turn_rad_s, _LEAST_WINDOW_RAD), math.pi),
        )

    def reach_m(self, scan: Scan) -> float:
        """How far a scan may be from the last one at the most."""
        speed_m_s = float(np.linalg.norm(self.T_previous_current[:-1, -1])) / max(self.usual_s, 1e-3)
        return self._silence_s(scan) * max(self.config.max_speed_m_s, speed_m_s)

    def is_out_of_reach(self, scan: Scan) -> bool:
        """Whether a scan may be further off than it can be looked for: so long have there been none."""
        return self._silence_s(scan) * self.config.max_speed_m_s > _LARGEST_WINDOW_M

    def correct(self, scan: Scan, prediction: Prediction, match: Match, state: State) -> None:
        """Take the pose that the scan turned out to have: that of its match or, where it is lost, the expected."""
        T_odom_lidar = prediction.T_odom_lidar if state is State.LOST else match.T_target_source
        self.lost_s = self.lost_s + self.interval_to(scan) if state is State.LOST else 0.0
        self.motion_covariance = self.any_motion
        if state is not State.LOST:
            self.motion_covariance = informed(prediction.prior.covariance, match.information)
        if state is State.OK and not prediction.is_guess and not self.is_new:
            prediction.experience.learn(lie.log(lie.between(prediction.T_odom_lidar, T_odom_lidar)))
        if self.last_scan is not None:
            self.velocity = self.velocity_at(scan, T_odom_lidar)
            self.T_previous_current = lie.between(self.T_odom_lidar, T_odom_lidar)
            self.interval_s = self.interval_to(scan)
            if not self._has_gap_before(scan):
                gain = 1.0 - _MEMORY if self.usual_s else 1.0
                self.usual_s += gain * (self.interval_s - self.usual_s)
        self.T_odom_lidar = T_odom_lidar
        self.last_scan = scan

    @property
    def is_new(self) -> bool:
        """Whether no motion is known yet: one scan at most has been corrected."""
        return self.interval_s == 0.0

    def place(self, T_odom_lidar: Pose) -> None:
        """Move the last pose, before any motion is known."""
        self.T_odom_lidar = T_odom_lidar

    def velocity_at(self, scan: Scan, T_odom_lidar: Pose) -> NDArray[np.float64]:
        """Twist (k,) per second at a scan of this pose, in its own frame; the last one where stamps stand still.

        The mean since the last scan, carried on by half an interval with the acceleration between the last two.
        """
        interval_s = self.interval_to(scan)
        if interval_s <= 0.0:
            return self.velocity
        mean = self._motion_to(T_odom_lidar) / interval_s
        if not 0.0 < interval_s < _EVEN * self.interval_s < _EVEN**2 * interval_s:
            return mean
        return mean + interval_s / (interval_s + self.interval_s) * (mean - self._velocity_before())

    def deskewing_error(self, scan: Scan, T_odom_lidar: Pose, duration_s: float) -> NDArray[np.float64]:
        """(k,) by how much a scan of this duration is off after deskewing at constant velocity, about.

        Under an acceleration a the points lie ½ a t² off at the time t from the middle, on average a T²/24 over a
        scan of T seconds; a by the last two motions.
        """
        interval_s = self.interval_to(scan)
        if interval_s <= 0.0 or self.is_new:
            return np.zeros(len(self.velocity))
        mean = self._motion_to(T_odom_lidar) / interval_s
        return (mean - self._velocity_before()) / interval_s * duration_s**2 / 24.0

    def _motion_to(self, T_odom_lidar: Pose) -> NDArray[np.float64]:
        """Twist (k,) from the last pose."""
        return lie.log(lie.between(self.T_odom_lidar, T_odom_lidar))

    def _velocity_before(self) -> NDArray[np.float64]:
        """Mean twist (k,) per second between the last two poses."""
        return lie.log(self.T_previous_current) / self.interval_s

    def interval_to(self, scan: Scan) -> float:
        """Seconds since the last scan, 0 for the first.

        By the stamps where these agree with the usual interval or with the times of the log, else as usual.
        """
        if self.last_scan is None:
            return 0.0
        stamped_s, logged_s = self._since(self.last_scan, scan)
        if not self.usual_s or _are_alike(stamped_s, self.usual_s):
            return stamped_s
        is_sound = _are_alike(stamped_s, logged_s) and stamped_s < _LONGEST * self.usual_s
        return stamped_s if is_sound else self.usual_s

    def _silence_s(self, scan: Scan) -> float:
        """Seconds since the last scan, however many; 0 where the stamps and the log disagree."""
        if self.last_scan is None:
            return 0.0
        stamped_s, logged_s = self._since(self.last_scan, scan)
        return stamped_s if _are_alike(stamped_s, logged_s) else 0.0

    @staticmethod
    def _since(last: Scan, scan: Scan) -> tuple[float, float]:
        """Seconds between two scans by their stamps and by the log."""
        return (scan.stamp_ns - last.stamp_ns) * 1e-9, (scan.log_time_ns - last.log_time_ns) * 1e-9

    def _has_gap_before(self, scan: Scan) -> bool:
        """Whether scans are missing."""
        return self.usual_s > 0.0 and self.interval_to(scan) > _GAP * self.usual_s

    def _stretched(self, scan: Scan, share: float = 1.0) -> Pose:
        """The motion at the same velocity over a share of the time that passed.

        The shortest intervals tell a velocity badly.
        """
        last_s = max(self.interval_s, 0.5 * self.usual_s)
        if last_s <= 0.0:
            return self.T_previous_current
        return lie.exp(share * self.interval_to(scan) / last_s * lie.log(self.T_previous_current))

    def _wheel_motion(self, scan: Scan) -> Pose | None:
        """Motion of the lidar since the last scan by the wheels; None without a reading at both ends."""
        if self.config.prior == "constant-velocity" or self.last_scan is None:
            return None
        last, now = self.last_scan.T_odom_base, scan.T_odom_base
        if last is None or now is None:
            if self.config.prior == "wheel":
                raise InputError(
                    f"scan {scan.index} has no wheel odometry although odometry.prior is 'wheel'; "
                    "set log.odometry_topic, or odometry.prior to 'auto'"
                )
            return None
        return lie.between(self.T_base_lidar, lie.between(last, now) @ self.T_base_lidar)


def _are_alike(a: float, b: float) -> bool:
    """Whether two intervals are positive and of about the same length."""
    return 0.0 < b <= _ALIKE * a <= _ALIKE**2 * b
