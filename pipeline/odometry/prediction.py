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
_LARGEST_STRETCH = 20.0  # a longer gap says nothing about the motion in it


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where to look for the next pose.

    Attributes
    ----------
    T_odom_lidar : the expected pose
    information : (k,) inverse variances of the expected pose, m⁻² and rad⁻²
    """

    T_odom_lidar: Pose
    information: NDArray[np.float64]


class Predictor:
    """Remembers the last pose, the last motion and the last wheel reading."""

    def __init__(self, config: OdometryConfig, T_base_lidar: Pose) -> None:
        self.config = config
        self.T_base_lidar = T_base_lidar
        self.T_odom_lidar = lie.identity(T_base_lidar.shape[0] - 1)
        self.T_previous_current = self.T_odom_lidar
        self.velocity = np.zeros(3 if len(T_base_lidar) == 3 else 6)
        self.interval_s = 0.0
        self.last_scan: Scan | None = None

    def predict(self, scan: Scan) -> Prediction:
        """The expected pose of a scan that follows the last one corrected."""
        wheel = self._wheel_motion(scan)
        config = self.config
        if wheel is None:
            expected = self.T_odom_lidar @ self.T_previous_current
            return Prediction(expected, self._information(config.velocity_sigma_m, config.velocity_sigma_rad))
        expected = self.T_odom_lidar @ wheel
        return Prediction(expected, self._information(config.wheel_sigma_m, config.wheel_sigma_rad))

    def alternatives(self, scan: Scan) -> tuple[Pose, ...]:
        """Poses worth trying where the expected one leads nowhere good.

        Constant velocity, the same over the time that passed by the stamps, and standing still.
        """
        T = self.T_odom_lidar
        stretched = lie.exp(self._stretch(scan) * lie.log(self.T_previous_current))
        return T @ self.T_previous_current, T @ stretched, T

    def correct(self, scan: Scan, T_odom_lidar: Pose) -> None:
        """Take the pose that the scan turned out to have."""
        if self.last_scan is not None:
            self.velocity = self.velocity_at(scan, T_odom_lidar)
            self.T_previous_current = lie.inverse(self.T_odom_lidar) @ T_odom_lidar
            self.interval_s = self.interval_to(scan)
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
        """Seconds from the last scan's stamp to this one's; 0 for the first scan."""
        return (scan.stamp_ns - self.last_scan.stamp_ns) * 1e-9 if self.last_scan is not None else 0.0

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

    def _stretch(self, scan: Scan) -> float:
        """The interval up to this scan over the last one; 1 where the stamps make no sense."""
        if self.last_scan is None or self.interval_s <= 0.0:
            return 1.0
        ratio = self.interval_to(scan) / self.interval_s
        return ratio if 0.0 < ratio < _LARGEST_STRETCH else 1.0

    def _information(self, sigma_m: float, sigma_rad: float) -> NDArray[np.float64]:
        d = self.T_odom_lidar.shape[0] - 1
        turns = 1 if d == 2 else 3
        return np.array([sigma_m**-2] * d + [sigma_rad**-2] * turns)
