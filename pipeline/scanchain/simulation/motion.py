"""Motion of a vehicle: laps around a closed route, turns on the spot with short moves; odometry of its wheels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import BSpline, make_interp_spline
from scipy.linalg import block_diag
from scipy.ndimage import gaussian_filter1d

from scanchain import lie
from scanchain.data import Matrix
from scanchain.simulation.solids import Solids

_SWAY_HERTZ = np.array([1.3, 0.9, 1.1, 0.8, 0.6])  # heave, roll, pitch, sideways, heading

_SCALE_SHARE = 0.01  # relative error of the distance: the wheels are not of the assumed size
_TURN_SHARE = 0.02  # relative error of the angle: the wheels are not at the assumed distance
_BIAS_RAD_PER_M = 0.0005  # turn per meter, because one wheel is larger than the other
_NOISE = (0.01, 0.004)  # m and rad per √m, standard deviations of the slip along the path and in heading


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Kinematics of a robot, a car or a walking person, and the mounting of the lidar.

    speed_m_s, acceleration_m_s2, lateral_acceleration_m_s2 : limits along the path and in bends
    radius_m : half its width
    T_base_lidar : (4, 4)
    corner_m : standard deviation of the smoothing that rounds the route; a right angle gets 0.9 of it as radius
    deviation_m : largest deviation from the route in x and in y, different on every lap
    sway_rad, heave_m : roll, pitch and height of the body at full speed, amplitudes
    swing_rad, swing_m : heading and sideways motion of the body at full speed, amplitudes
    start_m_s : speed at the first instant
    pitches : whether it pitches with the heights of its route
    standstill_s : how long it stands still before it starts
    """

    speed_m_s: float
    acceleration_m_s2: float
    lateral_acceleration_m_s2: float
    radius_m: float
    T_base_lidar: Matrix
    corner_m: float = 0.0
    deviation_m: float = 0.0
    sway_rad: float = 0.0
    heave_m: float = 0.0
    swing_rad: float = 0.0
    swing_m: float = 0.0
    start_m_s: float = 0.0
    pitches: bool = False
    standstill_s: float = 0.0


def mount(x_m: float, z_m: float) -> Matrix:
    """T_base_lidar (4, 4) of a forward-facing lidar, ``x_m`` ahead of and ``z_m`` above the base."""
    return np.array([[1.0, 0, 0, x_m], [0, 1, 0, 0], [0, 0, 1, z_m], [0, 0, 0, 1]])


class Course(NamedTuple):
    """Positions (N, 2) on the ground or (N, 3) with given heights, forward unit vectors (N, 2), speeds (N,)."""

    place: Matrix
    forward: Matrix
    speed_m_s: NDArray[np.float64]
    climb: NDArray[np.float64] | float = 0.0  # slope (N,) of the vehicle at given heights


