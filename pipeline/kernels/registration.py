"""Point-to-shape ICP against a voxel map: associate, linearise, step, until the pose stands still."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.kernels.association import associate
from pipeline.kernels.descent import LEVENBERG_MARQUARDT, NEWTON, predicted_decrease, relax, step
from pipeline.kernels.residuals import normal_equations
from pipeline.kernels.twist import orthonormalise, perturb

CONVERGED, OUT_OF_ITERATIONS, NO_PARTNERS, SINGULAR, NO_DECREASE = 0, 1, 2, 3, 4


SHRINK = 0.6  # of the kernel's scale from one association to the next


class Terms(NamedTuple):
    """What an alignment runs under; the kernel's scale shrinks from first_scale_m to scale_m."""

    optimiser: int
    max_iterations: int
    reach: int
    max_distance_m: float
    first_scale_m: float
    scale_m: float
    point_weight: float
    tolerance_m: float
    tolerance_rad: float


class Outcome(NamedTuple):
    """How an alignment ended.

    H (k, k) : Σ w JᵀJ of the data alone, twists about the first value's position, map axes
    cost : robust cost in m², every unpaired point at its limit ½s²
    weights, squares : Σ w and Σ w r² (m²)
    pairs, iterations, ending : points with a partner, linearisations, one of the codes above
    """

    H: NDArray[np.float64]
    cost: float
    weights: float
    squares: float
    pairs: int
    iterations: int
    ending: int


@njit(cache=True)
def align(voxels, points, T, prior, terms):
    """Move T (d+1, d+1), in place, to where the points (N, d) fit the map best near its first value.

    The cost is the robust sum of ``normal_equations`` plus ½ ξᵀ diag(prior) ξ, where ξ is the twist away from
    the first value: prior (k,) is the information of the prediction times the variance of a residual. Twists turn
    about the first value's position.
    Points keep their partners while the pose moves less than a hundredth of a voxel; steps that raise the cost
    of the same pairs are taken back and damped harder (Levenberg 1944, Marquardt 1963; gain ratio after
    Nielsen 1999).
    Returns an ``Outcome``.
    """
    k = 3 if points.shape[1] == 2 else 6
    H, b = np.zeros((k, k)), np.zeros(k)
    H_trial, b_trial = np.zeros((k, k)), np.zeros(k)
    factor, x, away = np.zeros((k, k)), np.zeros(k), np.zeros(k)
    T_trial = T.copy()
    origin = np.zeros(3)
    origin[: points.shape[1]] = T[:-1, -1]
    partner = np.empty(points.shape[0], np.int32)
    second_order = terms.optimiser == NEWTON
    damping, growth = 1e-4, 2.0
    renew, pairs, ending = True, 0, OUT_OF_ITERATIONS
    cost = weights = squares = 0.0
    iterations = 0
    scale_m = terms.first_scale_m
    while iterations < terms.max_iterations:
        iterations += 1
        if renew:
            pairs = associate(voxels, points, T, terms.reach, terms.max_distance_m, partner)
            if pairs == 0:
                ending = NO_PARTNERS
                break
            cost, weights, squares = normal_equations(
                voxels, points, T, origin, partner, scale_m, terms.point_weight, second_order, H, b
            )
            cost += _add_prior(H, b, prior, away, 1.0)
        if not step(terms.optimiser, H, b, damping, factor, x):
            ending = SINGULAR
            break
        perturb(x, T, origin, T_trial)
        trial, trial_weights, trial_squares = normal_equations(
            voxels, points, T_trial, origin, partner, scale_m, terms.point_weight, second_order, H_trial, b_trial
        )
        away += x
        trial += _add_prior(H_trial, b_trial, prior, away, 1.0)
        small = _is_small(x, terms)
        if terms.optimiser == LEVENBERG_MARQUARDT and trial > cost * (1.0 + 1e-12):
            away -= x
            renew = False
            if damping > 1e8 or (small and scale_m <= terms.scale_m):
                ending = CONVERGED if small else NO_DECREASE
                break
            damping, growth = damping * growth, 2.0 * growth
            continue
        gain = (cost - trial) / max(predicted_decrease(H, b, x), 1e-300)
        damping, growth = max(relax(damping, min(gain, 1.0)), 1e-9), 2.0
        T[:, :] = T_trial
        H[:, :], b[:] = H_trial, b_trial
        cost, weights, squares = trial, trial_weights, trial_squares
        if small and scale_m <= terms.scale_m:
            ending = CONVERGED
            break
        scale_m = max(terms.scale_m, SHRINK * scale_m)
        renew = True
    orthonormalise(T)
    cost -= _add_prior(H, b, prior, away, -1.0)
    cost += 0.5 * terms.scale_m**2 * (points.shape[0] - pairs)
    return Outcome(H, cost, weights, squares, pairs, iterations, ending)


@njit(cache=True, inline="always")
def _add_prior(H, b, prior, away, sign: float) -> float:
    """Add the prediction's pull to the normal equations (or take it off again); returns its cost."""
    cost = 0.0
    for i in range(b.shape[0]):
        H[i, i] += sign * prior[i]
        b[i] += sign * prior[i] * away[i]
        cost += 0.5 * prior[i] * away[i] * away[i]
    return cost


@njit(cache=True, inline="always")
def _is_small(x, terms) -> bool:
    d = 2 if x.shape[0] == 3 else 3
    shift = turn = 0.0
    for i in range(x.shape[0]):
        if i < d:
            shift += x[i] * x[i]
        else:
            turn += x[i] * x[i]
    return shift < terms.tolerance_m**2 and turn < terms.tolerance_rad**2
