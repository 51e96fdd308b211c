"""Motions of a vehicle: laps round a closed route, and turns on the spot with short moves between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d

from scanchain import lie
from scanchain.data import Matrix
from scanchain.simulation.motion import Vehicle, stand, stand_on_ground, sway
from scanchain.simulation.solids import Solids

_HOLD_S = 1.0  # before it sets off, as long as the easing reaches
_STEP_S = 0.02  # spacing of the speed profile
_EASE_S = 0.25  # standard deviation of the smoothing that makes the acceleration continuous
_MARGIN_S = 2.0  # the profile begins and ends that much beyond the drive

TURN_RAD_S = np.deg2rad(120.0)
_TURN_RAD_S2 = np.deg2rad(400.0)
_PIVOT_STEP_S = 0.005  # spacing of the profiles
_PIVOT_EASE_S = 0.05  # standard deviation of the smoothing that makes the accelerations continuous
_PAUSE_S = 0.4  # between a turn and a move, as long as the easing reaches on both sides
_FIRST_PAUSE_S = 1.0  # standstill at the beginning


class Laps:
    """A drive round a closed ``route``: (W, 2) along the ground, (W, 3) walked upright at the heights it gives."""

    def __init__(
        self,
        route: Matrix,
        vehicle: Vehicle,
        solids: Solids,
        *,
        duration_s: float,
        rng: np.random.Generator,
    ) -> None:
        self._vehicle = vehicle
        self._solids = solids
        phases = rng.uniform(0.0, 2.0 * np.pi, 3)
        reach_m = vehicle.speed_m_s * duration_s + 10.0 * vehicle.corner_m + 2.0 * _MARGIN_S * vehicle.start_m_s
        line = _deviate(_densify(route, reach_m, 0.02 * vehicle.corner_m), vehicle, rng)
        self._phases = np.concatenate([phases, rng.uniform(0.0, 2.0 * np.pi, 2)])
        smooth = gaussian_filter1d(line, 50.0, axis=0, mode="nearest")
        arc_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
        self._position = make_interp_spline(arc_m, smooth, k=3)
        self._arc = _drive(self._position, arc_m, vehicle, duration_s)

    def speed_m_s(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Speed along the path at (N,) instants."""
        return self._arc(times_s, 1)

    def base(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_base at (N,) instants, (N, 4, 4): x along the path, z normal to the ground."""
        arc_m = self._arc(times_s)
        place = self._position(arc_m)
        forward = self._position(arc_m, 1)[:, :2]
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        if place.shape[1] == 2:
            poses = stand_on_ground(place, forward, self._solids)
        else:
            poses = stand(place[:, :2], place[:, 2], np.zeros_like(forward), forward)
        if self._vehicle.sway_rad > 0.0 or self._vehicle.heave_m > 0.0:
            share = self.speed_m_s(times_s) / self._vehicle.speed_m_s
            poses = poses @ lie.exp(sway(self._vehicle, self._phases, times_s, share))
        return poses

    def lidar(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_lidar at (N,) instants, (N, 4, 4)."""
        return self.base(times_s) @ self._vehicle.T_base_lidar


def begun_at(route: Matrix, start_m: float) -> Matrix:
    """The closed route (W, d) from a point on, so many meters along it."""
    if start_m == 0.0:
        return route
    lap = np.vstack([route, route[:1]])
    corners_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lap, axis=0), axis=1))])
    along_m = start_m % corners_m[-1]
    first = np.stack([np.interp(along_m, corners_m, column) for column in lap.T])
    ahead = int(np.searchsorted(corners_m[:-1], along_m, side="right"))
    return np.vstack([first, route[ahead:], route[:ahead]])


def sampled(route: Matrix, step_m: float) -> Matrix:
    """Points along the straight segments of the closed route, both corners of each and one about every step."""
    segments = zip(route, np.roll(route, -1, axis=0), strict=True)
    return np.vstack([np.linspace(a, b, max(int(np.linalg.norm(b - a) / step_m), 2)) for a, b in segments])


def _densify(route: Matrix, reach_m: float, step_m: float) -> Matrix:
    """Points every ``step_m`` along as many laps of the closed route as ``reach_m`` takes."""
    lap = np.vstack([route, route[:1]])
    corners_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lap, axis=0), axis=1))])
    along_m = np.arange(0.0, reach_m, step_m) % corners_m[-1]
    return np.stack([np.interp(along_m, corners_m, column) for column in lap.T], axis=1)


def _deviate(line: Matrix, vehicle: Vehicle, rng: np.random.Generator) -> Matrix:
    """The line shifted by slow waves, at most ``deviation_m`` in x and in y."""
    place = np.arange(len(line)) / 50.0  # in units of corner_m
    shift = np.zeros_like(line)
    for axis in (0, 1):
        for wavelength in rng.uniform(8.0, 30.0, 3):
            shift[:, axis] += np.sin(2.0 * np.pi * (place / wavelength + rng.uniform())) / 3.0
    return line + vehicle.deviation_m * shift


