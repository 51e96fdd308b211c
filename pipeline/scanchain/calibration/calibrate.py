"""Calibration of a log's sensors from its own motion: each parameter with σ, or why it is not observable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import NamedTuple

import msgspec
import numpy as np
import tomli_w

from scanchain import lie
from scanchain.calibration.motions import Motions, fit_gyro, fit_wheels
from scanchain.calibration.planes import OFFSETS, Others, Window, adjust
from scanchain.config import Config
from scanchain.data import Points, Pose, Scan, State, Vector
from scanchain.errors import InputError, counted
from scanchain.logs import Log
from scanchain.logs.messages.lidar import with_offsets
from scanchain.logs.messages.poses import StampedPose
from scanchain.logs.mounting import angles_rad
from scanchain.logs.stream import decoded_messages
from scanchain.odometry import Odometry, Tracked
from scanchain.odometry.delay import BLOCK, LONGEST_S, WheelDelay
from scanchain.odometry.distortion import WINDOWS_AT
from scanchain.odometry.elevation import POINTS, cell_of
from scanchain.preprocess import first_per_voxel
from scanchain.registration import VoxelMap, create_matcher
from scanchain.registration.search import evenly
from scanchain.runs.job import Progress
from scanchain.settings import Override, load_settings

_SCANS = (5, 16)  # least and largest number of scans of a window
_SPACING = (0.9, 0.4)  # distance of the scans of a window, in cells, and with several lidars
_FINE = 0.5  # factor on the cells in which several lidars are compared: coarse ones hide that surfaces are curved
_SIGNIFICANT = 2.0  # standard deviations of a value that is corrected
_CONTRADICTED = 2.5  # standard deviations between level and upright planes above which a range offset is none
_RANGE_SIGMA_M = 0.01  # largest σ of an observable range offset: lidars are more accurate than 2 cm
_DEG = 180.0 / math.pi
_UNITS = {"deg": (0.3, _DEG), "m": (0.05, 1.0), "": (0.01, 1.0), "s": (0.02, 1.0), "deg/s": (0.1, _DEG)}
# largest σ of an observable parameter by its unit, and factor from SI
_ANGLES = ("roll", "pitch", "yaw")
_WITHOUT_WHEELS = (Override("odometry.prior", "constant-velocity", "doctor"),)


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of a sensor.

    sensor, name, unit : in words; value, sigma : in that unit
    why : reason if it is not observable, else empty
    """

    sensor: str
    name: str
    value: float
    sigma: float
    unit: str
    why: str = ""


@dataclass(frozen=True, slots=True)
class Calibration:
    """The parameters of a log's sensors, and the keys of ``[log]`` for those that differ from what is assumed."""

    parameters: list[Parameter] = field(default_factory=list)
    keys: dict[str, float | str] = field(default_factory=dict)

    def add(
        self, sensor: str, name: str, unit: str, value: float, sigma: float, lack: str, *, key: str = ""
    ) -> bool:
        """Add a parameter in SI units; True if it is observable: its σ is small enough. ``lack`` : why, if not."""
        largest, factor = _UNITS[unit]
        value, sigma = factor * float(value), factor * float(sigma)
        is_known = sigma <= largest
        self.parameters.append(Parameter(sensor, name, value, sigma, unit, "" if is_known else lack))
        if is_known and key and abs(value - (not unit)) > _SIGNIFICANT * sigma:  # the usual scale is 1
            self.keys[key] = value / factor
        return is_known

    def add_pose(self, sensor: str, T: Pose, sigmas: Sequence[float] | Vector, lacks: Sequence[str]) -> bool:
        """Add position and angles (6 σ) of a pose; True if all but those with an infinite σ are observable."""
        T, used = lie.lift(T), range(6) if len(T) == 4 else (0, 1, 5)
        values = [*T[:3, 3].tolist(), *angles_rad(T)]
        known = [
            self.add(sensor, ("x", "y", "z", *_ANGLES)[i], "m" if i < 3 else "deg", values[i], sigmas[i], lacks[i])
            for i in used
        ]
        return all(is_known or math.isinf(sigmas[i]) for is_known, i in zip(known, used, strict=True))

    def toml(self) -> str:
        """The keys as a file for ``scanchain run --config``."""
        return tomli_w.dumps({"log": self.keys})


class _Taken(NamedTuple):
    """A scan of a window."""

    number: int
    own: Points
    others: list[Others]


