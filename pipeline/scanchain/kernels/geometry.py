"""Poses (d+1, d+1) of SE(2) and SE(3) with their twists (translation, rotation); checks of finite arrays."""

import math

import numpy as np

from scanchain.kernels.compiling import njit

_BLOCK = 512  # entries per block that are compared with the largest value so far


@njit()
def inverse(T):
    """T⁻¹ = [Rᵀ, −Rᵀt; 0, 1] of T (d+1, d+1)."""
    return between(T, np.eye(T.shape[0]))


@njit()
def between(T_a, T_b):
    """T_a⁻¹ T_b of two (d+1, d+1)."""
    d = T_a.shape[0] - 1
    out = np.zeros((d + 1, d + 1))
    for i in range(d):
        for m in range(d):
            for j in range(d):
                out[i, j] += T_a[m, i] * T_b[m, j]
            out[i, d] += T_a[m, i] * (T_b[m, d] - T_a[m, d])
    out[d, d] = 1.0
    return out


@njit()
def centered(T, T_origin):
    """The pose T (d+1, d+1) with its position relative to that of T_origin."""
    d = T.shape[0] - 1
    out = T.copy()
    for i in range(d):
        out[i, d] -= T_origin[i, d]
    return out


@njit()
def apart(T_a, T_b):
    """Distance between two poses: meters, and the angle in [0, π] between their rotations.

    8 sin²(θ/2) = |R_a − R_b|², 2 cos²(θ/2) = 1 + cos θ by the trace.
    """
    d = T_a.shape[0] - 1
    square = squares = trace = 0.0
    for i in range(d):
        square += (T_b[i, d] - T_a[i, d]) ** 2
        for j in range(d):
            squares += (T_b[i, j] - T_a[i, j]) ** 2
            trace += T_a[i, j] * T_b[i, j]
    sine = math.sqrt(0.125 * squares)
    cosine2 = 0.5 + (0.25 * trace if d == 2 else 0.25 * (trace - 1.0))
    return math.sqrt(square), 2.0 * math.atan2(sine, math.sqrt(max(cosine2, 0.0)))


@njit()
def adjoint(T):
    """Ad (k, k) with T exp(ξ) T⁻¹ = exp(Ad ξ): [R, (t_y, −t_x)ᵀ; 0, 1] in the plane, [R, t^ R; 0, R] in space."""
    d = T.shape[0] - 1
    k = 3 if d == 2 else 6
    out = np.zeros((k, k))
    for i in range(d):
        for j in range(d):
            out[i, j] = T[i, j]
    if d == 2:
        out[0, 2], out[1, 2], out[2, 2] = T[1, 2], -T[0, 2], 1.0
        return out
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    for j in range(3):
        out[0, 3 + j] = y * T[2, j] - z * T[1, j]
        out[1, 3 + j] = z * T[0, j] - x * T[2, j]
        out[2, 3 + j] = x * T[1, j] - y * T[0, j]
        for i in range(3):
            out[3 + i, 3 + j] = T[i, j]
    return out


@njit()
def perturb(twist, T, origin, out):
    """Write exp(twist) T, the twist about ``origin`` (3,), to ``out``; T (3, 3) in SE(2), (4, 4) in SE(3).

    In SE(3) Rodrigues' formula with V(φ) for the translation (Barfoot 2017, eq. 7.86).
    """
    d = T.shape[0] - 1
    for axis in range(d):
        T[axis, d] -= origin[axis]
    if d == 2:
        _perturb_2d(twist, T, out)
    else:
        _perturb_3d(twist, T, out)
    for axis in range(d):
        T[axis, d] += origin[axis]
        out[axis, d] += origin[axis]


