"""Where the lidar should be now: by the wheels, by constant velocity, or where it was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.config import OdometryConfig
from pipeline.data import Pose, Scan
from pipeline.errors import InputError

_EVEN = 2.0  # intervals whose ratio is below this tell an acceleration
_GAP = 5.0  # times the usual interval, from which on scans are missing
_ALIKE = 1.4  # ratio up to which two intervals agree
_LONGEST = 100.0  # times the usual interval, beyond which stamps make no sense
_MEMORY = 0.9  # of the usual interval, per scan


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where to look for the next pose.

    Attributes
    ----------
    T_odom_lidar : the expected pose
    information : (k,) inverse variances of the expected pose, m⁻² and rad⁻²
    is_guess : whether much time has passed, so that the pose may be far off
    """

    T_odom_lidar: Pose
    information: NDArray[np.float64]
    is_guess: bool


class Predictor:
    """Remembers the last pose, the last motion and the last wheel reading."""

    def __init__(self, config: OdometryConfig, T_base_lidar: Pose) -> None:
        self.config = config
        self.T_base_lidar = T_base_lidar
        self.T_odom_lidar = lie.identity(T_base_lidar.shape[0] - 1)
        self.T_previous_current = self.T_odom_lidar
        self.velocity = np.zeros(3 if len(T_base_lidar) == 3 else 6)
        self.interval_s = 0.0
        self.usual_s = 0.0
        self.last_scan: Scan | None = None

    def predict(self, scan: Scan) -> Prediction:
        """The expected pose of a scan that follows the last one corrected."""
        wheel = self._wheel_motion(scan)
        config = self.config
        if wheel is None:
            expected = self.T_odom_lidar @ self._carried_on(scan)
            information = self._information(config.velocity_sigma_m, config.velocity_sigma_rad)
            return Prediction(expected, information, is_guess=self._has_gap_before(scan))
        information = self._information(config.wheel_sigma_m, config.wheel_sigma_rad)
        return Prediction(self.T_odom_lidar @ wheel, information, is_guess=False)

    def alternatives(self, scan: Scan) -> tuple[Pose, ...]:
        """Poses worth trying where the expected one leads nowhere good.

        The last motion again, the same over the time that passed by the stamps or half of that, half as much more,
        and standing still.
        """
        T = self.T_odom_lidar
        stretched = tuple(T @ self._stretched(scan, share) for share in (0.5, 1.0, 1.5))
        return T @ self.T_previous_current, *stretched, T

    def correct(self, scan: Scan, T_odom_lidar: Pose) -> None:
        """Take the pose that the scan turned out to have."""
        if self.last_scan is not None:
            self.velocity = self.velocity_at(scan, T_odom_lidar)
            self.T_previous_current = lie.inverse(self.T_odom_lidar) @ T_odom_lidar
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
        mean = lie.log(lie.inverse(self.T_odom_lidar) @ T_odom_lidar) / interval_s
        if not 0.0 < interval_s < _EVEN * self.interval_s < _EVEN**2 * interval_s:
            return mean
        before = lie.log(self.T_previous_current) / self.interval_s
        return mean + interval_s / (interval_s + self.interval_s) * (mean - before)

    def interval_to(self, scan: Scan) -> float:
        """Seconds since the last scan, 0 for the first.

        By the stamps where these agree with the usual interval or with the times of the log, else as usual.
        """
        if self.last_scan is None:
            return 0.0
        stamped_s = (scan.stamp_ns - self.last_scan.stamp_ns) * 1e-9
        logged_s = (scan.log_time_ns - self.last_scan.log_time_ns) * 1e-9
        if not self.usual_s or _are_alike(stamped_s, self.usual_s):
            return stamped_s
        is_sound = _are_alike(stamped_s, logged_s) and stamped_s < _LONGEST * self.usual_s
        return stamped_s if is_sound else self.usual_s

    def _has_gap_before(self, scan: Scan) -> bool:
        """Whether scans are missing."""
        return self.usual_s > 0.0 and self.interval_to(scan) > _GAP * self.usual_s

    def _carried_on(self, scan: Scan) -> Pose:
        """The motion to expect: the last one again or, over a gap, the same velocity for longer."""
        return self._stretched(scan) if self._has_gap_before(scan) else self.T_previous_current

    def _stretched(self, scan: Scan, share: float = 1.0) -> Pose:
        """The motion over a share of the time that passed; the shortest intervals tell a velocity badly."""
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
        return lie.inverse(self.T_base_lidar) @ lie.inverse(last) @ now @ self.T_base_lidar

    def _information(self, sigma_m: float, sigma_rad: float) -> NDArray[np.float64]:
        d = self.T_odom_lidar.shape[0] - 1
        turns = 1 if d == 2 else 3
        return np.array([sigma_m**-2] * d + [sigma_rad**-2] * turns)


def _are_alike(a: float, b: float) -> bool:
    """Whether two intervals are positive and of about the same length."""
    return 0.0 < b <= _ALIKE * a <= _ALIKE**2 * b
