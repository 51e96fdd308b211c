"""Registration of a scan near its predicted pose, and the reliability of the result."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.geometry import adjoint, between, centered, inverse, perturb, twist_2d, twist_3d
from scanchain.kernels.matrices import congruent, definite_inverse, factorize, substitute
from scanchain.kernels.registration.icp import Ending, align, fit_at, gradients_of_sectors, problem_of
from scanchain.kernels.registration.observability import (
    WEAK,
    add_signals,
    agreement,
    is_below,
    remove_noise,
    seen_from_source,
    spectrum_of,
    weak_prior,
)
from scanchain.kernels.registration.residuals import WITHOUT_KERNEL_M, gradient_spread, normal_equations

_TURN_INFORMATION = 25.0  # rad⁻², of an unconstrained rotation
_POOLED_RESIDUALS = 10.0  # number of residuals that the sensor's variance is weighted as
_UNSHARED = 0.5  # share of the variance of planar residuals not due to the map, by NEES of simulated motions
_POOLED = 0.02  # weight of the variance of all residuals against that of each surface
_SIGMAS = 2.0  # initial kernel scale, in standard deviations of the prediction


class Result(NamedTuple):
    """Result of a registration; fields as in ``Match``, ``range_m`` of the points, ``ending`` a code of ``icp``.

    on_surfaces : correspondences with a plane or line
    """

    T: NDArray[np.float64]
    information: NDArray[np.float64]
    direction: NDArray[np.float64]
    eigenvalue: float
    signal: float
    fit: float
    range_m: float
    residual_m: float
    cost: float
    pairs: int
    on_surfaces: int
    iterations: int
    ending: int
    variance_factor: float
    systematic: NDArray[np.float64]


@njit(nogil=True)
def match(voxels, points, T_first, expected, settings):
    """``Result`` of points (N, d) aligned to a map from T_first (d+1, d+1), near a predicted pose.

    The prior is used with its largest standard deviations. Where the scan constrains a direction weakly, it is
    aligned again, with the covariance of the prior along that direction. In the plane this applies to an
    extrapolated motion only where there is no information at all: for a robot that starts to move in a corridor,
    even ambiguous walls constrain it better than the standstill before; a motion measured by wheels is fused.

    expected : T_target_source (d+1, d+1), covariance (k, k) and widest (k,) as in ``Prior``; without a prediction
        T_first, zeros and infinite
    """
    k = 3 if points.shape[1] == 2 else 6
    prior = np.zeros((k, k))
    for i in range(k):
        prior[i, i] = expected.widest[i] ** -2.0
    prior = _about_target(prior, T_first, settings.variance)
    offset = _twist_between(expected.T_target_source, T_first)
    problem = problem_of(voxels, points, T_first, prior, settings)
    uncertainty_m = _uncertainty_of(expected.covariance, problem.range_m)
    first_scale_m = min(max(settings.first_scale_m, _SIGMAS * uncertainty_m), settings.widest_scale_m)
    T = T_first.copy()
    is_fused = expected.is_measured and points.shape[1] == 2
    is_remapped = False
    while True:
        fit = align(problem, T, offset, first_scale_m)
        spectrum = spectrum_of(fit.H, fit.total_weight, problem.range_m)
        if is_fused or points.shape[1] == 3:
            add_signals(problem, T, spectrum)
        if is_remapped or not is_below(spectrum, 0, 1.0 if is_fused else WEAK, settings):
            break
        is_remapped = True
        believed = _about_target(definite_inverse(expected.covariance), T_first, settings.variance)
        remapped = weak_prior(spectrum, fit.total_weight, believed, is_fused, settings)
        for i in range(k):
            for j in range(k):
                prior[i, j] += remapped[i, j]
        T = T_first.copy()
    spread = _spread(problem, T, fit)
    last = fit
    if settings.reach != settings.last_reach or settings.max_distance_m != settings.last_distance_m:
        last = fit_at(problem, T, fit.iterations, fit.ending)
    if points.shape[1] == 2 and not is_fused:
        add_signals(problem, T, spectrum)
    H = fit.H if is_fused else fit.H.copy()
    if expected.is_measured:
        remove_noise(spectrum, H, fit.total_weight, settings)
    return _result(problem, T, T_first, fit, H, last, spectrum, spread)


@njit(nogil=True)
def assess(voxels, points, T, expected, iterations: int, ending: int, settings):
    """``Result`` at T (d+1, d+1), found by another method without the prediction.

    Along weak directions the pose is moved, in place, towards the predicted one, as the prior in ``match`` does.
    iterations, ending : of that method
    """
    k = 3 if points.shape[1] == 2 else 6
    problem = problem_of(voxels, points, T, np.zeros((k, k)), settings)
    fit = fit_at(problem, T, iterations, ending)
    spectrum = spectrum_of(fit.H, fit.total_weight, problem.range_m)
    is_fused = expected.is_measured and k == 3
    if is_fused or k == 6:
        add_signals(problem, T, spectrum)
    if is_below(spectrum, 0, 1.0 if is_fused else WEAK, settings):
        believed = _about_target(definite_inverse(expected.covariance), T, settings.variance)
        prior = weak_prior(spectrum, fit.total_weight, believed, is_fused, settings)
        away, pull = _twist_between(expected.T_target_source, T), np.zeros(k)
        for i in range(k):
            for j in range(k):
                pull[i] += prior[i, j] * away[j]
                prior[i, j] += fit.H[i, j]
        factor, twist = np.empty((k, k)), np.zeros(k)
        if factorize(prior, 0.0, factor):
            substitute(factor, pull, twist)
            perturb(twist, T.copy(), problem.origin, T)
            fit = fit_at(problem, T, iterations, ending)
    add_signals(problem, T, spectrum)
    return _result(problem, T, T, fit, fit.H, fit, spectrum, _spread(problem, T, fit))


@njit(nogil=True)
def _result(problem, T, T_first, fit, H, last, spectrum, spread):
    """``Result`` in the source's own frame: information from ``fit``, quality from the ``last`` correspondences.

    spread : (k, k) covariance of the gradient, empty to use one variance for all residuals
    """
    unweighted, b = np.empty_like(last.H), np.empty(last.H.shape[0])
    normal_equations(problem, T, WITHOUT_KERNEL_M, 0.0, unweighted, b)
    m = np.argmin(spectrum.signals)
    variance = _variance(problem, fit)
    if len(spread):
        H, variance = congruent(H, definite_inverse(spread)), 1.0
    information, direction = seen_from_source(T, T_first, H, spectrum.vectors[:, m], variance)
    on_surfaces = 0
    for i in range(problem.weight.shape[0]):
        on_surfaces += problem.weight[i] > 0.0
    return Result(
        T,
        information,
        direction,
        max(spectrum.values[0], 0.0),
        spectrum.signals[m],
        agreement(last.H, unweighted, problem.range_m),
        problem.range_m,
        _residual_of(last),
        fit.cost,
        last.pairs,
        on_surfaces,
        fit.iterations,
        fit.ending if last.pairs else Ending.NO_CORRESPONDENCES.value,
        1.0 if len(spread) else _variance_factor(problem, fit),
        _systematic(problem, T, T_first, fit, gradients_of_sectors(problem, T)),
    )


@njit(nogil=True)
def _spread(problem, T, fit):
    """Covariance (6, 6) of the gradient at T, with an error per surface as by its residuals; empty in the plane.

    A share of the variance of all residuals is added: few surfaces may fit by chance.
    """
    if fit.H.shape[0] == 3:
        return np.zeros((0, 0))
    spread = gradient_spread(problem, T, problem.settings.scale_m)
    variance = _variance(problem, fit)
    for i in range(6):
        for j in range(6):
            spread[i, j] += _POOLED * variance * fit.H[i, j]
    return spread


@njit(inline="always")
def _variance_factor(problem, fit) -> float:
    """Variance of residuals that is not shared with the next scan, over the variance used for the information.

    Pooled with the sensor's variance: few residuals may be small by chance.
    """
    pooled = fit.squares + _POOLED_RESIDUALS * problem.settings.variance
    variance = _UNSHARED * pooled / (fit.total_weight + _POOLED_RESIDUALS)
    return min(variance / _variance(problem, fit), 1.0)


@njit(inline="always")
def _systematic(problem, T, T_first, fit, gradients):
    """Covariance (k, k) in the source's own frame from the differences of the gradients b_s (8, k) of sectors.

    H⁻¹ (Σ b_s b_sᵀ) H⁻¹ G / (G − 1) for G sectors with correspondences, H with the prior (cluster-robust
    covariance, as ``gradient_spread``). Unconstrained directions are bounded to 1 m and 0.2 rad.
    """
    k, H, groups = fit.H.shape[0], fit.H + problem.prior, 0
    for m in range(k):
        is_turn = m >= (2 if k == 3 else 3)
        H[m, m] += _variance(problem, fit) * (_TURN_INFORMATION if is_turn else 1.0)
    spread, factor, shift = np.zeros((k, k)), np.empty((k, k)), np.empty(k)
    if not factorize(H, 0.0, factor):
        return spread
    for sector in range(gradients.shape[0]):
        b = gradients[sector]
        groups += b[0] != 0.0 or b[1] != 0.0
        substitute(factor, b, shift)
        for m in range(k):
            for n in range(k):
                spread[m, n] += shift[m] * shift[n]
    to_source = np.ascontiguousarray(adjoint(inverse(centered(T, T_first))).T)
    return congruent(to_source, spread) * (groups / max(groups - 1.0, 1.0))


@njit(inline="always")
def _variance(problem, fit) -> float:
    """Variance of a residual: that of the fit, at least the sensor's; m²."""
    return max(problem.settings.variance, _residual_of(fit) ** 2)


