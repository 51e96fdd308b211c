"""SE(2) and SE(3) as homogeneous matrices; twists are (translation, rotation), perturbations act from the left.

A left perturbation ξ changes a pose by T ← exp(ξ) T. Every function takes SE(2) as (3, 3) matrices and SE(3) as
(4, 4) matrices, one or a stack of them: (..., d+1, d+1). Formulas follow Barfoot, State Estimation for Robotics
(2017), ch. 7, and Sola et al., A micro Lie theory (2018).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix, Pose
from scanchain.kernels import geometry

_SMALL = 1e-8  # rad; below this angle the series replaces the closed form


def identity(dimension: int) -> Pose:
    """The identity pose."""
    return np.eye(dimension + 1)


def inverse(T: Pose) -> Pose:
    """T⁻¹ = [Rᵀ, −Rᵀt; 0, 1]."""
    if T.ndim == 2:
        return geometry.inverse(np.ascontiguousarray(T, np.float64))
    d = T.shape[-1] - 1
    result = np.zeros(T.shape)
    R_t = np.swapaxes(T[..., :d, :d], -1, -2)
    result[..., :d, :d] = R_t
    result[..., :d, d] = -(R_t @ T[..., :d, d, None])[..., 0]
    result[..., d, d] = 1.0
    return result


def between(T_a: Pose, T_b: Pose) -> Pose:
    """The motion T_a⁻¹ T_b from one pose to another, in the former's frame."""
    if T_a.ndim == T_b.ndim == 2:
        return geometry.between(np.ascontiguousarray(T_a, np.float64), np.ascontiguousarray(T_b, np.float64))
    return inverse(T_a) @ T_b


def apart(T_a: Pose, T_b: Pose) -> tuple[float, float]:
    """Distance between two poses: meters, and the angle in [0, π] between their rotations."""
    return geometry.apart(np.ascontiguousarray(T_a, np.float64), np.ascontiguousarray(T_b, np.float64))


def agree(T_a: Pose, T_b: Pose, meters: float, radians: float) -> bool:
    """True if two poses are less than that apart."""
    apart_m, apart_rad = apart(T_a, T_b)
    return apart_m < meters and apart_rad < radians


def transform(T: Pose, points: NDArray[np.floating]) -> Matrix:
    """Points (N, d) moved by one pose: R p + t."""
    d = T.shape[-1] - 1
    return points @ T[:d, :d].T + T[:d, d]