def _drive(position: BSpline, arc_m: NDArray[np.float64], vehicle: Vehicle, duration_s: float) -> BSpline:
    """Arc length over time: as fast as the limits allow, then eased so that the acceleration is continuous."""
    first, second = position(arc_m, 1), position(arc_m, 2)
    bend = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    energy = np.minimum(vehicle.speed_m_s**2, vehicle.lateral_acceleration_m_s2 / np.maximum(bend, 1e-9))
    energy[0] = vehicle.start_m_s**2
    gain = 2.0 * vehicle.acceleration_m_s2 * arc_m  # v² grows by at most 2 a Δs, ahead and looking back
    energy = np.minimum.accumulate(energy - gain) + gain
    energy = (np.minimum.accumulate((energy + gain)[::-1]))[::-1] - gain
    speed = np.sqrt(np.maximum(energy, 0.0))
    taken_s = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(arc_m) / (speed[1:] + speed[:-1]))])
    times_s = np.arange(-_MARGIN_S, duration_s + _MARGIN_S, _STEP_S)
    begun_s = times_s - _HOLD_S - vehicle.standstill_s
    eased = gaussian_filter1d(np.interp(begun_s, taken_s, speed), _EASE_S / _STEP_S)
    reached_m = cumulative_trapezoid(eased, dx=_STEP_S, initial=0.0)
    return make_interp_spline(times_s, reached_m, k=3)


class Pivot(NamedTuple):
    """A turn on the spot, then a straight move."""

    turn_deg: float
    ahead_m: float


class Pivots:
    """Turns and short moves from the origin, heading along x: ``steps`` that end as they began, repeated."""

    def __init__(
        self,
        steps: tuple[Pivot, ...],
        vehicle: Vehicle,
        solids: Solids,
        *,
        duration_s: float,
        rng: np.random.Generator,
    ) -> None:
        self._vehicle = vehicle
        self._solids = solids
        self._phases = rng.uniform(0.0, 2.0 * np.pi, 5)
        lap = np.vstack([_rates(step, vehicle) for step in steps])
        laps = int((duration_s + 2.0) / (len(lap) * _PIVOT_STEP_S)) + 1
        rates = np.vstack([np.zeros((round(_FIRST_PAUSE_S / _PIVOT_STEP_S), 2)), *[lap] * laps])
        eased = np.asarray(gaussian_filter1d(rates, _PIVOT_EASE_S / _PIVOT_STEP_S, axis=0))
        turning, moving = eased[:, 0], eased[:, 1]
        times_s = np.arange(len(rates)) * _PIVOT_STEP_S
        heading = cumulative_trapezoid(turning, dx=_PIVOT_STEP_S, initial=0.0)
        velocity = moving[:, np.newaxis] * np.column_stack([np.cos(heading), np.sin(heading)])
        place = cumulative_trapezoid(velocity, dx=_PIVOT_STEP_S, axis=0, initial=0.0)
        self._heading = make_interp_spline(times_s, heading, k=3)
        self._place = make_interp_spline(times_s, place, k=3)

    def speed_m_s(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Speed along the path at (N,) instants; 0 while it turns."""
        return np.linalg.norm(self._place(times_s, 1), axis=1)

    def base(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_base at (N,) instants, (N, 4, 4): z normal to the ground."""
        heading = self._heading(times_s)
        forward = np.column_stack([np.cos(heading), np.sin(heading)])
        poses = stand_on_ground(self._place(times_s), forward, self._solids)
        share = self.speed_m_s(times_s) / self._vehicle.speed_m_s
        return poses @ lie.exp(sway(self._vehicle, self._phases, times_s, share))

    def lidar(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_lidar at (N,) instants, (N, 4, 4)."""
        return self.base(times_s) @ self._vehicle.T_base_lidar


def _rates(step: Pivot, vehicle: Vehicle) -> Matrix:
    """Turning and moving speeds (T, 2) of one step, each followed by a pause."""
    turn = _trapezoid(np.deg2rad(step.turn_deg), TURN_RAD_S, _TURN_RAD_S2)
    ahead = _trapezoid(step.ahead_m, vehicle.speed_m_s, vehicle.acceleration_m_s2)
    rates = np.zeros((len(turn) + len(ahead), 2))
    rates[: len(turn), 0] = turn
    rates[len(turn) :, 1] = ahead
    return rates


def _trapezoid(distance: float, limit: float, acceleration: float) -> NDArray[np.float64]:
    """Speeds, ``_PIVOT_STEP_S`` apart, that cover the distance within both limits; then a pause."""
    peak = min(limit, np.sqrt(abs(distance) * acceleration))
    if peak == 0.0:
        return np.zeros(0)
    taken_s = abs(distance) / peak + peak / acceleration
    times_s = np.arange(0.0, taken_s, _PIVOT_STEP_S)
    speed = np.minimum(peak, acceleration * np.minimum(times_s, taken_s - times_s))
    speed *= distance / (np.sum(speed) * _PIVOT_STEP_S)
    return np.concatenate([speed, np.zeros(round(_PAUSE_S / _PIVOT_STEP_S))])