def calibrate(log: Log, config: Config, progress: Progress) -> Calibration:
    """Parameters of the sensors of a log. Raises InputError if it has too few scans.

    config : that of a run; the elevation is calibrated for the whole log at once, and wheels do not predict
    """
    preprocess = msgspec.structs.replace(config.preprocess, calibrate_elevation=False)
    config = msgspec.structs.replace(config, preprocess=preprocess)
    odometry = Odometry(config, log.stated_mounting, dimension=log.dimension)
    collector, tracked = _Collector(log, odometry), list[Tracked]()
    for scan in progress.track(log.scans(preprocess), log.scan_count):
        found = odometry.process(replace(scan, others=(), T_odom_base=None))
        if log.dimension == 3:
            collector.add(scan, found)
        nothing = found.points[:0]
        bare = replace(scan, points=scan.points[:0], times_s=scan.times_s[:0], others=())
        tracked.append(msgspec.structs.replace(found, scan=bare, points=nothing, matched=nothing))
    if len(tracked) < _SCANS[0]:
        raise InputError(
            f"{log.name}: has {counted(len(tracked), 'scan')}; a calibration needs {_SCANS[0]} at least"
        )
    result, begin_ns = Calibration(), tracked[0].scan.stamp_ns
    motions = _motions(tracked)
    if log.dimension == 3:
        _of_lidars(result, log, odometry, collector.windows(tracked))
    if log.imu is not None:
        _of_imu(result, odometry, motions, [each.scan for each in tracked])
    if log.odometry_topic:
        _of_wheels(result, log, motions, begin_ns)
    return result


def delay_of_wheels(log: Log) -> float:
    """How late the stamps of the wheels are, by matching windows of a log; 0 where small or not observable."""
    if not log.odometry_topic:
        return 0.0
    config, found = load_settings(log.dimension, overrides=_WITHOUT_WHEELS).config, WheelDelay()
    for window in log.windows(WINDOWS_AT[:5], min(BLOCK, log.scan_count)):
        odometry = Odometry(config, log.stated_mounting, dimension=log.dimension)
        for scan in window:
            odometry.process(scan)
        found.add(odometry.predictor.wheels.delay)
        if found.is_clear:
            break
    return found.seconds


class _Collector:
    """Windows of scans, spaced along the path, with the points of all lidars."""

    def __init__(self, log: Log, odometry: Odometry) -> None:
        self.T_first_others = [each.T_first_other for each in log.others]
        self.odometry, self.cell_m = odometry, 0.0
        self.T_last: Pose | None = None
        self.since, self.left_out = 0, 0
        self.collected: list[list[_Taken]] = [[]]

    def add(self, scan: Scan, tracked: Tracked) -> None:
        """Add a scan if it is far enough from the last one; after n windows, n are left out."""
        self.since += 1
        if tracked.state is State.LOST:
            self.collected += [[]] if self.collected[-1] else []
            return
        if not scan.index or not len(tracked.points):
            return
        if not self.cell_m:
            self.cell_m = cell_of(tracked.points)
        spacing = _SPACING[bool(self.T_first_others)]
        is_far = self.T_last is None or lie.apart(self.T_last, tracked.T_odom_lidar)[0] >= spacing * self.cell_m
        if not is_far and not (self.T_first_others and self.since >= 5):
            return  # with several lidars, standing scans are of use, too
        self.T_last, self.since = tracked.T_odom_lidar, 0
        if not self.collected[-1] and self.left_out < len(self.collected) - 1:
            self.left_out += 1
            return
        others = [self._points_of(scan, T_first_other) for T_first_other in self.T_first_others]
        self.collected[-1].append(_Taken(scan.index, evenly(tracked.points, POINTS), others))
        if len(self.collected[-1]) == _SCANS[1]:
            self.left_out = 0
            self.collected.append([])

    def _points_of(self, scan: Scan, T_first_other: Pose) -> Others:
        """Points of another lidar, distinguished from further ones by its position, in its own frame."""
        found = [each for each in scan.others if np.array_equal(each.origin, T_first_other[:3, 3])]
        if not found:
            return Others(np.empty((0, 3)), np.empty(0))
        limits = self.odometry.config.preprocess
        seen = np.concatenate([each.points for each in found]).astype(np.float64)
        points = lie.transform(lie.inverse(T_first_other), seen)
        voxel_m = self.odometry.resolution.scale * limits.map_voxel_m
        chosen = first_per_voxel(points, voxel_m, limits.min_range_m, limits.max_range_m)
        chosen = chosen[:: max(math.ceil(len(chosen) / POINTS), 1)]
        return Others(points[chosen], np.concatenate([each.times_s for each in found])[chosen].astype(np.float64))

    def windows(self, tracked: Sequence[Tracked]) -> list[Window]:
        """The windows with enough scans."""
        T = np.array([each.T_odom_lidar for each in tracked])
        lasted_s = 1e-9 * np.diff([each.scan.stamp_ns for each in tracked])
        rates = lie.log(lie.between(T[:-1], T[1:])) / np.maximum(lasted_s, 1e-3)[:, None]
        rates = np.concatenate([rates[:1], rates, rates[-1:]])
        found = list[Window]()
        for taken in self.collected:
            if len(taken) >= _SCANS[0]:
                numbers = np.array([each.number for each in taken])
                others = [[each.others[o] for each in taken] for o in range(len(self.T_first_others))]
                twists = np.stack([rates[numbers], rates[numbers + 1]], axis=1)
                found.append(Window([each.own for each in taken], T[numbers], twists, others, self.cell_m))
        return found


