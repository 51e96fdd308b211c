"""Wheel odometry: the drive as the wheels count it, which drifts."""

from __future__ import annotations

import numpy as np

from scanchain import lie
from scanchain.data import Matrix

_SCALE_SHARE = 0.01  # of the distance: wheels are not as large as believed
_TURN_SHARE = 0.02  # of the angle: nor as far apart
_BIAS_RAD_PER_M = 0.0005  # one wheel is larger than the other
_NOISE_M = 0.01  # slip along the way, per √m
_NOISE_RAD = 0.004  # slip in heading, per √m


def wheel_odometry(T_world_base: Matrix, *, drift: float, rng: np.random.Generator) -> Matrix:
    """T_odom_base (N, 3, 3) that wheels report for the poses (N, 4, 4), starting at the identity.

    Each step is wrong by a scale and a bias that stay the same for the whole drive, drawn from ``rng``, and by
    noise that grows with the root of the distance. ``drift`` multiplies every error; 0 is the planar truth.
    """
    planar = lie.flatten(T_world_base)
    steps = lie.inverse(planar[:-1]) @ planar[1:]
    traveled = np.linalg.norm(steps[:, :2, 2], axis=1)
    scale, turn, bias = drift * rng.choice([-1.0, 1.0], 3) * rng.uniform(0.5, 1.5, 3)
    noise = drift * np.sqrt(traveled)[:, None] * rng.standard_normal((len(steps), 2))
    moved = steps[:, :2, 2] * (1.0 + scale * _SCALE_SHARE)
    moved[:, 0] += _NOISE_M * noise[:, 0]
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
