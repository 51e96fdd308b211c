"""A smooth drive along a route, whose pose is known at any instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d

from pipeline import lie
from pipeline.data import Matrix
from pipeline.simulate.solids import Solids

_HOLD_S = 1.0  # standstill at the beginning, as long as the easing reaches
_STEP_S = 0.02  # spacing of the speed profile
_EASE_S = 0.25  # standard deviation of the smoothing that makes the acceleration continuous


@dataclass(frozen=True, slots=True)
class Vehicle:
    """How a robot or a car moves, and where its lidar sits.

    Attributes
    ----------
    speed_m_s, acceleration_m_s2, lateral_acceleration_m_s2 : limits along the way and in bends
    corner_m : standard deviation of the smoothing that rounds the route; a right angle gets 0.9 of it as radius
    wander_m : how far it strays from the route, differently on every lap
    sway_rad, heave_m : roll, pitch and height of the body at full speed, amplitudes
    radius_m : half its width
    T_base_lidar : (4, 4)
    """

    speed_m_s: float
    acceleration_m_s2: float
    lateral_acceleration_m_s2: float
    corner_m: float
    wander_m: float
    sway_rad: float
    heave_m: float
    radius_m: float
    T_base_lidar: Matrix


class Motion:
    """A drive round a closed ``route`` (W, 2), lap after lap, from standstill."""

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
        self._phases = rng.uniform(0.0, 2.0 * np.pi, 3)
        reach_m = vehicle.speed_m_s * duration_s + 10.0 * vehicle.corner_m
        line = _wander(_densify(route, reach_m, 0.02 * vehicle.corner_m), vehicle, rng)
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
        xy = self._position(arc_m)
        forward = self._position(arc_m, 1)
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        poses = _on_ground(xy, forward, self._solids)
        if self._vehicle.sway_rad > 0.0 or self._vehicle.heave_m > 0.0:
            poses = poses @ lie.exp(self._sway(times_s))
        return poses

    def lidar(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_lidar at (N,) instants, (N, 4, 4)."""
        return self.base(times_s) @ self._vehicle.T_base_lidar

    def _sway(self, times_s: NDArray[np.floating]) -> Matrix:
        """Twists (N, 6) of the body on its springs: heave at 1.3 Hz, roll at 0.9 Hz, pitch at 1.1 Hz."""
        share = self.speed_m_s(times_s) / self._vehicle.speed_m_s
        twist = np.zeros((len(times_s), 6))
        for column, hertz, size, phase in zip(
            (2, 3, 4),
            (1.3, 0.9, 1.1),
            (self._vehicle.heave_m, self._vehicle.sway_rad, self._vehicle.sway_rad),
            self._phases,
            strict=True,
        ):
            twist[:, column] = share * size * np.sin(2.0 * np.pi * hertz * times_s + phase)
        return twist


def _densify(route: Matrix, reach_m: float, step_m: float) -> Matrix:
    """Points every ``step_m`` along as many laps of the closed route as ``reach_m`` takes."""
    lap = np.vstack([route, route[:1]])
    corners_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lap, axis=0), axis=1))])
    along_m = np.arange(0.0, reach_m, step_m) % corners_m[-1]
    return np.stack([np.interp(along_m, corners_m, lap[:, axis]) for axis in (0, 1)], axis=1)


def _wander(line: Matrix, vehicle: Vehicle, rng: np.random.Generator) -> Matrix:
    """The line shifted by slow waves, at most ``wander_m`` in x and in y."""
    place = np.arange(len(line)) / 50.0  # in units of corner_m
    shift = np.zeros_like(line)
    for axis in (0, 1):
        for wavelength in rng.uniform(8.0, 30.0, 3):
            shift[:, axis] += np.sin(2.0 * np.pi * (place / wavelength + rng.uniform())) / 3.0
    return line + vehicle.wander_m * shift


def _drive(position: BSpline, arc_m: NDArray[np.float64], vehicle: Vehicle, duration_s: float) -> BSpline:
    """Arc length over time: as fast as the limits allow, then eased so that the acceleration is continuous."""
    first, second = position(arc_m, 1), position(arc_m, 2)
    bend = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    energy = np.minimum(vehicle.speed_m_s**2, vehicle.lateral_acceleration_m_s2 / np.maximum(bend, 1e-9))
    energy[0] = 0.0
    gain = 2.0 * vehicle.acceleration_m_s2 * arc_m  # v² grows by at most 2 a Δs, ahead and looking back
    energy = np.minimum.accumulate(energy - gain) + gain
    energy = (np.minimum.accumulate((energy + gain)[::-1]))[::-1] - gain
    speed = np.sqrt(np.maximum(energy, 0.0))
    taken_s = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(arc_m) / (speed[1:] + speed[:-1]))])
    times_s = np.arange(-2.0, duration_s + 2.0, _STEP_S)
    eased = gaussian_filter1d(np.interp(times_s - _HOLD_S, taken_s, speed), _EASE_S / _STEP_S)
    reached_m = cumulative_trapezoid(eased, dx=_STEP_S, initial=0.0)
    return make_interp_spline(times_s, reached_m, k=3)


def _on_ground(xy: Matrix, forward: Matrix, solids: Solids) -> Matrix:
    """Poses (N, 4, 4) that stand on the ground and look along ``forward`` (N, 2)."""
    slope = solids.ground_slope(xy)
    ahead = np.column_stack([forward, np.sum(slope * forward, axis=1)])
    up = np.column_stack([-slope, np.ones(len(xy))])
    poses = np.zeros((len(xy), 4, 4))
    poses[:, :3, 0] = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    poses[:, :3, 2] = up / np.linalg.norm(up, axis=1, keepdims=True)
    poses[:, :3, 1] = np.cross(poses[:, :3, 2], poses[:, :3, 0])
    poses[:, :2, 3] = xy
    poses[:, 2, 3] = solids.ground_height(xy)
    poses[:, 3, 3] = 1.0
    return poses
