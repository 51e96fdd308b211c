"""Between factors in SE(2) and SE(3): residuals e = log(Z⁻¹ T_i⁻¹ T_j), Jacobians, normal equations; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.geometry import second_coefficient, twist_3d

_Array = NDArray[np.float64]


@njit(nogil=True)
def residuals_2d(poses: _Array, edges: NDArray[np.int64], measurements: _Array, errors: _Array) -> None:
    """Fill e = log(Z⁻¹ T_i⁻¹ T_j) of every edge: V(θ)⁻¹ applied to translation and angle of the argument.

    poses (K, 3, 3), edges (E, 2) pose indices (i, j), measurements (E, 3, 3) Z, errors (E, 3) filled: m, m, rad
    """
    for e in range(edges.shape[0]):
        x, y, theta, _, _ = _mismatch_2d(poses[edges[e, 0]], poses[edges[e, 1]], measurements[e])
        cotangent, half = _half_cotangent(theta), 0.5 * theta
        errors[e, 0] = cotangent * x + half * y
        errors[e, 1] = -half * x + cotangent * y
        errors[e, 2] = theta


@njit(nogil=True)
def jacobians_2d(poses: _Array, edges: NDArray[np.int64], measurements: _Array, jacobian: _Array) -> None:
    """Fill ∂e/∂ξ_j for left twists, T_j ← exp(ξ_j) T_j; ∂e/∂ξ_i is its negative.

    Chain of the logarithm, of the translation Rᵀ(t_j − …), R = R_i R_z, and of the left twist,
    δ(t, θ) = [I, S t; 0, 1] ξ with S t = (−t_y, t_x). Moving i and j by one and the same left twist leaves
    T_i⁻¹ T_j as it is, hence the sign.

    poses (K, 3, 3), edges (E, 2), measurements (E, 3, 3), jacobian (E, 3, 3) filled
    """
    for e in range(edges.shape[0]):
        T_j, J = poses[edges[e, 1]], jacobian[e]
        x, y, theta, c, s = _mismatch_2d(poses[edges[e, 0]], T_j, measurements[e])
        turned_x, turned_y = -c * T_j[1, 2] + s * T_j[0, 2], s * T_j[1, 2] + c * T_j[0, 2]
        cotangent, half, slope = _half_cotangent(theta), 0.5 * theta, _half_cotangent_slope(theta)
        J[0, 0], J[0, 1] = cotangent * c + half * -s, cotangent * s + half * c
        J[1, 0], J[1, 1] = -half * c + cotangent * -s, -half * s + cotangent * c
        J[0, 2] = cotangent * turned_x + half * turned_y + (slope * x + 0.5 * y)
        J[1, 2] = -half * turned_x + cotangent * turned_y + (-0.5 * x + slope * y)
        J[2, 0], J[2, 1], J[2, 2] = 0.0, 0.0, 1.0


@njit(inline="always")
def _mismatch_2d(T_i: _Array, T_j: _Array, Z: _Array) -> tuple[float, float, float, float, float]:
    """Translation and angle in (−π, π] of Z⁻¹ T_i⁻¹ T_j, and cosine and sine of R_i R_z.

    [R_zᵀ (R_iᵀ (t_j − t_i) − t_z), θ_j − θ_i − θ_z]  (Grisetti et al. 2010, eq. 31)
    """
    c_i, s_i, c_z, s_z = T_i[0, 0], T_i[1, 0], Z[0, 0], Z[1, 0]
    dx, dy = T_j[0, 2] - T_i[0, 2], T_j[1, 2] - T_i[1, 2]
    c, s = c_z * c_i - s_z * s_i, s_z * c_i + c_z * s_i
    x = c * dx + s * dy - c_z * Z[0, 2] - s_z * Z[1, 2]
    y = -s * dx + c * dy + s_z * Z[0, 2] - c_z * Z[1, 2]
    return x, y, np.arctan2(c * T_j[1, 0] - s * T_j[0, 0], c * T_j[0, 0] + s * T_j[1, 0]), c, s


@njit(inline="always")
def _half_cotangent(theta_rad: float) -> float:
    """(θ/2) / tan(θ/2), the diagonal of V(θ)⁻¹."""
    if abs(theta_rad) < 1e-4:  # the series replaces the closed form
        return 1.0 - theta_rad * theta_rad / 12.0
    half = 0.5 * theta_rad
    return half * np.cos(half) / np.sin(half)


@njit(inline="always")
def _half_cotangent_slope(theta_rad: float) -> float:
    """Derivative of (θ/2) / tan(θ/2): (sin θ − θ) / (4 sin²(θ/2))."""
    if abs(theta_rad) < 1e-2:
        return -theta_rad / 6.0 - theta_rad**3 / 180.0
    return (np.sin(theta_rad) - theta_rad) / (4.0 * np.sin(0.5 * theta_rad) ** 2)


@njit(nogil=True)
def residuals_3d(poses: _Array, edges: NDArray[np.int64], measurements: _Array, errors: _Array) -> None:
    """Fill e = (ρ, φ) = log(Z⁻¹ T_i⁻¹ T_j) of every edge.

    poses (K, 4, 4), edges (E, 2) pose indices (i, j), measurements (E, 4, 4) Z, errors (E, 6) filled: m, rad
    """
    E = np.empty((3, 4))
    for e in range(edges.shape[0]):
        _relative(poses[edges[e, 0]], poses[edges[e, 1]], measurements[e], E)
        twist_3d(E, errors[e])


@njit(nogil=True)
def jacobians_3d(poses: _Array, edges: NDArray[np.int64], errors: _Array, jacobian: _Array) -> None:
    """Fill ∂e/∂ξ_j = J_r(e)⁻¹ Ad(T_j⁻¹) for left twists, T_j ← exp(ξ_j) T_j; ∂e/∂ξ_i is its negative.

    J_r(e)⁻¹ = J_l(−e)⁻¹ = [C, −C Q C; 0, C] with C = J_l(−φ)⁻¹ and Q(−ρ, −φ) (Barfoot 2017, eq. 7.86, 7.95).
    Moving i and j by one and the same left twist leaves T_i⁻¹ T_j as it is, hence the sign.

    poses (K, 4, 4), edges (E, 2), errors (E, 6) of ``residuals_3d``, jacobian (E, 6, 6) filled
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