@njit(inline="always")
def _perturb_2d(twist, T, out):
    theta = twist[2]
    c, s = math.cos(theta), math.sin(theta)
    if abs(theta) < 1e-9:
        a, b = 1.0, 0.5 * theta
    else:
        a, b = s / theta, (1.0 - c) / theta
    for column in range(3):
        x, y = T[0, column], T[1, column]
        out[0, column] = c * x - s * y
        out[1, column] = s * x + c * y
        out[2, column] = T[2, column]
    out[0, 2] += a * twist[0] - b * twist[1]
    out[1, 2] += b * twist[0] + a * twist[1]


@njit(inline="always")
def _perturb_3d(twist, T, out):
    x, y, z = twist[3], twist[4], twist[5]
    theta2 = x * x + y * y + z * z
    theta = math.sqrt(theta2)
    if theta < 1e-4:
        a, b, c = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0, 1.0 / 6.0 - theta2 / 120.0
    else:
        a = math.sin(theta) / theta
        b = (1.0 - math.cos(theta)) / theta2
        c = (1.0 - a) / theta2
    for column in range(4):
        u, v, w = _rotate(x, y, z, a, b, T[0, column], T[1, column], T[2, column])
        out[0, column], out[1, column], out[2, column] = u, v, w
        out[3, column] = T[3, column]
    u, v, w = _rotate(x, y, z, b, c, twist[0], twist[1], twist[2])
    out[0, 3] += u
    out[1, 3] += v
    out[2, 3] += w


@njit(inline="always")
def _rotate(x, y, z, a, b, u, v, w):
    """Apply (I + a K + b K²) to (u, v, w), K the skew matrix of (x, y, z)."""
    cu, cv, cw = y * w - z * v, z * u - x * w, x * v - y * u
    du, dv, dw = y * cw - z * cv, z * cu - x * cw, x * cv - y * cu
    return u + a * cu + b * du, v + a * cv + b * dv, w + a * cw + b * dw


@njit()
def twist_2d(T):
    """The twist (3,) of T (3, 3): θ = atan2(R₂₁, R₁₁), ρ = V(θ)⁻¹ t, V⁻¹ = [c, θ/2; −θ/2, c], c = θ/2 cot θ/2."""
    theta = math.atan2(T[1, 0], T[0, 0])
    half = 0.5 * theta
    c = 1.0 if abs(theta) < 1e-8 else half / math.tan(half)
    out = np.empty(3)
    out[0] = c * T[0, 2] + half * T[1, 2]
    out[1] = c * T[1, 2] - half * T[0, 2]
    out[2] = theta
    return out


@njit()
def quaternions(R, out):
    """Write unit quaternions xyzw, w ≥ 0, of rotations (N, 3, 3) to ``out`` (N, 4).

    The largest of the four components is found first, so that the divisor is never a difference of nearly
    equal numbers (Shepperd 1978).
    """
    for n in range(R.shape[0]):
        _quaternion(R[n], out[n])


@njit()
def twists(T, out):
    """Write the twists (ρ, φ) of poses (N, 4, 4) to ``out`` (N, 6)."""
    for n in range(T.shape[0]):
        twist_3d(T[n], out[n])


@njit()
def twist_3d(T, out):
    """Write the twist (ρ, φ) of a pose, its first three rows (3, 4), to ``out`` (6,): φ = log R, ρ = V(φ)⁻¹ t.

    φ comes from the quaternion, which is well conditioned from 0 to π.
    V(φ)⁻¹ t = t − ½ φ × t + e φ × (φ × t), e = (1 − θ/2 cot θ/2) / θ²    (Barfoot 2017, eq. 7.86)
    """
    _quaternion(T, out[:4])
    x, y, z = out[0], out[1], out[2]
    norm = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if norm < 1e-8 else 2.0 * math.atan2(norm, out[3]) / norm  # the series is exact
    x, y, z = scale * x, scale * y, scale * z
    u, v, w = T[0, 3], T[1, 3], T[2, 3]
    e = second_coefficient(x * x + y * y + z * z)
    cu, cv, cw = y * w - z * v, z * u - x * w, x * v - y * u
    out[0] = u - 0.5 * cu + e * (y * cw - z * cv)
    out[1] = v - 0.5 * cv + e * (z * cu - x * cw)
    out[2] = w - 0.5 * cw + e * (x * cv - y * cu)
    out[3], out[4], out[5] = x, y, z


