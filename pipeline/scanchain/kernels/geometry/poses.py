"""Inverse, motion, logarithm and adjoint of poses in the plane or in space, one at a time."""

import math

import numpy as np

from scanchain.kernels.compiling import njit


@njit()
def inverse(T):
    """T⁻¹ = [Rᵀ, −Rᵀt; 0, 1] of T (d+1, d+1)."""
    d = T.shape[0] - 1
    out = np.zeros((d + 1, d + 1))
    for i in range(d):
        for j in range(d):
            out[i, j] = T[j, i]
            out[i, d] -= T[j, i] * T[j, d]
    out[d, d] = 1.0
    return out


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
