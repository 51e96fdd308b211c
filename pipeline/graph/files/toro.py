"""TORO's way of writing a pose graph, to and from g2o's numbers: another order of Ω in 2D, Euler angles in 3D."""

from __future__ import annotations

from math import atan2, cos, hypot, sin

import numpy as np
from numpy.typing import NDArray

TORO_VERTICES = {2: "VERTEX2", 3: "VERTEX3"}
TORO_EDGES = {2: "EDGE2", 3: "EDGE3"}
_IN_THE_PLANE = [0, 1, 4, 2, 5, 3]  # TORO's xx xy yy θθ xθ yθ as the upper triangle xx xy xθ yy yθ θθ


def from_toro(numbers: list[float], dimension: int) -> list[float]:
    """A vertex' or an edge's numbers as g2o has them: x y z qx qy qz qw, Ω row by row."""
    if dimension == 2:
        return numbers[:3] + [numbers[3:][place] for place in _IN_THE_PLANE[: len(numbers) - 3]]
    return numbers[:3] + _quaternion(*numbers[3:6]) + numbers[6:]


def to_toro_angles(R: NDArray[np.float64]) -> list[float]:
    """Roll, pitch and yaw with R = Rz(yaw) Ry(pitch) Rx(roll); exact at a pitch of ±π/2 too, where one is free."""
    yaw = atan2(R[1, 0], R[0, 0]) if hypot(R[0, 0], R[1, 0]) > 1e-9 else 0.0
    c, s = cos(yaw), sin(yaw)
    pitch = atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return [roll, pitch, yaw]


def to_toro_triangle(upper: list[float]) -> list[float]:
    """Ω of an edge, upper triangle row by row, in TORO's order."""
    if len(upper) != len(_IN_THE_PLANE):
        return upper
    result = [0.0] * len(upper)
    for value, place in zip(upper, _IN_THE_PLANE, strict=True):
        result[place] = value
    return result


def _quaternion(roll: float, pitch: float, yaw: float) -> list[float]:
    """Quaternion xyzw of Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = cos(0.5 * roll), sin(0.5 * roll)
    cp, sp = cos(0.5 * pitch), sin(0.5 * pitch)
    cy, sy = cos(0.5 * yaw), sin(0.5 * yaw)
    return [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