@njit(inline="always")
def _residual_of(fit) -> float:
    """Root of the weighted mean squared residual, meters; infinite without correspondences."""
    return math.sqrt(fit.squares / fit.total_weight) if fit.total_weight > 0.0 else math.inf


@njit(inline="always")
def _about_target(information, T, variance: float):
    """Information (k, k) about twists in the source's frame, times a variance, along the target's axes."""
    out = congruent(adjoint(inverse(centered(T, T))), information)
    for i in range(out.shape[0]):
        for j in range(out.shape[0]):
            out[i, j] *= variance
    return out


@njit(inline="always")
def _twist_between(T_from, T_to):
    """Twist (k,) from one pose to another near it, about the latter's position and along the target's axes."""
    motion = between(inverse(centered(T_to, T_to)), inverse(centered(T_from, T_to)))
    if T_to.shape[0] == 3:
        return twist_2d(motion)
    out = np.empty(6)
    twist_3d(motion, out)
    return out


@njit(inline="always")
def _uncertainty_of(covariance, range_m: float) -> float:
    """Standard deviation of a point at that range, by the covariance (k, k) of its pose; meters."""
    k = covariance.shape[0]
    d = 2 if k == 3 else 3
    variance = 0.0
    for i in range(k):
        share = 1.0 / d if i < d else range_m * range_m / (k - d)
        variance += share * covariance[i, i]
    return math.sqrt(variance)