def wrap(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same angle in [−π, π)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def pose_2d(x_m: float, y_m: float, yaw_rad: float) -> Pose:
    """SE(2) from coordinates and heading."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, x_m], [s, c, y_m], [0.0, 0.0, 1.0]])


def yaw(T: Pose) -> NDArray[np.float64]:
    """Heading of a pose (or of a stack), rad: the rotation of its x axis in the xy plane."""
    return np.arctan2(T[..., 1, 0], T[..., 0, 0])


def flatten(T: Pose) -> Pose:
    """SE(3) to SE(2): position in the plane and heading."""
    yaw_rad = yaw(T)
    result = np.zeros((*T.shape[:-2], 3, 3))
    result[..., 0, 0] = result[..., 1, 1] = np.cos(yaw_rad)
    result[..., 1, 0] = np.sin(yaw_rad)
    result[..., 0, 1] = -result[..., 1, 0]
    result[..., :2, 2] = T[..., :2, 3]
    result[..., 2, 2] = 1.0
    return result


def lift(T: Pose) -> Pose:
    """SE(2) to SE(3) in the plane z = 0; an SE(3) pose is returned as it is."""
    if T.shape[-1] == 4:
        return T
    result = np.zeros((*T.shape[:-2], 4, 4))
    result[..., :2, :2] = T[..., :2, :2]
    result[..., :2, 3] = T[..., :2, 2]
    result[..., 2, 2] = result[..., 3, 3] = 1.0
    return result


def lift_points(points: NDArray[np.floating]) -> Matrix:
    """Points (N, 2) of the plane as (N, 3) with z = 0; a copy of those in space (N, 3)."""
    result = np.zeros((len(points), 3))
    result[:, : points.shape[1]] = points
    return result


def rotation_angle(T: Pose) -> NDArray[np.float64]:
    """Angle of a pose's rotation, rad, in [0, π]; accurate near 0 and near π."""
    if T.shape[-1] == 3:
        return np.abs(yaw(T))
    return np.linalg.norm(_log_se3(T)[..., 3:], axis=-1)


def hat(v: NDArray[np.float64]) -> Matrix:
    """The skew matrix with hat(v) w = v × w, (..., 3) → (..., 3, 3)."""
    result = np.zeros((*v.shape[:-1], 3, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    result[..., 0, 1], result[..., 0, 2] = -z, y
    result[..., 1, 0], result[..., 1, 2] = z, -x
    result[..., 2, 0], result[..., 2, 1] = -y, x
    return result


def exp(twist: NDArray[np.float64]) -> Pose:
    """The pose of a twist (..., 3) or (..., 6): R = exp(φ), t = V(φ) ρ (Barfoot 2017, eq. 7.86)."""
    return _exp_se2(twist) if twist.shape[-1] == 3 else _exp_se3(twist)


def log(T: Pose) -> NDArray[np.float64]:
    """The twist of a pose, exp's inverse: φ = log(R), ρ = V(φ)⁻¹ t; rotation angle in [0, π]."""
    return _log_se2(T) if T.shape[-1] == 3 else _log_se3(T)


def twist_size(T: Pose) -> int:
    """Entries of the twists of a pose, k: 3 in the plane, 6 in space."""
    return 3 if T.shape[-1] == 3 else 6


def by_component(k: int, meters: float, radians: float) -> NDArray[np.float64]:
    """One number for every entry of a twist (k,): that of lengths, then that of angles."""
    d = 2 if k == 3 else 3
    return np.array([meters] * d + [radians] * (k - d))


def adjoint(T: Pose) -> Matrix:
    """Ad with T exp(ξ) T⁻¹ = exp(Ad ξ); (..., k, k)."""
    if T.ndim == 2:
        return geometry.adjoint(np.ascontiguousarray(T, np.float64))
    d = T.shape[-1] - 1
    R, t = T[..., :d, :d], T[..., :d, d]
    k = twist_size(T)
    result = np.zeros((*T.shape[:-2], k, k))
    result[..., :d, :d] = R
    if d == 2:
        result[..., 0, 2], result[..., 1, 2] = t[..., 1], -t[..., 0]
        result[..., 2, 2] = 1.0
    else:
        result[..., :3, 3:] = hat(t) @ R
        result[..., 3:, 3:] = R
    return result


def normalize(T: Pose) -> Pose:
    """The pose with its rotation made orthonormal again, after many products."""
    result = np.array(T, np.float64, order="C")
    geometry.orthonormalize(result)
    return result


def interpolate(T_a: Pose, T_b: Pose, share: float) -> Pose:
    """The pose at a ``share`` of the motion from T_a to T_b, along the screw that joins them."""
    return exp(share * log(T_b @ inverse(T_a))) @ T_a


def to_quaternion(R: Matrix) -> NDArray[np.float64]:
    """Unit quaternions xyzw of rotation matrices (..., 3, 3); w ≥ 0."""
    result = np.empty((*R.shape[:-2], 4))
    geometry.quaternions(_stack(R), result.reshape(-1, 4))
    return result


def from_quaternion(quat_xyzw: NDArray[np.float64]) -> Matrix:
    """Rotation matrices (..., 3, 3) of quaternions xyzw (..., 4); normalized first."""
    q = quat_xyzw / np.linalg.norm(quat_xyzw, axis=-1, keepdims=True)
    K = hat(q[..., :3])
    return np.eye(3) + 2.0 * (q[..., 3, None, None] * K + K @ K)


def _exp_se2(twist: NDArray[np.float64]) -> Pose:
    theta = twist[..., 2]
    a, b = _sinc_and_cosc(theta)
    result = np.zeros((*twist.shape[:-1], 3, 3))
    result[..., 0, 0] = result[..., 1, 1] = np.cos(theta)
    result[..., 1, 0] = np.sin(theta)
    result[..., 0, 1] = -result[..., 1, 0]
    result[..., 0, 2] = a * twist[..., 0] - b * twist[..., 1]
    result[..., 1, 2] = b * twist[..., 0] + a * twist[..., 1]
    result[..., 2, 2] = 1.0
    return result


def _log_se2(T: Pose) -> NDArray[np.float64]:
    if T.ndim == 2:
        return geometry.twist_2d(np.ascontiguousarray(T, np.float64))
    theta = yaw(T)
    half = 0.5 * theta
    small = np.abs(theta) < _SMALL
    c = np.where(small, 1.0, half / np.tan(np.where(small, 1.0, half)))
    x, y = T[..., 0, 2], T[..., 1, 2]
    return np.stack([c * x + half * y, -half * x + c * y, theta], axis=-1)


def _sinc_and_cosc(theta: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sin θ / θ and (1 − cos θ) / θ."""
    small = np.abs(theta) < _SMALL
    safe = np.where(small, 1.0, theta)
    sine = np.where(small, 1.0, np.sin(safe) / safe)
    cosine = np.where(small, 0.5 * theta, 2.0 * np.sin(0.5 * safe) ** 2 / safe)
    return sine, cosine


def _exp_se3(twist: NDArray[np.float64]) -> Pose:
    rho, phi = twist[..., :3], twist[..., 3:]
    theta = np.linalg.norm(phi, axis=-1)[..., None, None]
    a, b, c = _so3_coefficients(theta)
    K = hat(phi)
    K2 = K @ K
    result = np.zeros((*twist.shape[:-1], 4, 4))
    result[..., :3, :3] = np.eye(3) + a * K + b * K2
    result[..., :3, 3] = ((np.eye(3) + b * K + c * K2) @ rho[..., None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def _so3_coefficients(theta: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return sin θ/θ, (1 − cos θ)/θ² and (θ − sin θ)/θ³, by series below 1e-3 rad."""
    small = theta < 1e-3
    safe = np.where(small, 1.0, theta)
    theta2 = theta * theta
    a = np.where(small, 1.0 - theta2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - theta2 / 24.0, 2.0 * np.sin(0.5 * safe) ** 2 / safe**2)
    c = np.where(small, 1.0 / 6.0 - theta2 / 120.0, (safe - np.sin(safe)) / safe**3)
    return a, b, c


def _log_se3(T: Pose) -> NDArray[np.float64]:
    result = np.empty((*T.shape[:-2], 6))
    geometry.twists(_stack(T), result.reshape(-1, 6))
    return result


def _stack(matrices: Matrix) -> Matrix:
    """(..., r, c) as a contiguous (N, r, c)."""
    return np.ascontiguousarray(matrices, dtype=np.float64).reshape(-1, *matrices.shape[-2:])
