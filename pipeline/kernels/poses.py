"""Inverse, logarithm and adjoint of one pose in the plane or in space, at the price of a call."""

import math

import numpy as np
from numba import njit


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
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
