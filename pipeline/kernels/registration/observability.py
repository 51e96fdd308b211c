"""What the data of an alignment determine, by direction, and what is held where they do not."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanchain.kernels.geometry.eigen import eigensystem
from scanchain.kernels.geometry.poses import adjoint, centered
from scanchain.kernels.registration.descent import solve

WEAK = 10.0  # times the limits, below which the data alone are not believed
_FIRM = 1e3  # times what all residuals together know of a direction
_NOTHING = 1e-12  # of the largest eigenvalue, below which one is rounding


class Spectrum(NamedTuple):
    """What the data determine, by direction, about the first position and in the map's axes.

    scale : (k,) that evens out the units: rotations count as the lengths they move a point at the scan's root mean
        square range
    values : (k,) eigenvalues, ascending, of the information per weight; 1 is a direction that every residual sees
    vectors : (k, k) unit eigenvectors, a column each, in evened units
    signals : (k,) what is told along each over what errors of the normals would feign; infinite where unknown
    """

    scale: NDArray[np.float64]
    values: NDArray[np.float64]
    vectors: NDArray[np.float64]
    signals: NDArray[np.float64]


@njit(cache=True, inline="always")
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
    return Spectrum(scale, values, vectors, np.full(k, np.inf))


@njit(cache=True, nogil=True)
def fit_of(H, unweighted, range_m: float) -> float:
    """Share of the information that the robust kernel leaves to the direction that loses most, 0 to 1.

    The smallest eigenvalue of H x = λ U x, with H and U (k, k) the information with and without robust weights:
    near 1 where the correspondences along every direction agree with the pose, low where those that determine a
    direction contradict it, however many others (the ground, as a rule) fit. Directions without information are
    left out; 0 where there is none at all.
    """
    k = H.shape[0]
    plain = spectrum_of(unweighted, 1.0, range_m)
    largest = plain.values[k - 1]
    if not largest > 0.0:
        return 0.0
    whitened, values, vectors = np.eye(k), np.empty(k), np.empty((k, k))
    for m in range(k):
        if plain.values[m] <= _NOTHING * largest:
            continue
        for n in range(k):
            if plain.values[n] <= _NOTHING * largest:
                continue
            total = 0.0
            for i in range(k):
                for j in range(k):
                    along = plain.vectors[i, m] * plain.vectors[j, n]
                    total += along * H[i, j] * plain.scale[i] * plain.scale[j]
            whitened[m, n] = total / np.sqrt(plain.values[m] * plain.values[n])
    eigensystem(whitened, values, vectors)
    return max(values[0], 0.0)


@njit(cache=True, inline="always")
def worst(spectrum) -> int:
    """The direction that the data tell least of, above what would be feigned."""
    m = 0
    for other in range(1, spectrum.values.shape[0]):
        if spectrum.signals[other] < spectrum.signals[m]:
            m = other
    return m


@njit(cache=True, inline="always")
def is_below(spectrum, m: int, times: float, terms) -> bool:
    """Whether the data tell less along a direction than so many times the least."""
    return spectrum.values[m] < times * terms.min_information or spectrum.signals[m] < times * terms.min_signal


@njit(cache=True, nogil=True)
def hold(spectrum, weights: float, expected, terms):
    """Information (k, k), in the kernel's units, that keeps a pose near the prediction where the data tell little.

    Along directions of which the data tell nothing the pose does not move at all (Zhang, Kaess & Singh 2016). Up
    to WEAK times the limits the information ``expected`` (k, k) of the prediction counts, against that of the data
    without what is feigned: the share 1 − 1/signal; beyond, a vehicle that brakes may contradict any experience.
    """
    k = expected.shape[0]
    anchor, twist = np.zeros((k, k)), np.empty(k)
    for m in range(k):
        if not is_below(spectrum, m, WEAK, terms):
            continue
        strength = 0.0
        for i in range(k):
            twist[i] = spectrum.vectors[i, m] * spectrum.scale[i]
        for i in range(k):
            for j in range(k):
                strength += twist[i] * expected[i, j] * twist[j]
        real = 1.0 - 1.0 / max(spectrum.signals[m], 1e-300)
        if is_below(spectrum, m, 1.0, terms) or strength > real * _FIRM * weights:
            strength, real = _FIRM * weights, 1.0
        for i in range(k):
            for j in range(k):
                along = spectrum.vectors[i, m] * spectrum.vectors[j, m]
                anchor[i, j] += strength / real * along / (spectrum.scale[i] * spectrum.scale[j])
    return anchor


@njit(cache=True, nogil=True)
def seen_from_source(T, T_first, H, direction, variance: float):
    """Information (k, k) and a direction (k,) of twists, in the source's own frame.

    H (k, k), of residuals with this variance, and the direction are about the position of T_first, in map axes.
    """
    k = H.shape[0]
    information, turned = congruent(adjoint(centered(T, T_first)), H), np.zeros(k)
    Ad = adjoint(centered(T, T))
    for i in range(k):
        for j in range(k):
            information[i, j] /= variance
            turned[j] += Ad[i, j] * direction[i]
    return information, turned


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