@dataclass(frozen=True, slots=True)
class Motion:
    """A vehicle's motion along a course, with its pose at any instant.

    ``course`` at (N,) instants; ``phases`` (5,) of the body's sway.
    """

    course: Callable[[NDArray[np.floating]], Course]
    vehicle: Vehicle
    solids: Solids
    phases: NDArray[np.float64]

    def base(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_base at (N,) instants, (N, 4, 4): x along the path, z normal to the ground."""
        place, forward, speed_m_s, climb = self.course(times_s)
        if place.shape[1] == 2:
            height_m, slope = self.solids.ground_height(place), self.solids.ground_slope(place)
        else:
            height_m, slope = place[:, 2], np.reshape(climb, (-1, 1)) * forward
        poses = _stand(place[:, :2], height_m, slope, forward)
        v = self.vehicle
        if v.sway_rad > 0.0 or v.heave_m > 0.0:  # sway of a body on springs or legs, proportional to its speed
            sizes = np.array([v.heave_m, v.sway_rad, v.sway_rad, v.swing_m, v.swing_rad])
            waves = np.sin(2.0 * np.pi * _SWAY_HERTZ * times_s[:, None] + self.phases)
            twists = np.zeros((len(times_s), 6))
            twists[:, [2, 3, 4, 1, 5]] = (speed_m_s / v.speed_m_s)[:, None] * sizes * waves
            poses = poses @ lie.exp(twists)
        return poses

    def at_pace(self, pace: float) -> Motion:
        """The same course, driven ``pace`` times as fast."""

        def course(times_s: NDArray[np.floating]) -> Course:
            course = self.course(pace * times_s)
            return course._replace(speed_m_s=pace * course.speed_m_s)

        return replace(self, course=course, vehicle=replace(self.vehicle, speed_m_s=pace * self.vehicle.speed_m_s))

    def lidar(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_lidar at (N,) instants, (N, 4, 4)."""
        return self.base(times_s) @ self.vehicle.T_base_lidar


def _stand(xy: Matrix, height_m: NDArray[np.float64], slope: Matrix, forward: Matrix) -> Matrix:
    """Poses (N, 4, 4) at these heights, x along ``forward`` (N, 2), z normal to a ground with ``slope`` (N, 2)."""
    ahead = np.column_stack([forward, np.sum(slope * forward, axis=1)])
    up = np.column_stack([-slope, np.ones(len(xy))])
    poses = np.zeros((len(xy), 4, 4))
    poses[:, :3, 0] = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    poses[:, :3, 2] = up / np.linalg.norm(up, axis=1, keepdims=True)
    poses[:, :3, 1] = np.cross(poses[:, :3, 2], poses[:, :3, 0])
    poses[:, :2, 3] = xy
    poses[:, 2, 3] = height_m
    poses[:, 3, 3] = 1.0
    return poses


def wheel_odometry(
    T_world_base: Matrix, *, drift: float, rng: np.random.Generator, slips_m: NDArray[np.floating] | float = 0.0
) -> Matrix:
    """T_odom_base (N, 3, 3) that wheels report for the poses (N, 4, 4), starting at the identity.

    Each step has errors of scale and a bias, sampled once for the whole drive, and noise that grows with the
    square root of the distance. ``drift`` multiplies every error; 0 is the planar truth.
    ``slips_m`` (N-1,) : what they roll per step without moving the vehicle, negative if they roll too little
    """
    planar = lie.flatten(T_world_base)
    steps = lie.inverse(planar[:-1]) @ planar[1:]
    traveled = np.linalg.norm(steps[:, :2, 2], axis=1)
    scale, turn, bias = drift * rng.choice([-1.0, 1.0], 3) * rng.uniform(0.5, 1.5, 3)
    noise = drift * np.sqrt(traveled)[:, None] * rng.standard_normal((len(steps), 2))
    moved = steps[:, :2, 2] * (1.0 + scale * _SCALE_SHARE)
    moved[:, 0] += _NOISE[0] * noise[:, 0] + slips_m
    turned = (
        lie.yaw(steps) * (1.0 + turn * _TURN_SHARE) + bias * _BIAS_RAD_PER_M * traveled + _NOISE[1] * noise[:, 1]
    )
    poses = lie.exp(np.outer(np.concatenate([[0.0], np.cumsum(turned)]), [0.0, 0.0, 1.0]))  # at the origin
    c, s = poses[:-1, 0, 0], poses[:-1, 1, 0]
    ahead = np.stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1]], axis=1)
    poses[1:, :2, 2] = np.cumsum(ahead, axis=0)
    return poses


class Profile(NamedTuple):
    """Sampling of a speed profile: spacing, and standard deviation of the smoothing that makes it continuous."""

    step_s: float
    ease_s: float

    @property
    def extent_s(self) -> float:
        """Extent of the smoothing, on each side: gaussian_filter1d stops at four standard deviations."""
        return 4.0 * self.ease_s

    def eased(self, speeds: Matrix) -> Matrix:
        """The smoothed speeds."""
        return np.asarray(gaussian_filter1d(speeds, self.ease_s / self.step_s, axis=0))


_LAPS, _PIVOTS = Profile(step_s=0.02, ease_s=0.25), Profile(step_s=0.005, ease_s=0.05)
_HOLD_S = _LAPS.extent_s  # standstill before the start
_MARGIN_S = 2.0 * _HOLD_S  # a profile extends this far beyond both ends of the drive
TURN_RAD_S, _TURN_RAD_S2 = np.deg2rad(120.0), np.deg2rad(400.0)  # limits of a turn on the spot


