"""Motion of a vehicle on the ground, and the odometry that its wheels report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.simulation.solids import Solids

_HERTZ = {2: 1.3, 3: 0.9, 4: 1.1, 1: 0.8, 5: 0.6}  # of the sway, by twist axis

_SCALE_SHARE = 0.01  # error of the distance as a share: wheels are not as large as assumed
_TURN_SHARE = 0.02  # error of the angle as a share: nor as far apart
_BIAS_RAD_PER_M = 0.0005  # turn for each meter, as one wheel is larger than the other
_NOISE_M = 0.01  # slip along the path, per √m
_NOISE_RAD = 0.004  # slip in heading, per √m


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Kinematics of a robot, a car or a walking person, and the mounting of the lidar.

    Attributes
    ----------
    speed_m_s, acceleration_m_s2, lateral_acceleration_m_s2 : limits along the path and in bends
    corner_m : standard deviation of the smoothing that rounds the route; a right angle gets 0.9 of it as radius
    deviation_m : how far it strays from the route, differently on every lap
    sway_rad, heave_m : roll, pitch and height of the body at full speed, amplitudes
    radius_m : half its width
    T_base_lidar : (4, 4)
    swing_rad, swing_m : heading and sideways motion of the body at full speed, amplitudes
    start_m_s : speed at the first instant
    standstill_s : how long it stands before it sets off
    """

    speed_m_s: float
    acceleration_m_s2: float
    lateral_acceleration_m_s2: float
    corner_m: float
    deviation_m: float
    sway_rad: float
    heave_m: float
    radius_m: float
    T_base_lidar: Matrix
    swing_rad: float = 0.0
    swing_m: float = 0.0
    start_m_s: float = 0.0
    standstill_s: float = 0.0


def mount(x_m: float, z_m: float) -> Matrix:
    """T_base_lidar (4, 4) of a lidar that looks ahead, so far before and above the base."""
    return np.array([[1.0, 0, 0, x_m], [0, 1, 0, 0], [0, 0, 1, z_m], [0, 0, 0, 1]])


class Motion(Protocol):
    """A motion whose pose is known at any instant."""

    def speed_m_s(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Speed along the path at (N,) instants."""
        ...

    def base(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_base at (N,) instants, (N, 4, 4)."""
        ...

    def lidar(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_lidar at (N,) instants, (N, 4, 4)."""
        ...


def sway(
    vehicle: Vehicle, phases: NDArray[np.float64], times_s: NDArray[np.floating], share: NDArray[np.float64]
) -> Matrix:
    """Twists (N, 6) of a body on its springs or legs, as large as the ``share`` (N,) of the full speed.

    Heave at 1.3 Hz, roll at 0.9 Hz, pitch at 1.1 Hz, sideways at 0.8 Hz, heading at 0.6 Hz; ``phases`` (5,).
    """
    sizes = (vehicle.heave_m, vehicle.sway_rad, vehicle.sway_rad, vehicle.swing_m, vehicle.swing_rad)
    twist = np.zeros((len(times_s), 6))
    for (column, hertz), size, phase in zip(_HERTZ.items(), sizes, phases, strict=True):
        if size > 0.0:
            twist[:, column] = share * size * np.sin(2.0 * np.pi * hertz * times_s + phase)
    return twist


def stand(xy: Matrix, height_m: NDArray[np.float64], slope: Matrix, forward: Matrix) -> Matrix:
    """Poses (N, 4, 4) at that height that look along ``forward`` (N, 2), z normal to a ``slope`` (N, 2)."""
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


def stand_on_ground(xy: Matrix, forward: Matrix, solids: Solids) -> Matrix:
    """Poses (N, 4, 4) that stand on the ground and look along ``forward`` (N, 2)."""
    return stand(xy, solids.ground_height(xy), solids.ground_slope(xy), forward)


def wheel_odometry(
    T_world_base: Matrix, *, drift: float, rng: np.random.Generator, slips_m: NDArray[np.floating] | float = 0.0
) -> Matrix:
    """T_odom_base (N, 3, 3) that wheels report for the poses (N, 4, 4), starting at the identity.

    Each step is wrong by a scale and a bias that stay the same for the whole drive, drawn from ``rng``, and by
    noise that grows with the root of the distance. ``drift`` multiplies every error; 0 is the planar truth.
    ``slips_m`` (N-1,) is what they turn ahead in a step without moving the vehicle, below 0 what they do not turn.
    """
    planar = lie.flatten(T_world_base)
    steps = lie.inverse(planar[:-1]) @ planar[1:]
    traveled = np.linalg.norm(steps[:, :2, 2], axis=1)
    scale, turn, bias = drift * rng.choice([-1.0, 1.0], 3) * rng.uniform(0.5, 1.5, 3)
    noise = drift * np.sqrt(traveled)[:, None] * rng.standard_normal((len(steps), 2))
    moved = steps[:, :2, 2] * (1.0 + scale * _SCALE_SHARE)
    moved[:, 0] += _NOISE_M * noise[:, 0] + slips_m
    turned = (
        lie.yaw(steps) * (1.0 + turn * _TURN_SHARE) + bias * _BIAS_RAD_PER_M * traveled + _NOISE_RAD * noise[:, 1]
    )
    heading = np.concatenate([[0.0], np.cumsum(turned)])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    ahead = np.stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1]], axis=1)
    poses = np.zeros_like(planar)
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(heading)
    poses[:, 1, 0] = np.sin(heading)
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[1:, :2, 2] = np.cumsum(ahead, axis=0)
    poses[:, 2, 2] = 1.0
    return poses