def _motions(tracked: Sequence[Tracked]) -> Motions:
    """Motions between consecutive scans whose poses are determined; times since the first scan."""
    stamps_ns = np.array([each.scan.stamp_ns for each in tracked])
    T = np.array([each.T_odom_lidar for each in tracked])
    ok = np.array([each.state is State.OK for each in tracked])
    lasted_ns, ok[0] = np.diff(stamps_ns), False  # the first scan is not deskewed
    is_motion = ok[:-1] & ok[1:] & (lasted_ns > 0) & (lasted_ns < 1e9 * LONGEST_S)
    is_motion &= np.array([not each.is_repeated for each in tracked[1:]])
    times_s = 1e-9 * (stamps_ns - stamps_ns[0])
    return Motions(np.column_stack([times_s[:-1], times_s[1:]]), lie.between(T[:-1], T[1:])).where(is_motion)


def _of_lidars(result: Calibration, log: Log, odometry: Odometry, windows: Sequence[Window]) -> None:
    """Offsets of the first lidar, then the poses of the others in its frame, by finer cells.

    The range offset is adopted where level and upright planes agree on it: errors of single beams resemble it.
    """
    nothing, config, name = np.empty((0, 4, 4)), log.config, f"lidar {log.topic}"
    free, held = adjust(windows, nothing), adjust(windows, nothing, holds=(False, True))
    lack = lack_of_range = "the lidar hardly moves, or sees too few planes"
    found, sigma_m, sigmas, offsets = held, math.inf, np.full(2, math.inf), np.zeros(2)
    if found is not None and free is not None:
        if abs(free.contradiction) > _CONTRADICTED:
            lack_of_range = f"level and upright planes contradict each other ({abs(free.contradiction):.1f} σ)"
        elif free.sigmas[1] < _RANGE_SIGMA_M:
            found, sigma_m = free, float(free.sigmas[1])
        sigmas, offsets = found.sigmas, found.offsets
    elevation_rad, range_m = (offsets + np.array([config.elevation_offset_rad, config.range_offset_m])).tolist()
    result.add(name, "elevation offset", "deg", elevation_rad, sigmas[0], lack, key="elevation_offset_rad")
    result.add(name, "range offset", "m", range_m, sigma_m, lack_of_range, key="range_offset_m")
    if log.others and found is not None:
        offsets = np.where(np.abs(offsets) > _SIGNIFICANT * sigmas, offsets, 0.0)
        _of_others(result, log, odometry, windows, offsets, sigmas)


def _of_others(
    result: Calibration, log: Log, odometry: Odometry, windows: Sequence[Window], offsets: Vector, sigmas: Vector
) -> None:
    """Poses of the other lidars in the frame of the first, whose offsets are known with these σ (2,)."""
    for each in windows:
        each.own, each.cell_m = [with_offsets(points, *offsets) for points in each.own], _FINE * each.cell_m
    T_others = np.array([_matched(windows, o, each.T_first_other, odometry) for o, each in enumerate(log.others)])
    found = adjust(windows, T_others, holds=(True, True), sigmas=sigmas)
    T_others, are_known = T_others if found is None else found.T_first_others, True
    for o, (other, T) in enumerate(zip(log.others, T_others, strict=True)):
        six = np.full(6, math.inf)
        if found is not None:
            J = np.hstack([np.eye(3), -lie.hat(T[:3, 3])])  # of its position
            C = found.covariance[OFFSETS + 6 * o :, OFFSETS + 6 * o :][:6, :6]
            six = np.sqrt(np.concatenate([(J @ C @ J.T).diagonal(), C.diagonal()[3:]]))
        lacks = ["the surfaces that both lidars see do not determine it"] * 6
        are_known &= result.add_pose(f"{other.channel.topic} in the frame of {log.topic}", T, six, lacks)
    if are_known and found is not None:
        result.keys["other_lidar_poses"] = ", ".join(map(_pose_text, T_others))