class Lap:
    """A closed route (W, d), parametrized by the distance along it; ``corners_m`` (W + 1,) are its corners'."""

    def __init__(self, route: Matrix) -> None:
        self._corners = np.vstack([route, route[:1]])
        self.corners_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._corners, axis=0), axis=1))])
        self.length_m = float(self.corners_m[-1])

    def at(self, along_m: NDArray[np.float64] | float) -> Matrix:
        """Positions (..., d) at distances along the route, on any lap."""
        place_m = along_m % self.length_m
        return np.stack([np.interp(place_m, self.corners_m, column) for column in self._corners.T], axis=-1)

    def yaw_rad(self, along_m: float) -> float:
        """Direction of a route on the ground, over one meter."""
        ahead = self.at(along_m + 0.5) - self.at(along_m - 0.5)
        return float(np.arctan2(ahead[1], ahead[0]))

    def beside(self, along_m: float, left_m: float) -> tuple[float, float]:
        """The position ``along_m`` along a route on the ground and ``left_m`` to its left."""
        yaw_rad = self.yaw_rad(along_m)
        x, y = self.at(along_m) + left_m * np.array([-np.sin(yaw_rad), np.cos(yaw_rad)])
        return float(x), float(y)


def laps(
    route: Matrix, vehicle: Vehicle, solids: Solids, *, duration_s: float, rng: np.random.Generator
) -> Motion:
    """A drive around a closed ``route``: (W, 2) along the ground, (W, 3) at its heights."""
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    reach_m = vehicle.speed_m_s * duration_s + 10.0 * vehicle.corner_m + 2.0 * _MARGIN_S * vehicle.start_m_s
    line = _deviate(Lap(route).at(np.arange(0.0, reach_m, 0.02 * vehicle.corner_m)), vehicle, rng)
    phases = np.concatenate([phases, rng.uniform(0.0, 2.0 * np.pi, 2)])
    smooth = gaussian_filter1d(line, 50.0, axis=0, mode="nearest")
    arc_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    position = make_interp_spline(arc_m, smooth, k=3)
    driven_m = _drive(position, arc_m, vehicle, duration_s)

    def course(times_s: NDArray[np.floating]) -> Course:
        along_m = driven_m(times_s)
        ahead = position(along_m, 1)
        ahead /= np.linalg.norm(ahead[:, :2], axis=1, keepdims=True)
        climb = ahead[:, 2] if vehicle.pitches else 0.0
        return Course(position(along_m), ahead[:, :2], driven_m(times_s, 1), climb)

    return Motion(course, vehicle, solids, phases)


def begun_at(route: Matrix, start_m: float) -> Matrix:
    """The closed route (W, d), starting ``start_m`` along it."""
    if start_m == 0.0:
        return route
    lap = Lap(route)
    ahead = int(np.searchsorted(lap.corners_m[:-1], start_m % lap.length_m, side="right"))
    return np.vstack([lap.at(start_m), route[ahead:], route[:ahead]])


def sampled(route: Matrix, step_m: float) -> Matrix:
    """Points along the straight segments of the closed route, both ends of each and about one point per step."""
    segments = zip(route, np.roll(route, -1, axis=0), strict=True)
    return np.vstack([np.linspace(a, b, max(int(np.linalg.norm(b - a) / step_m), 2)) for a, b in segments])


def _deviate(line: Matrix, vehicle: Vehicle, rng: np.random.Generator) -> Matrix:
    """The line shifted by slow waves, at most ``deviation_m`` in x and in y."""
    place = np.arange(len(line)) / 50.0  # in units of corner_m
    shift = np.zeros_like(line)
    for axis in (0, 1):
        for wavelength in rng.uniform(8.0, 30.0, 3):
            shift[:, axis] += np.sin(2.0 * np.pi * (place / wavelength + rng.uniform())) / 3.0
    return line + vehicle.deviation_m * shift