@njit(inline="always")
def _inverse_left_jacobian(p: float, q: float, r: float, C: _Array) -> None:
    """Fill C = J_l(φ)⁻¹ = I − ½ [φ]× + k [φ]×² of SO(3)."""
    theta2 = p * p + q * q + r * r
    k = second_coefficient(theta2)
    diagonal = 1.0 - k * theta2
    C[0, 0], C[1, 1], C[2, 2] = diagonal + k * p * p, diagonal + k * q * q, diagonal + k * r * r
    C[0, 1], C[1, 0] = k * p * q + 0.5 * r, k * p * q - 0.5 * r
    C[0, 2], C[2, 0] = k * p * r - 0.5 * q, k * p * r + 0.5 * q
    C[1, 2], C[2, 1] = k * q * r + 0.5 * p, k * q * r - 0.5 * p


@njit(inline="always")
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


@njit(inline="always")
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


@njit(inline="always")
def _multiply(A: _Array, B: _Array, out: _Array) -> None:
    """Fill out = A B, 3 × 3."""
    for a in range(3):
        for b in range(3):
            out[a, b] = A[a, 0] * B[0, b] + A[a, 1] * B[1, b] + A[a, 2] * B[2, b]


@njit(nogil=True)
def squared_norms(errors: _Array, information: _Array, chi2: _Array) -> None:
    """Fill χ² = eᵀ Ω e of every factor; errors (E, k), information (E, k, k), chi2 (E,)."""
    k = errors.shape[1]
    for f in range(errors.shape[0]):
        e, omega = errors[f], information[f]
        total = 0.0
        for a in range(k):
            row = 0.0
            for b in range(k):
                row += omega[a, b] * e[b]
            total += e[a] * row
        chi2[f] = total


@njit(nogil=True)
def scatter_between(
    jacobian: _Array,
    errors: _Array,
    information: _Array,
    weights: _Array,
    slots: NDArray[np.int64],
    blocks: _Array,
    gradient: _Array,
) -> None:
    """Add every between factor to H = Σ w JᵀΩJ and g = Σ w JᵀΩe.

    With left twists ∂e/∂ξ_i = −∂e/∂ξ_j, so a factor adds M = w JᵀΩJ to both diagonal blocks and −M to the block
    that joins them; M is symmetric, so the order of the pair does not matter.

    jacobian (E, k, k) ∂e/∂ξ_j, errors (E, k), information (E, k, k), weights (E,)
    slots (E, 3) : block of i, block of j, block of the pair; -1 where the pose is fixed
    blocks (B, k, k), gradient (n, k) : added to
    """
    k = errors.shape[1]
    whitened, M, g = np.empty((k, k)), np.empty((k, k)), np.empty(k)
    for f in range(errors.shape[0]):
        _weigh(jacobian[f], errors[f], information[f], weights[f], whitened, M, g)
        i, j, pair = slots[f, 0], slots[f, 1], slots[f, 2]
        for slot, sign in ((i, 1.0), (j, 1.0), (pair, -1.0)):
            for a in range(k if slot >= 0 else 0):
                for b in range(k):
                    blocks[slot, a, b] += sign * M[a, b]
        for slot, sign in ((i, -1.0), (j, 1.0)):
            for a in range(k if slot >= 0 else 0):
                gradient[slot, a] += sign * g[a]


@njit(inline="always")
def _weigh(J: _Array, e: _Array, omega: _Array, weight: float, whitened: _Array, M: _Array, g: _Array) -> None:
    """Fill whitened = w Ω J, M = Jᵀ w Ω J and g = (w Ω J)ᵀ e of one factor."""
    k = e.size
    whitened.fill(0.0)
    M.fill(0.0)
    g.fill(0.0)
    for a in range(k):
        for c in range(k):
            scale = weight * omega[a, c]
            if scale != 0.0:
                for b in range(k):
                    whitened[a, b] += scale * J[c, b]
        for b in range(k):
            g[b] += whitened[a, b] * e[a]
    for c in range(k):
        for a in range(k):
            scale = J[c, a]
            if scale != 0.0:
                for b in range(k):
                    M[a, b] += scale * whitened[c, b]