def _matched(windows: Sequence[Window], lidar: int, T_first_other: Pose, odometry: Odometry) -> Pose:
    """Pose of another lidar by aligning its scans to those of the first one: where the adjustment begins."""
    matcher, config = create_matcher(odometry.config.matching), odometry.config.local_map
    for _ in range(2):
        H, b = 1e-6 * np.eye(6), np.zeros(6)
        for window in windows:
            local_map = VoxelMap(3, config, odometry.resolution.scale)
            for points, T in zip(window.own, window.poses, strict=True):
                local_map.insert(points, T)
            for points, T in zip(window.others_in_first(lidar, T_first_other), window.poses, strict=True):
                match = matcher.align(points, local_map, T, wide=True) if len(points) > 100 else None
                if match is not None and match.is_fit:
                    H += match.information
                    b += match.information @ lie.log(lie.between(T, match.T_target_source))
        T_first_other = lie.exp(np.asarray(np.linalg.solve(H, b), np.float64)) @ T_first_other
    return T_first_other


def _of_imu(result: Calibration, odometry: Odometry, motions: Motions, scans: Sequence[Scan]) -> None:
    """Rotation, bias and delay of the gyro; rotations about one axis leave the rotation about it open."""
    gyro, samples = odometry.predictor.gyro, [each.inertial for each in scans if each.inertial is not None]
    found = None
    if gyro.model is not None and samples:
        times_s = 1e-9 * (np.concatenate([each.stamps_ns for each in samples]) - scans[0].stamp_ns)
        rates, axes = np.concatenate([each.rates for each in samples]), np.zeros((3, 3))
        axes[-gyro.size :] = gyro.model.axes
        found = fit_gyro(motions, np.asarray(times_s, np.float64), rates, axes, gyro.model.delay_s)
    if found is None or gyro.model is None:
        result.add("IMU", "rotation", "deg", 0.0, math.inf, "no rotation of the scans resembles its rates")
        return
    if gyro.size == 3:
        scale, R = float(np.cbrt(np.linalg.det(gyro.model.axes))), np.eye(4)
        R[:3, :3] = gyro.model.axes / scale
        R = lie.exp(np.concatenate([np.zeros(3), found.x[:3]])) @ R
        lack = "the log turns about one axis, or hardly turns"
        rows = zip(_ANGLES, angles_rad(R), found.sigmas[:3], strict=True)
        known = [result.add("IMU", name, "deg", value, sigma, lack) for name, value, sigma in rows]
        if all(known) and scale > 0.0:
            result.keys["imu_rotation"] = _numbers(lie.to_quaternion(R[:3, :3]))
    for i in range(6 - gyro.size, 6):
        name = f"bias about {'xyz'[i - 3]} of the lidar"
        result.add("IMU", name, "deg/s", found.x[i], found.sigmas[i], "the log is too short")
    delay_s, lack = found.x[6] + odometry.config.log.imu_delay_s, "the rate of turn hardly changes"
    result.add("IMU", "delay", "s", delay_s, found.sigmas[6], lack, key="imu_delay_s")


def _of_wheels(result: Calibration, log: Log, motions: Motions, begin_ns: int) -> None:
    """Mounting of the lidar on the base, scales and delay of the wheels."""
    decoders, name = {log.odometry_topic: log.sample_decoders[log.odometry_topic]}, f"wheels {log.odometry_topic}"
    messages = decoded_messages(log.indexes, decoders, log.span, damage=[])
    values = (each.value if isinstance(each.value, list) else [each.value] for each in messages)
    poses = {each.stamp_ns: each.T_parent_child for each in chain(*values) if isinstance(each, StampedPose)}
    stamps_ns, found = sorted(poses), None
    if stamps_ns:
        T = np.array([poses[each] for each in stamps_ns])
        times_s = 1e-9 * (np.array(stamps_ns) - begin_ns)
        found = fit_wheels(motions, times_s, lie.flatten(T) if log.dimension == 3 else T, log.stated_mounting)
    if found is None:
        result.add(
            name, "scale of distances", "", 1.0, math.inf, "the log hardly moves, or wheels and scans contradict"
        )
        return
    x, s = found.fit.x, found.fit.sigmas
    turns, moves = "the log hardly turns: it only drives straight", "the log hardly moves"
    lacks = [turns, turns, "wheels move in the plane, whatever its height", turns, moves, moves]
    sigmas = [s[0], s[1], math.inf, *s[2:5]]
    if result.add_pose(f"{log.topic} on the base", found.T_base_lidar, sigmas, lacks) and not log.is_mirrored:
        result.keys["lidar_pose"] = _pose_text(lie.lift(found.T_base_lidar))
    result.add(name, "scale of distances", "", 1.0 + x[5], s[5], moves, key="odometry_scale")
    result.add(name, "scale of turns", "", 1.0 + x[6], s[6], turns, key="odometry_turn_scale")
    result.add(name, "delay", "s", x[8], s[8], "the speed hardly changes", key="odometry_delay_s")


def _pose_text(T: Pose) -> str:
    return _numbers(np.concatenate([T[:3, 3], lie.to_quaternion(T[:3, :3])]))


def _numbers(values: Vector) -> str:
    return " ".join(f"{each:.7f}" for each in values)
