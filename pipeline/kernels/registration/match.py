"""A scan matched near a prediction: aligned, held where the data tell little, and what the answer is worth."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanchain.kernels.geometry.pose_log import twist_3d
from scanchain.kernels.geometry.poses import adjoint, between, centered, inverse, twist_2d
from scanchain.kernels.registration.association import associate
from scanchain.kernels.registration.icp import NO_PARTNERS, align, position_of
from scanchain.kernels.registration.linearization import leave_out_points
from scanchain.kernels.registration.observability import (
    WEAK,
    add,
    congruent,
    definite_inverse,
    fit_of,
    hold,
    is_below,
    seen_from_source,
    spectrum_of,
    worst,
)
from scanchain.kernels.registration.residuals import information, robust_sums
from scanchain.kernels.registration.signal_to_noise import listen, weakest_signal
from scanchain.kernels.registration.weights import weigh

_DOUBTS = 2.0  # standard deviations of the prediction that the kernel's first scale spans


class Expectation(NamedTuple):
    """Where a scan should be: a ``Prior`` for kernels; ``is_known`` is 0 where there is none."""

    T: NDArray[np.float64]
    covariance: NDArray[np.float64]
    widest: NDArray[np.float64]
    is_known: int


class Quality(NamedTuple):
    """How well points fit a map at a pose, by the correspondences within the last gate of the search.

    pairs, on_surfaces : points with a correspondence, and those of them on a plane or line
    residual_m, fit : as in ``Match``
    H (k, k), weights : information of planes and lines, and the sum of all weights
    origin (3,), partner (N,), trust (N,) : as in ``Outcome``
    """

    pairs: int
    on_surfaces: int
    residual_m: float
    fit: float
    H: NDArray[np.float64]
    weights: float
    origin: NDArray[np.float64]
    partner: NDArray[np.int32]
    trust: NDArray[np.float64]


class Answer(NamedTuple):
    """How a matching ended; fields as in ``Match``, ``range_m`` of the points, a code of ``registration``.

    surface_signal : along the weakest direction, where ``signal`` does not judge it; infinite where that is strong
    """

    T: NDArray[np.float64]
    information: NDArray[np.float64]
    direction: NDArray[np.float64]
    eigenvalue: float
    signal: float
    surface_signal: float
    fit: float
    range_m: float
    residual_m: float
    cost: float
    pairs: int
    on_surfaces: int
    iterations: int
    ending: int


@njit(cache=True, nogil=True)
def match(voxels, points, T_first, expected, terms):
    """The ``Answer`` of points (N, d) aligned to a map from T_first (d+1, d+1), near an ``Expectation``.

    The prediction counts with what holds whatever happens; where the data determine a direction weakly, the scan
    is aligned once more, and there it counts with its own information.
    """
    k = 3 if points.shape[1] == 2 else 6
    range_m = root_mean_square_range(points)
    information, away, doubt_m = np.zeros((k, k)), np.zeros(k), 0.0
    if expected.is_known:
        for i in range(k):
            information[i, i] = expected.widest[i] ** -2.0
        information = _turned(information, T_first, terms.variance)
        away = _twist_between(expected.T, T_first)
        doubt_m = _doubt_of(expected, range_m)
    first_scale_m = min(max(terms.first_scale_m, _DOUBTS * doubt_m), terms.widest_scale_m)
    T = T_first.copy()
    is_held = False
    while True:
        outcome = align(voxels, points, T, away, information, range_m, first_scale_m, terms)
        spectrum = spectrum_of(outcome.H, outcome.weights, range_m)
        if points.shape[1] == 3:
            listen(voxels, points, T, outcome, spectrum, terms)
        if is_held or not is_below(spectrum, 0, WEAK, terms):
            break
        is_held = True
        believed = information
        if expected.is_known:
            believed = _turned(definite_inverse(expected.covariance), T_first, terms.variance)
        add(information, hold(spectrum, outcome.weights, believed, terms))
        T = T_first.copy()
    quality = _quality_of(voxels, points, T, outcome, range_m, terms)
    surface_signal = np.inf
    if points.shape[1] == 2:
        surface_signal = weakest_signal(voxels, points, T, quality, spectrum, terms)
    return answer_of(T, T_first, outcome, spectrum, surface_signal, quality, range_m, terms.variance)


@njit(cache=True, nogil=True)
def judge(voxels, points, T, outcome, terms):
    """The ``Answer`` of an outcome whose information is about T (d+1, d+1) itself.

    The means of voxels constrain a pose in every direction, whether the surfaces do or not: what is determined is
    therefore judged by the surfaces.
    """
    range_m = root_mean_square_range(points)
    quality = _quality_at(voxels, points, T, position_of(T), range_m, terms)
    spectrum = spectrum_of(quality.H, quality.weights, range_m)
    surface_signal = weakest_signal(voxels, points, T, quality, spectrum, terms)
    return answer_of(T, T, outcome, spectrum, surface_signal, quality, range_m, terms.variance)


@njit(cache=True, nogil=True)
def _quality_of(voxels, points, T, outcome, range_m: float, terms):
    """The ``Quality`` of an outcome: by its own correspondences, or by closer ones where the search was wider."""
    if terms.reach != terms.last_reach or terms.max_distance_m != terms.last_distance_m:
        return _quality_at(voxels, points, T, outcome.origin, range_m, terms)
    residual_m = math.sqrt(outcome.squares / outcome.weights) if outcome.weights > 0.0 else math.inf
    fit = fit_of(outcome.H, outcome.unweighted, range_m)
    return Quality(
        outcome.pairs,
        _positive(outcome.trust),
        residual_m,
        fit,
        outcome.H,
        outcome.weights,
        outcome.origin,
        outcome.partner,
        outcome.trust,
    )


@njit(cache=True, nogil=True)
def _quality_at(voxels, points, T, origin, range_m: float, terms):
    """The ``Quality`` of points (N, d) at the pose T (d+1, d+1), twists about an origin (3,)."""
    k = 3 if points.shape[1] == 2 else 6
    partner, trust = np.empty(points.shape[0], np.int32), np.empty(points.shape[0])
    pairs = associate(voxels, points, T, terms.last_reach, terms.last_distance_m, partner)
    weigh(voxels, points, T, partner, terms.variance, trust)
    _, weights, squares = robust_sums(voxels, points, T, partner, trust, terms.scale_m)
    leave_out_points(voxels, partner, trust)
    H, unweighted = np.empty((k, k)), np.empty((k, k))
    information(voxels, points, T, origin, partner, trust, terms.scale_m, H, unweighted)
    residual_m = math.sqrt(squares / weights) if weights > 0.0 else math.inf
    fit = fit_of(H, unweighted, range_m)
    return Quality(pairs, _positive(trust), residual_m, fit, H, weights, origin, partner, trust)


@njit(cache=True, inline="always")
def _positive(values) -> int:
    """How many of the values (N,) are above 0."""
    count = 0
    for i in range(values.shape[0]):
        count += values[i] > 0.0
    return count


@njit(cache=True, inline="always")
def answer_of(T, T_first, outcome, spectrum, surface_signal: float, quality, range_m: float, variance: float):
    """The ``Answer`` that an outcome amounts to, turned into the source's own frame.

    The variance of a residual is that of the fit, or the sensor's where the fit is closer than that.
    """
    m = worst(spectrum)
    residual_m = math.sqrt(outcome.squares / outcome.weights) if outcome.weights > 0.0 else math.inf
    information, direction = seen_from_source(
        T, T_first, outcome.H, spectrum.vectors[:, m], max(variance, residual_m**2)
    )
    return Answer(
        T,
        information,
        direction,
        max(spectrum.values[0], 0.0),
        spectrum.signals[m],
        surface_signal,
        quality.fit,
        range_m,
        quality.residual_m,
        outcome.cost,
        quality.pairs,
        quality.on_surfaces,
        outcome.iterations,
        outcome.ending if quality.pairs else NO_PARTNERS,
    )


@njit(cache=True, nogil=True)
def root_mean_square_range(points) -> float:
    """Of points (N, d) as the lidar sees them; meters."""
    total = 0.0
    for i in range(points.shape[0]):
        for axis in range(points.shape[1]):
            total += points[i, axis] * points[i, axis]
    return math.sqrt(total / max(points.shape[0], 1))


@njit(cache=True, nogil=True)
def _turned(information, T, variance: float):
    """Information (k, k) about twists in the source's frame, times a variance, as that along the target's axes."""
    out = congruent(adjoint(inverse(centered(T, T))), information)
    for i in range(out.shape[0]):
        for j in range(out.shape[0]):
            out[i, j] *= variance
    return out


@njit(cache=True, nogil=True)
def _twist_between(T_from, T_to):
    """Twist (k,) from one pose to another near it, about the latter's position and along the target's axes."""
    motion = between(inverse(centered(T_to, T_to)), inverse(centered(T_from, T_to)))
    if T_to.shape[0] == 3:
        return twist_2d(motion)
    out = np.empty(6)
    twist_3d(motion, out)
    return out


@njit(cache=True, nogil=True)
def _doubt_of(expected, range_m: float) -> float:
    """How far a point at that range may be from where it is expected: one standard deviation, meters."""
    k = expected.widest.shape[0]
    d = 2 if k == 3 else 3
    variance = 0.0
    for i in range(k):
        share = 1.0 / d if i < d else range_m * range_m / (k - d)
        variance += share * expected.covariance[i, i]
    return math.sqrt(variance)
