"""What the data of an alignment determine, by direction, and what is held where they do not."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.kernels.descent import solve
from pipeline.kernels.eigen import eigensystem
from pipeline.kernels.poses import adjoint, centred

WEAK = 10.0  # times the least information, below which the data alone are not believed
_FIRM = 1e3  # times what all residuals together know of a direction


class Spectrum(NamedTuple):
    """What the data determine, by direction, about the first position and in the map's axes.

    scale : (k,) that evens out the units: rotations count as the lengths they move a point at the scan's root mean
        square range
    values : (k,) eigenvalues, ascending, of the information per weight; 1 is a direction that every residual sees
    vectors : (k, k) unit eigenvectors, a column each, in evened units
    """

    scale: NDArray[np.float64]
    values: NDArray[np.float64]
    vectors: NDArray[np.float64]


@njit(cache=True, nogil=True)
def spectrum_of(H, weights: float, range_m: float):
    """The spectrum of the information H (k, k) that residuals of these weights amount to."""
    k = H.shape[0]
    scale = np.ones(k)
    for i in range(2 if k == 3 else 3, k):
        scale[i] = 1.0 / max(range_m, 1e-9)
    evened, values, vectors = np.empty((k, k)), np.empty(k), np.empty((k, k))
    for i in range(k):
        for j in range(k):
            evened[i, j] = H[i, j] * scale[i] * scale[j] / max(weights, 1e-300)
    eigensystem(evened, values, vectors)
    return Spectrum(scale, values, vectors)


@njit(cache=True, nogil=True)
def hold(spectrum, weights: float, expected, min_information: float):
    """Information (k, k), in the kernel's units, that keeps a pose near the prediction where the data tell little.

    Along directions whose eigenvalue is below ``min_information`` the pose does not move at all (Zhang, Kaess &
    Singh 2016). Up to WEAK times that the data may be mistaken about themselves, and the information ``expected``
    (k, k) of the prediction is taken as it is; beyond, a vehicle that brakes may contradict any experience.
    """
    k = expected.shape[0]
    anchor, twist = np.zeros((k, k)), np.empty(k)
    for m in range(k):
        if spectrum.values[m] >= WEAK * min_information:
            break
        strength = 0.0
        for i in range(k):
            twist[i] = spectrum.vectors[i, m] * spectrum.scale[i]
        for i in range(k):
            for j in range(k):
                strength += twist[i] * expected[i, j] * twist[j]
        if spectrum.values[m] < min_information:
            strength = _FIRM * weights
        for i in range(k):
            for j in range(k):
                along = spectrum.vectors[i, m] * spectrum.vectors[j, m]
                anchor[i, j] += strength * along / (spectrum.scale[i] * spectrum.scale[j])
    return anchor


@njit(cache=True, nogil=True)
def seen_from_source(T, T_first, H, spectrum, variance: float):
    """Information (k, k) and worst direction (k,) of twists in the source's own frame.

    H (k, k), of residuals with this variance, and the spectrum are about the position of T_first, in map axes.
    """
    k = H.shape[0]
    information, direction = congruent(adjoint(centred(T, T_first)), H), np.zeros(k)
    Ad = adjoint(centred(T, T))
    for i in range(k):
        for j in range(k):
            information[i, j] /= variance
            direction[j] += Ad[i, j] * spectrum.vectors[i, 0]
    return information, direction


@njit(cache=True, nogil=True)
def informed(covariance, information):
    """Covariance (k, k) after information Λ (k, k) has come in: (P⁻¹ + Λ)⁻¹."""
    total = definite_inverse(covariance)
    add(total, information)
    return definite_inverse(total)


@njit(cache=True, nogil=True)
def add(total, information):
    """Add information (k, k) to ``total``, in place."""
    for i in range(total.shape[0]):
        for j in range(total.shape[0]):
            total[i, j] += information[i, j]


@njit(cache=True, nogil=True)
def definite_inverse(matrix):
    """Inverse of a positive definite (k, k), of another zeros."""
    k = matrix.shape[0]
    out, factor, b, column = np.zeros((k, k)), np.zeros((k, k)), np.zeros(k), np.zeros(k)
    for j in range(k):
        b[j] = -1.0
        if not solve(matrix, b, 0.0, factor, column):
            return np.zeros((k, k))
        b[j] = 0.0
        for i in range(k):
            out[i, j] = column[i]
    return out


@njit(cache=True, nogil=True)
def congruent(A, H):
    """AᵀHA of two (k, k)."""
    k = H.shape[0]
    HA, out = np.zeros((k, k)), np.zeros((k, k))
    for i in range(k):
        for m in range(k):
            for j in range(k):
                HA[i, j] += H[i, m] * A[m, j]
    for m in range(k):
        for i in range(k):
            for j in range(k):
                out[i, j] += A[m, i] * HA[m, j]
    return out