@njit(inline="always")
def second_coefficient(theta2):
    """(1 − θ/2 cot θ/2) / θ² of the squared angle, the factor of the squared hat in V(φ)⁻¹."""
    if theta2 < 1e-6:
        return 1.0 / 12.0 + theta2 / 720.0
    half = 0.5 * math.sqrt(theta2)
    return (1.0 - half / math.tan(half)) / theta2


@njit()
def _quaternion(R, out):
    """Write the quaternion xyzw of the rotation in R to ``out`` (4,), normalized, w ≥ 0."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace >= R[0, 0] and trace >= R[1, 1] and trace >= R[2, 2]:
        out[0], out[1], out[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        out[3] = 1.0 + trace
    else:
        i = 0
        if R[1, 1] > R[0, 0]:
            i = 1
        if R[2, 2] > R[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = 1.0 - trace + 2.0 * R[i, i]
        out[j] = R[j, i] + R[i, j]
        out[k] = R[k, i] + R[i, k]
        out[3] = R[k, j] - R[j, k]
    norm = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2] + out[3] * out[3])
    scale = -1.0 / norm if out[3] < 0.0 else 1.0 / norm
    for axis in range(4):
        out[axis] *= scale


@njit()
def orthonormalize(T):
    """Make the rotation of T exactly orthonormal again, in place, by Gram–Schmidt.

    Where a transpose is used as the inverse, rounding errors grow 2.4-fold per scan at constant velocity.
    """
    d = T.shape[0] - 1
    for row in range(d):
        for other in range(row):
            dot = 0.0
            for column in range(d):
                dot += T[row, column] * T[other, column]
            for column in range(d):
                T[row, column] -= dot * T[other, column]
        square = 0.0
        for column in range(d):
            square += T[row, column] * T[row, column]
        scale = 1.0 / math.sqrt(square)
        for column in range(d):
            T[row, column] *= scale


@njit(nogil=True)
def largest_magnitude(array) -> float:
    """Largest |entry| of a C-contiguous array; infinite where one is NaN or infinite, 0 without entries."""
    largest, values = 0.0, array.reshape(-1)
    for start in range(0, values.size, _BLOCK):
        part = values[start : start + _BLOCK]
        larger = 0
        for i in range(part.size):  # vectorizes, as no iteration depends on the one before
            larger += not abs(part[i]) <= largest
        for i in range(part.size if larger else 0):
            value = abs(part[i])
            if not value <= largest:
                if not math.isfinite(value):
                    return np.inf
                largest = float(value)
    return largest


@njit()
def rigidity_error(T) -> float:
    """Largest |entry| of RᵀR − I and of the last row less (0, …, 0, 1) of T (d+1, d+1).

    At least 2 where det R < 0, i.e. for a reflection; infinite where an entry is not finite.
    """
    d = T.shape[0] - 1
    error = 0.0
    for i in range(d + 1):
        for j in range(d + 1):
            if not math.isfinite(T[i, j]):
                return np.inf
    for i in range(d):
        error = max(error, abs(T[d, i]))
        for j in range(d):
            product = -1.0 if i == j else 0.0
            for m in range(d):
                product += T[m, i] * T[m, j]
            error = max(error, abs(product))
    if d == 2:
        determinant = T[0, 0] * T[1, 1] - T[0, 1] * T[1, 0]
    else:
        determinant = (
            T[0, 0] * (T[1, 1] * T[2, 2] - T[1, 2] * T[2, 1])
            - T[0, 1] * (T[1, 0] * T[2, 2] - T[1, 2] * T[2, 0])
            + T[0, 2] * (T[1, 0] * T[2, 1] - T[1, 1] * T[2, 0])
        )
    return max(error, abs(T[d, d] - 1.0), 2.0 if determinant < 0.0 else 0.0)
