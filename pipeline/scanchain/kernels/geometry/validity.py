"""Checks of arrays for finite numbers and rigid transformations, without temporaries."""

import math

import numpy as np

from scanchain.kernels.compiling import njit

_BLOCK = 512  # entries that are compared at once with the largest before


@njit(nogil=True)
def largest_magnitude(array) -> float:
    """Largest |entry| of a C-contiguous array; infinite where one is NaN or infinite, 0 without entries."""
    largest, values = 0.0, array.reshape(-1)
    for start in range(0, values.size, _BLOCK):
        part = values[start : start + _BLOCK]
        larger = 0
        for i in range(part.size):  # vector instructions, as nothing here depends on the entry before
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

    At least 2 where det R < 0, as a reflection has it; infinite where an entry is not finite.
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
