"""Wheel odometry as a source of motion predictions: its mounting, prediction errors and rejected readings."""

from __future__ import annotations

import math

from scanchain import lie
from scanchain.config import OdometryConfig
from scanchain.data import Match, Pose, Scan
from scanchain.errors import InputError, counted
from scanchain.kernels.registration.observability import WEAK
from scanchain.odometry.delay import WheelDelay
from scanchain.odometry.motion_filter import ErrorStatistics
from scanchain.registration.hand_eye import MountingEstimator

_ASSUMED_M = 2.0  # of path on which distances by wheels and by scans are taken to be equal, at first
_CHECKED = 100  # readings after which it is checked again whether stamps are late
_LEAST_PERCENT = 0.1  # error of distances by wheels that is reported
_SLIP, _SLIP_M = 0.06, 0.02  # share of a motion, and distance, by which wheels and scans differ that do not slip


class Wheels:
    """Motion of the lidar by wheel odometry, where both ends of a motion have a reading that is not rejected.

    statistics : of its prediction errors
    is_contradicted : whether the reading at the newest scan is rejected
    innovation : of the motion to the newest scan, normalized; NaN where it is not compared
    delay : of its stamps
    by_scans_m, by_wheels_m : path where both are known, in space
    is_late : whether its stamps are out of step, in space; readings : number of them
    """

    def __init__(self, config: OdometryConfig, T_base_lidar: Pose, *, is_mounted: bool) -> None:
        """is_mounted : whether ``T_base_lidar`` is known; else it is estimated as the lidar moves."""
        self.prior = config.prior
        self.mounting = MountingEstimator(T_base_lidar, is_stated=is_mounted)
        sigma = lie.by_component(lie.twist_size(T_base_lidar), config.wheel_sigma_m, config.wheel_sigma_rad)
        self.statistics = ErrorStatistics(sigma)
        self.is_contradicted, self.innovation = False, math.nan
        self.delay, self.by_scans_m, self.by_wheels_m = WheelDelay(), _ASSUMED_M, _ASSUMED_M
        self.is_late, self.readings = False, 0
        self._last: tuple[Pose, Pose] | None = None  # poses of lidar and base at the last scan if it is determined
        self._T_odom_base: Pose | None = None  # at the last scan; None where rejected
        self._jumps: list[tuple[int, float]] = []  # scan number and meters of each rejected reading

    @property
    def scale(self) -> float:
        """True distances over those by the wheels; 1 if late, as accelerations then look like a wrong scale."""
        return 1.0 if self.is_late else self.by_scans_m / self.by_wheels_m

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
        T_base_lidar, moved = self.mounting.T_base_lidar, lie.between(last, now)
        moved[:-1, -1] *= self.scale
        return lie.between(T_base_lidar, moved.dot(T_base_lidar))

    def reject(self, scan: Scan, jump_m: float) -> None:
        """Reject the reading at this scan, which jumps by ``jump_m``, also for the motion to the next scan."""
        self.is_contradicted = True
        self._jumps.append((scan.index, jump_m))

    def advance(self, scan: Scan) -> None:
        """Keep the reading at this scan, if it is not rejected, for the motion to the next one."""
        reading = None if self.is_contradicted else scan.T_odom_base
        self._T_odom_base = None if reading is None else reading.copy()

    def update(self, scan: Scan, T_odom_lidar: Pose, match: Match, *, is_open: bool) -> None:
        """Estimate mounting, delay and scale by the pose of a scan at its stamp; ``is_open`` if undetermined."""
        self.mounting.update(T_odom_lidar, scan.T_odom_base, is_open=is_open)
        before, self._last = self._last, None
        if scan.T_odom_base is None:
            return
        known = T_odom_lidar, scan.T_odom_base.copy()
        self.delay.update(scan.stamp_ns, *known, is_known=not is_open)
        if len(T_odom_lidar) == 3:
            return
        self.readings += 1
        if self.readings % _CHECKED == 0:
            self.is_late = self.delay.seconds != 0.0
        if is_open or match.observability < WEAK:  # the prediction is in the pose
            return
        self._last = known
        if before is not None and self.mounting.is_usable:
            self._update_scale(*map(lie.between, before, known))

    def _update_scale(self, lidar: Pose, base: Pose) -> None:
        """Add the distances of a motion by scans and by wheels, unless they contradict each other or are short."""
        T_base_lidar, by_wheels_m = self.mounting.T_base_lidar, float(base[0, 3])
        by_scans_m = float((T_base_lidar @ lidar @ lie.inverse(T_base_lidar))[0, 3])
        is_likely = abs(by_scans_m - self.scale * by_wheels_m) < _SLIP * abs(by_wheels_m) + _SLIP_M
        if is_likely and abs(by_wheels_m) > _SLIP_M:
            self.by_scans_m += math.copysign(1.0, by_wheels_m) * by_scans_m
            self.by_wheels_m += abs(by_wheels_m)

    def note(self) -> str:
        """Error of its distances, in words; empty where none is known."""
        percent = 100.0 * (1.0 / self.scale - 1.0)
        if abs(percent) < _LEAST_PERCENT:
            return ""
        long = "long" if percent > 0.0 else "short"
        return f"wheel odometry: its distances are {abs(percent):.1f} % too {long}, which predictions correct"

    def warnings(self) -> tuple[str, ...]:
        """Late stamps, and readings that were rejected, one per line."""
        lines, delay_s = list[str](), self.delay.seconds
        if delay_s:
            late = f"{abs(delay_s):.2f} s {'late' if delay_s > 0.0 else 'early'}"
            lines.append(f"wheel odometry: its stamps are {late}: add {delay_s:.2f} to log.odometry_delay_s")
        if self._jumps:
            longest_m = max(jump_m for _, jump_m in self._jumps)
            lines.append(
                f"wheel odometry jumps by up to {longest_m:.3g} m where the scans fit without it: left out "
                f"at {counted(len(self._jumps), 'scan')} (the first: scan {self._jumps[0][0]:,})"
            )
        return tuple(lines)