def _drive(position: BSpline, arc_m: NDArray[np.float64], vehicle: Vehicle, duration_s: float) -> BSpline:
    """Arc length over time: as fast as the limits allow, smoothed so that the acceleration is continuous."""
    first, second = position(arc_m, 1), position(arc_m, 2)
    bend = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    energy = np.minimum(vehicle.speed_m_s**2, vehicle.lateral_acceleration_m_s2 / np.maximum(bend, 1e-9))
    energy[0] = vehicle.start_m_s**2
    gain = 2.0 * vehicle.acceleration_m_s2 * arc_m  # v² grows by at most 2 a Δs, forward and backward
    energy = np.minimum.accumulate(energy - gain) + gain
    energy = (np.minimum.accumulate((energy + gain)[::-1]))[::-1] - gain
    speed = np.sqrt(np.maximum(energy, 0.0))
    taken_s = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(arc_m) / (speed[1:] + speed[:-1]))])
    times_s = np.arange(-_MARGIN_S, duration_s + _MARGIN_S, _LAPS.step_s)
    begun_s = times_s - _HOLD_S - vehicle.standstill_s
    eased = _LAPS.eased(np.interp(begun_s, taken_s, speed))
    reached_m = cumulative_trapezoid(eased, dx=_LAPS.step_s, initial=0.0)
    return make_interp_spline(times_s, reached_m, k=3)


class Pivot(NamedTuple):
    """A turn on the spot, then a straight move."""

    turn_deg: float
    ahead_m: float


def pivots(
    steps: tuple[Pivot, ...], vehicle: Vehicle, solids: Solids, *, duration_s: float, rng: np.random.Generator
) -> Motion:
    """Turns and short moves from the origin, heading along x: ``steps`` that end in their first pose, repeated."""
    phases = rng.uniform(0.0, 2.0 * np.pi, 5)
    turns = [_trapezoid(np.deg2rad(step.turn_deg), TURN_RAD_S, _TURN_RAD_S2) for step in steps]
    moves = [_trapezoid(step.ahead_m, vehicle.speed_m_s, vehicle.acceleration_m_s2) for step in steps]
    pairs = zip(turns, moves, strict=True)  # one after the other
    lap = np.vstack([np.asarray(block_diag(turn[:, None], move[:, None])) for turn, move in pairs])
    rounds = int((duration_s + _MARGIN_S) / (len(lap) * _PIVOTS.step_s)) + 1
    rates = np.vstack([np.zeros((round(_HOLD_S / _PIVOTS.step_s), 2)), *[lap] * rounds])
    turning, moving = _PIVOTS.eased(rates).T
    instants_s = np.arange(len(rates)) * _PIVOTS.step_s
    turned = cumulative_trapezoid(turning, dx=_PIVOTS.step_s, initial=0.0)
    velocity = moving[:, np.newaxis] * np.column_stack([np.cos(turned), np.sin(turned)])
    moved = cumulative_trapezoid(velocity, dx=_PIVOTS.step_s, axis=0, initial=0.0)
    heading, place = (make_interp_spline(instants_s, values, k=3) for values in (turned, moved))

    def course(times_s: NDArray[np.floating]) -> Course:
        yaw = heading(times_s)
        forward = np.column_stack([np.cos(yaw), np.sin(yaw)])
        return Course(place(times_s), forward, np.linalg.norm(place(times_s, 1), axis=1))

    return Motion(course, vehicle, solids, phases)


def _trapezoid(distance: float, limit: float, acceleration: float) -> NDArray[np.float64]:
    """Speeds, ``_PIVOTS.step_s`` apart, that cover the distance within both limits; then a pause."""
    peak = min(limit, np.sqrt(abs(distance) * acceleration))
    if peak == 0.0:
        return np.zeros(0)
    taken_s = abs(distance) / peak + peak / acceleration
    times_s = np.arange(0.0, taken_s, _PIVOTS.step_s)
    speed = np.minimum(peak, acceleration * np.minimum(times_s, taken_s - times_s))
    speed *= distance / (np.sum(speed) * _PIVOTS.step_s)
    return np.concatenate([speed, np.zeros(round(2.0 * _PIVOTS.extent_s / _PIVOTS.step_s))])
