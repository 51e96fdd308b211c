"""Turns on the spot and short straight moves between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

from scanchain import lie
from scanchain.data import Matrix
from scanchain.simulation.motion import Vehicle, stand_on_ground, sway
from scanchain.simulation.solids import Solids

TURN_RAD_S = np.deg2rad(120.0)
_TURN_RAD_S2 = np.deg2rad(400.0)
_STEP_S = 0.005  # spacing of the profiles
_EASE_S = 0.05  # standard deviation of the smoothing that makes the accelerations continuous
_PAUSE_S = 0.4  # between a turn and a move, as long as the easing reaches on both sides
_HOLD_S = 1.0  # standstill at the beginning


class Pivot(NamedTuple):
    """A turn on the spot, then a straight move."""

    turn_deg: float
    ahead_m: float


class Pivots:
    """A dance from the origin, heading along x: ``steps`` that end as they began, over and over again."""

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
        laps = int((duration_s + 2.0) / (len(lap) * _STEP_S)) + 1
        rates = np.vstack([np.zeros((round(_HOLD_S / _STEP_S), 2)), *[lap] * laps])
        eased = np.asarray(gaussian_filter1d(rates, _EASE_S / _STEP_S, axis=0))
        turning, moving = eased[:, 0], eased[:, 1]
        times_s = np.arange(len(rates)) * _STEP_S
        heading = cumulative_trapezoid(turning, dx=_STEP_S, initial=0.0)
        velocity = moving[:, np.newaxis] * np.column_stack([np.cos(heading), np.sin(heading)])
        place = cumulative_trapezoid(velocity, dx=_STEP_S, axis=0, initial=0.0)
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
    """Speeds, ``_STEP_S`` apart, that cover the distance within both limits; then a pause."""
    peak = min(limit, np.sqrt(abs(distance) * acceleration))
    if peak == 0.0:
        return np.zeros(0)
    taken_s = abs(distance) / peak + peak / acceleration
    times_s = np.arange(0.0, taken_s, _STEP_S)
    speed = np.minimum(peak, acceleration * np.minimum(times_s, taken_s - times_s))
    speed *= distance / (np.sum(speed) * _STEP_S)
    return np.concatenate([speed, np.zeros(round(_PAUSE_S / _STEP_S))])
