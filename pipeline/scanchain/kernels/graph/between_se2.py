"""Between factors in SE(2): residuals and Jacobians of e = log(Z⁻¹ T_i⁻¹ T_j), compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_SMALL = 1e-4  # rad; below this angle the series replaces the closed form


@njit(nogil=True)
def chart_blocks(
    T_i: NDArray[np.float64],
    T_j: NDArray[np.float64],
    Z: NDArray[np.float64],
    r: NDArray[np.float64],
    A: NDArray[np.float64],
    B: NDArray[np.float64],
) -> None:
    """Residual in coordinates and its blocks with respect to (t_i, θ_i) and (t_j, θ_j).

        r = [R_zᵀ (R_iᵀ (t_j − t_i) − t_z),  θ_j − θ_i − θ_z]     angle in (−π, π]
        A = ∂r/∂(t_i, θ_i) = [−R_zᵀ R_iᵀ, R_zᵀ (∂R_iᵀ/∂θ_i)(t_j − t_i); 0, −1]
        B = ∂r/∂(t_j, θ_j) = [R_zᵀ R_iᵀ, 0; 0, 1]                 (Grisetti et al. 2010, eq. 31-33)

    r is also the translation and the angle of E = Z⁻¹ T_i⁻¹ T_j, the argument of the logarithm.

    T_i, T_j, Z : (3, 3) poses, meters; Z maps frame j to frame i
    r (3,), A (3, 3), B (3, 3) : filled
    """
    c_i, s_i, c_z, s_z = T_i[0, 0], T_i[1, 0], Z[0, 0], Z[1, 0]
    dx, dy = T_j[0, 2] - T_i[0, 2], T_j[1, 2] - T_i[1, 2]
    c, s = c_z * c_i - s_z * s_i, s_z * c_i + c_z * s_i  # of R_i R_z
    r[0] = c * dx + s * dy - c_z * Z[0, 2] - s_z * Z[1, 2]
    r[1] = -s * dx + c * dy + s_z * Z[0, 2] - c_z * Z[1, 2]
    r[2] = np.arctan2(c * T_j[1, 0] - s * T_j[0, 0], c * T_j[0, 0] + s * T_j[1, 0])
    B[0, 0], B[0, 1], B[0, 2] = c, s, 0.0
    B[1, 0], B[1, 1], B[1, 2] = -s, c, 0.0
    B[2, 0], B[2, 1], B[2, 2] = 0.0, 0.0, 1.0
    A[0, 0], A[0, 1], A[0, 2] = -c, -s, -s * dx + c * dy
    A[1, 0], A[1, 1], A[1, 2] = s, -c, -c * dx - s * dy
    A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, -1.0


@njit(nogil=True)
def residuals(
    poses: NDArray[np.float64],
    edges: NDArray[np.int64],
    measurements: NDArray[np.float64],
    errors: NDArray[np.float64],
) -> None:
    """Fill e = log(Z⁻¹ T_i⁻¹ T_j) of every edge: V(θ)⁻¹ applied to the coordinates of ``chart_blocks``.

    poses (K, 3, 3), edges (E, 2) pose indices (i, j), measurements (E, 3, 3) Z, errors (E, 3) filled: m, m, rad
    """
    r, A, B = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for e in range(edges.shape[0]):
        chart_blocks(poses[edges[e, 0]], poses[edges[e, 1]], measurements[e], r, A, B)
        cotangent, half = _half_cotangent(r[2]), 0.5 * r[2]
        errors[e, 0] = cotangent * r[0] + half * r[1]
        errors[e, 1] = -half * r[0] + cotangent * r[1]
        errors[e, 2] = r[2]


@njit(nogil=True)
def jacobians(
    poses: NDArray[np.float64],
    edges: NDArray[np.int64],
    measurements: NDArray[np.float64],
    jacobian: NDArray[np.float64],
) -> None:
    """Fill ∂e/∂ξ_j for left twists, T_j ← exp(ξ_j) T_j; ∂e/∂ξ_i is its negative.

    Chain of the logarithm, the block B of ``chart_blocks`` and the left twist, δ(t, θ) = [I, S t; 0, 1] ξ with
    S t = (−t_y, t_x). Moving i and j by one and the same left twist leaves T_i⁻¹ T_j as it is, hence the sign.

    poses (K, 3, 3), edges (E, 2), measurements (E, 3, 3), jacobian (E, 3, 3) filled
    """
    r, A, B = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for e in range(edges.shape[0]):
        T_j = poses[edges[e, 1]]
        chart_blocks(poses[edges[e, 0]], T_j, measurements[e], r, A, B)
        B[0, 2] = -B[0, 0] * T_j[1, 2] + B[0, 1] * T_j[0, 2]
        B[1, 2] = -B[1, 0] * T_j[1, 2] + B[1, 1] * T_j[0, 2]
        cotangent, half, slope = _half_cotangent(r[2]), 0.5 * r[2], _half_cotangent_slope(r[2])
        J = jacobian[e]
        for c in range(3):
            J[0, c] = cotangent * B[0, c] + half * B[1, c]
            J[1, c] = -half * B[0, c] + cotangent * B[1, c]
            J[2, c] = B[2, c]
        J[0, 2] += slope * r[0] + 0.5 * r[1]
        J[1, 2] += -0.5 * r[0] + slope * r[1]


@njit(nogil=True)
def _half_cotangent(theta_rad: float) -> float:
    """(θ/2) / tan(θ/2), the diagonal of V(θ)⁻¹."""
    if abs(theta_rad) < _SMALL:
        return 1.0 - theta_rad * theta_rad / 12.0
    half = 0.5 * theta_rad
    return half * np.cos(half) / np.sin(half)


@njit(nogil=True)
def _half_cotangent_slope(theta_rad: float) -> float:
    """Derivative of (θ/2) / tan(θ/2): (sin θ − θ) / (4 sin²(θ/2))."""
    if abs(theta_rad) < 1e-2:
        return -theta_rad / 6.0 - theta_rad**3 / 180.0
    return (np.sin(theta_rad) - theta_rad) / (4.0 * np.sin(0.5 * theta_rad) ** 2)
