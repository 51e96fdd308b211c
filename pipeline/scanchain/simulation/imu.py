"""Simulated IMUs: angular velocity and specific force along a motion, with the errors and faults of each model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.simulation.motion import Motion

GRAVITY_M_S2 = np.array([0.0, 0.0, 9.81])  # specific force at rest, in the world frame
_STANDARD_GRAVITY_M_S2 = 9.80665  # the unit g
_STEP_S = 1e-3  # of the differences of poses


def _mount(position_m: tuple[float, float, float], yaw_pitch_roll_deg: tuple[float, float, float]) -> Matrix:
    """T_base_imu (4, 4): turned about z, then about its own y, then about its own x."""
    T = np.eye(4)
    for axis, angle_deg in zip((5, 4, 3), yaw_pitch_roll_deg, strict=True):
        T = T @ lie.exp(np.deg2rad(angle_deg) * np.eye(6)[axis])
    T[:3, 3] = position_m
    return T


class Errors(NamedTuple):
    """Errors of the three gyros or accelerometers, independent of each other; their unit u is rad/s or m/s².

    noise : density of the white noise, u/√Hz
    bias : standard deviation at the start, u
    walk : of the bias, u/s/√Hz
    """

    noise: float
    bias: float
    walk: float


@dataclass(frozen=True, slots=True)
class ImuModel:
    """An IMU and its mounting.

    T_base_imu : (4, 4); in /tf_static only if ``is_transform_known``
    rate_scale, acceleration_scale : of the published values, other than 1 for a wrong unit or sign
    rate_limit_rad_s : largest angular velocity about each axis
    delay_ns : of the stamps
    freeze_s : time of the drive after which the values no longer change
    """

    T_base_imu: Matrix
    gyro: Errors
    accelerometer: Errors
    period_ns: int = 5_000_000  # 200 Hz
    rate_limit_rad_s: float = np.inf
    rate_scale: float = 1.0
    acceleration_scale: float = 1.0
    delay_ns: int = 0
    freeze_s: float = np.inf
    is_transform_known: bool = True

    def measure(self, motion: Motion, instants_s: NDArray[np.floating], rng: np.random.Generator) -> ImuSamples:
        """Samples (N,) along a motion, ``period_ns`` apart."""
        blocks = np.array_split(instants_s, len(instants_s) // 20_000 + 1)  # their poses are in memory
        rates, forces = map(np.vstack, zip(*(self._true(motion, block) for block in blocks), strict=True))
        rates += self._disturbed(self.gyro, len(rates), rng)
        forces += self._disturbed(self.accelerometer, len(forces), rng)
        rates = self.rate_scale * np.clip(rates, -self.rate_limit_rad_s, self.rate_limit_rad_s)
        last = int(np.searchsorted(instants_s, self.freeze_s))
        for values in (rates, forces):
            values[last:] = values[last : last + 1]
        return ImuSamples(rates, self.acceleration_scale * forces)

    def _true(self, motion: Motion, instants_s: NDArray[np.floating]) -> tuple[Matrix, Matrix]:
        """Angular velocities and specific forces (N, 3) in the IMU's frame, by central differences."""
        before, now, after = (
            motion.base(instants_s + step_s) @ self.T_base_imu for step_s in (-_STEP_S, 0.0, _STEP_S)
        )
        rates = lie.log(lie.inverse(before) @ after)[:, 3:] / (2.0 * _STEP_S)
        accelerations = (before - 2.0 * now + after)[:, :3, 3] / _STEP_S**2
        return rates, np.einsum("nji,nj->ni", now[:, :3, :3], accelerations + GRAVITY_M_S2)

    def _disturbed(self, errors: Errors, count: int, rng: np.random.Generator) -> Matrix:
        """Bias and noise of each sample (count, 3)."""
        root_s = np.sqrt(self.period_ns * 1e-9)
        bias = errors.bias * rng.standard_normal(3)
        walk = errors.walk * root_s * np.cumsum(rng.standard_normal((count, 3)), axis=0)
        return bias + walk + errors.noise / root_s * rng.standard_normal((count, 3))


class ImuSamples(NamedTuple):
    """Angular velocities (N, 3) and linear accelerations, gravity included, (N, 3) in the IMU's frame."""

    rates_rad_s: Matrix
    accelerations_m_s2: Matrix


# Noise: data sheet of the Bosch BMI055, 0.014 °/s/√Hz and 150 µg/√Hz; the BMI088 has its gyro, ±2000 °/s.
# Biases, calibrated in the factory: Xsens MTi, 0.5 °/s, and 0.2° of roll and pitch at rest, 0.14° of each.
# Walks: Kalibr's example of an imu.yaml.
_MEMS = ImuModel(
    _mount((0.06, -0.04, 0.12), (90.0, -3.0, 4.0)),
    Errors(np.deg2rad(0.014), np.deg2rad(0.5), 4e-6),
    Errors(150e-6 * _STANDARD_GRAVITY_M_S2, 0.024, 2e-4),
    rate_limit_rad_s=np.deg2rad(2000.0),
)
IMUS: dict[str, ImuModel] = {
    "ideal": ImuModel(_MEMS.T_base_imu, Errors(0.0, 0.0, 0.0), Errors(0.0, 0.0, 0.0)),
    "mems": _MEMS,
    "mems-g": replace(_MEMS, acceleration_scale=1.0 / _STANDARD_GRAVITY_M_S2),
    "mems-degrees": replace(_MEMS, rate_scale=float(np.rad2deg(1.0))),
    "mems-sign": replace(_MEMS, rate_scale=-1.0),
    "mems-frozen": replace(_MEMS, freeze_s=10.0),
    "mems-saturated": replace(_MEMS, rate_limit_rad_s=np.deg2rad(60.0)),
    "mems-late": replace(_MEMS, delay_ns=300_000_000),
    "mems-half-late": replace(_MEMS, delay_ns=_MEMS.period_ns // 2),
    "mems-vibration": replace(
        _MEMS, gyro=_MEMS.gyro._replace(noise=0.0035), accelerometer=_MEMS.accelerometer._replace(noise=0.2)
    ),
    "mems-no-transform": replace(
        _MEMS, T_base_imu=_mount((0.06, -0.04, 0.12), (90.0, 0.0, 90.0)), is_transform_known=False
    ),
}
