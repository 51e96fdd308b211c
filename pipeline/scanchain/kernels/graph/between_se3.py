"""Between factors in SE(3): residuals and Jacobians of e = log(Z⁻¹ T_i⁻¹ T_j), compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.geometry.pose_log import second_coefficient, twist_3d

_Array = NDArray[np.float64]


@njit(nogil=True)
def residuals(poses: _Array, edges: NDArray[np.int64], measurements: _Array, errors: _Array) -> None:
    """Fill e = (ρ, φ) = log(Z⁻¹ T_i⁻¹ T_j) of every edge.

    poses (K, 4, 4), edges (E, 2) pose indices (i, j), measurements (E, 4, 4) Z, errors (E, 6) filled: m, rad
    """
    E = np.empty((3, 4))
    for e in range(edges.shape[0]):
        _relative(poses[edges[e, 0]], poses[edges[e, 1]], measurements[e], E)
        twist_3d(E, errors[e])


@njit(nogil=True)
def jacobians(poses: _Array, edges: NDArray[np.int64], errors: _Array, jacobian: _Array) -> None:
    """Fill ∂e/∂ξ_j = J_r(e)⁻¹ Ad(T_j⁻¹) for left twists, T_j ← exp(ξ_j) T_j; ∂e/∂ξ_i is its negative.

    J_r(e)⁻¹ = J_l(−e)⁻¹ = [C, −C Q C; 0, C] with C = J_l(−φ)⁻¹ and Q(−ρ, −φ) (Barfoot 2017, eq. 7.86, 7.95).
    Moving i and j by one and the same left twist leaves T_i⁻¹ T_j as it is, hence the sign.

    poses (K, 4, 4), edges (E, 2), errors (E, 6) of ``residuals``, jacobian (E, 6, 6) filled
    """
    C, Q, work = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for e in range(edges.shape[0]):
        error, J, T = errors[e], jacobian[e], poses[edges[e, 1]]
        _inverse_left_jacobian(-error[3], -error[4], -error[5], C)
        _coupling(error, Q)
        _multiply(Q, C, work)
        _multiply(C, work, Q)  # C Q C
        J.fill(0.0)
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    J[a, b] += C[a, c] * T[b, c]
                    J[a, b + 3] -= Q[a, c] * T[b, c]
            for b in range(3):
                J[a + 3, b + 3] = J[a, b]
            # Ad(T⁻¹) has −Rᵀ [t]× in its corner: row a of C Rᵀ times −[t]×
            J[a, 3] -= J[a, 1] * T[2, 3] - J[a, 2] * T[1, 3]
            J[a, 4] -= J[a, 2] * T[0, 3] - J[a, 0] * T[2, 3]
            J[a, 5] -= J[a, 0] * T[1, 3] - J[a, 1] * T[0, 3]


@njit(nogil=True)
def _relative(T_i: _Array, T_j: _Array, Z: _Array, E: _Array) -> None:
    """Fill E (3, 4), the upper rows of Z⁻¹ T_i⁻¹ T_j."""
    for a in range(3):
        x = y = z = 0.0
        for c in range(3):
            x += T_i[0, c] * Z[c, a]
            y += T_i[1, c] * Z[c, a]
            z += T_i[2, c] * Z[c, a]
        for b in range(3):
            E[a, b] = x * T_j[0, b] + y * T_j[1, b] + z * T_j[2, b]
        t = x * (T_j[0, 3] - T_i[0, 3]) + y * (T_j[1, 3] - T_i[1, 3]) + z * (T_j[2, 3] - T_i[2, 3])
        E[a, 3] = t - Z[0, a] * Z[0, 3] - Z[1, a] * Z[1, 3] - Z[2, a] * Z[2, 3]


@njit(nogil=True)
def _inverse_left_jacobian(p: float, q: float, r: float, C: _Array) -> None:
    """Fill C = J_l(φ)⁻¹ = I − ½ [φ]× + k [φ]×² of SO(3)."""
    theta2 = p * p + q * q + r * r
    k = second_coefficient(theta2)
    diagonal = 1.0 - k * theta2
    C[0, 0], C[1, 1], C[2, 2] = diagonal + k * p * p, diagonal + k * q * q, diagonal + k * r * r
    C[0, 1], C[1, 0] = k * p * q + 0.5 * r, k * p * q - 0.5 * r
    C[0, 2], C[2, 0] = k * p * r - 0.5 * q, k * p * r + 0.5 * q
    C[1, 2], C[2, 1] = k * q * r + 0.5 * p, k * q * r - 0.5 * p


@njit(nogil=True)
def _coupling(error: _Array, Q: _Array) -> None:
    """Fill Q(−ρ, −φ) (Barfoot 2017, eq. 7.86b).

    With A = [−ρ]× and B = [−φ]×, Q = ½A + a (BA + AB + BAB) + b (BBA + ABB − 3 BAB) + c (BABB + BBAB); and,
    without matrix products, AB + BA = ρφᵀ + φρᵀ − 2(ρ·φ)I,  BAB = −(ρ·φ)B,
    BBA + ABB = −θ²A − (ρ·φ)B,  BB = φφᵀ − θ²I.
    """
    x, y, z = -error[0], -error[1], -error[2]
    p, q, r = -error[3], -error[4], -error[5]
    theta2 = p * p + q * q + r * r
    a, b, c = _coupling_coefficients(theta2)
    dot = x * p + y * q + z * r
    skew = (2.0 * b - a) * dot
    square = -2.0 * c * dot
    k = 0.5 - b * theta2
    u, v, w = k * x + skew * p, k * y + skew * q, k * z + skew * r
    diagonal = -2.0 * a * dot - square * theta2
    Q[0, 0] = 2.0 * a * x * p + square * p * p + diagonal
    Q[1, 1] = 2.0 * a * y * q + square * q * q + diagonal
    Q[2, 2] = 2.0 * a * z * r + square * r * r + diagonal
    xy = a * (x * q + y * p) + square * p * q
    xz = a * (x * r + z * p) + square * p * r
    yz = a * (y * r + z * q) + square * q * r
    Q[0, 1], Q[1, 0] = xy - w, xy + w
    Q[0, 2], Q[2, 0] = xz + v, xz - v
    Q[1, 2], Q[2, 1] = yz - u, yz + u


@njit(nogil=True)
def _coupling_coefficients(theta2: float) -> tuple[float, float, float]:
    """(θ − sin θ)/θ³, (θ² + 2 cos θ − 2)/(2θ⁴), (2θ − 3 sin θ + θ cos θ)/(2θ⁵), by series below 0.1 rad."""
    if theta2 < 1e-2:
        a = 1.0 / 6.0 - theta2 / 120.0 * (1.0 - theta2 / 42.0 * (1.0 - theta2 / 72.0))
        b = 1.0 / 24.0 - theta2 / 720.0 * (1.0 - theta2 / 56.0 * (1.0 - theta2 / 90.0))
        c = 1.0 / 120.0 - theta2 / 2520.0 + theta2 * theta2 / 120960.0
        return a, b, c
    theta = np.sqrt(theta2)
    sine, cosine = np.sin(theta), np.cos(theta)
    a = (theta - sine) / (theta2 * theta)
    b = (theta2 + 2.0 * cosine - 2.0) / (2.0 * theta2 * theta2)
    c = (2.0 * theta - 3.0 * sine + theta * cosine) / (2.0 * theta2 * theta2 * theta)
    return a, b, c


@njit(nogil=True)
def _multiply(A: _Array, B: _Array, out: _Array) -> None:
    """Fill out = A B, 3 × 3."""
    for a in range(3):
        for b in range(3):
            out[a, b] = A[a, 0] * B[0, b] + A[a, 1] * B[1, b] + A[a, 2] * B[2, b]
