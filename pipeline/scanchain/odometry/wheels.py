"""Wheel odometry as a source of motion predictions: its mounting, prediction errors and rejected readings."""

from __future__ import annotations

import math

from scanchain import lie
from scanchain.config import OdometryConfig
from scanchain.data import Pose, Scan
from scanchain.errors import InputError, counted
from scanchain.odometry.motion_filter import ErrorStatistics
from scanchain.registration.hand_eye import MountingEstimator


class Wheels:
    """Motion of the lidar by wheel odometry, where both ends of a motion have a reading that is not rejected.

    statistics : of its prediction errors
    is_contradicted : whether the reading at the newest scan is rejected
    innovation : of the motion to the newest scan, normalized; NaN where it is not compared
    """

    def __init__(self, config: OdometryConfig, T_base_lidar: Pose, *, is_mounted: bool) -> None:
        """is_mounted : whether ``T_base_lidar`` is known; else it is estimated as the lidar moves."""
        self.prior = config.prior
        self.mounting = MountingEstimator(T_base_lidar, is_stated=is_mounted)
        sigma = lie.by_component(lie.twist_size(T_base_lidar), config.wheel_sigma_m, config.wheel_sigma_rad)
        self.statistics = ErrorStatistics(sigma)
        self.is_contradicted, self.innovation = False, math.nan
        self._T_odom_base: Pose | None = None  # at the last scan; None where rejected
        self._jumps: list[tuple[int, float]] = []  # scan number and meters of each rejected reading

    def motion(self, scan: Scan) -> Pose | None:
        """T_previous_current of a scan after the first; None without a reading at both ends.

        Raises InputError if the scan has none although ``odometry.prior`` is "wheel".
        """
        if self.prior == "constant-velocity" or scan.clock_jump_s:
            return None  # the clock of the wheel readings may have jumped as well
        last, now = self._T_odom_base, scan.T_odom_base
        if now is None and self.prior == "wheel":
            raise InputError(
                f"scan {scan.index} has no wheel odometry although odometry.prior is 'wheel'; "
                "set log.odometry_topic, or odometry.prior to 'auto'"
            )
        if last is None or now is None or not self.mounting.is_usable:
            return None
        T_base_lidar = self.mounting.T_base_lidar
        return lie.between(T_base_lidar, lie.between(last, now).dot(T_base_lidar))

    def reject(self, scan: Scan, jump_m: float) -> None:
        """Reject the reading at this scan, which jumps by ``jump_m``, also for the motion to the next scan."""
        self.is_contradicted = True
        self._jumps.append((scan.index, jump_m))

    def advance(self, scan: Scan) -> None:
        """Keep the reading at this scan, if it is not rejected, for the motion to the next one."""
        reading = None if self.is_contradicted else scan.T_odom_base
        self._T_odom_base = None if reading is None else reading.copy()

    def warnings(self) -> tuple[str, ...]:
        """A line on readings that were rejected; none without any."""
        if not self._jumps:
            return ()
        longest_m = max(jump_m for _, jump_m in self._jumps)
        return (
            f"wheel odometry jumps by up to {longest_m:.3g} m where the scans fit without it: left out "
            f"at {counted(len(self._jumps), 'scan')} (the first: scan {self._jumps[0][0]:,})",
        )
