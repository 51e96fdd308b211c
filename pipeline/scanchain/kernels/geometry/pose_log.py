"""Quaternions of rotations and logarithms of poses in space, many at a time."""

import math

from scanchain.kernels.compiling import njit

_SMALL = 1e-8  # sine of half the angle, below which the series is exact


@njit()
def quaternions(R, out):
    """Write unit quaternions xyzw, w ≥ 0, of rotations (N, 3, 3) to ``out`` (N, 4).

    The largest of the four components is found first, so that no difference of near numbers is divided by
    (Shepperd 1978).
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
    scale = 2.0 if norm < _SMALL else 2.0 * math.atan2(norm, out[3]) / norm
    x, y, z = scale * x, scale * y, scale * z
    u, v, w = T[0, 3], T[1, 3], T[2, 3]
    e = second_coefficient(x * x + y * y + z * z)
    cu, cv, cw = y * w - z * v, z * u - x * w, x * v - y * u
    out[0] = u - 0.5 * cu + e * (y * cw - z * cv)
    out[1] = v - 0.5 * cv + e * (z * cu - x * cw)
    out[2] = w - 0.5 * cw + e * (x * cv - y * cu)
    out[3], out[4], out[5] = x, y, z


@njit()
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
