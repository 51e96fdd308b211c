"""Test of information matrices, compiled: finite, symmetric, positive semidefinite."""

import math

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit


@njit(nogil=True)
def find_semidefinite(matrices: NDArray[np.float64], rounding: float, is_semidefinite: NDArray[np.bool_]) -> None:
    """Fill ``is_semidefinite`` (E,): matrices (E, k, k) without an eigenvalue below −rounding · largest entry.

    Such a matrix has a Cholesky factor once that much is added to its diagonal.
    """
    factor = np.empty(matrices.shape[1:])
    for e in range(matrices.shape[0]):
        scale = _largest_entry(matrices[e])
        is_semidefinite[e] = math.isfinite(scale) and _is_symmetric(matrices[e], rounding * scale)
        is_semidefinite[e] = is_semidefinite[e] and (
            scale == 0.0 or _has_factor(matrices[e], rounding * scale, factor)
        )


@njit(nogil=True)
def _largest_entry(A) -> float:
    """The largest absolute value, NaN where one is."""
    largest = 0.0
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            if not abs(A[i, j]) <= largest:
                largest = abs(A[i, j])
                if math.isnan(largest):
                    return largest
    return largest


@njit(nogil=True)
def _is_symmetric(A, margin: float) -> bool:
    for i in range(A.shape[0]):
        for j in range(i):
            if abs(A[i, j] - A[j, i]) > margin:
                return False
    return True


@njit(nogil=True)
def _has_factor(A, shift: float, factor) -> bool:
    """True if A + shift · I has a Cholesky factor; ``factor`` (k, k) is a buffer for it."""
    for i in range(A.shape[0]):
        for j in range(i + 1):
            total = A[i, j]
            for m in range(j):
                total -= factor[i, m] * factor[j, m]
            if i != j:
                factor[i, j] = total / factor[j, j]
            elif total + shift <= 0.0:
                return False
            else:
                factor[i, i] = math.sqrt(total + shift)
    return True
