"""What an alignment works on: the problem, an estimate of its pose, and the normal equations there."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanchain.kernels.registration.descent import NEWTON
from scanchain.kernels.registration.residuals import normal_equations, robust_sums
from scanchain.kernels.voxels.voxel_shapes import POINT, SHAPE, Voxels

COST, WEIGHTS, SQUARES, DAMPING = 0, 1, 2, 3


class Terms(NamedTuple):
    """What an alignment runs under.

    reach, max_distance_m : of the search for correspondences while the pose moves
    last_reach, last_distance_m : of those that the answer is judged by
    first_scale_m, widest_scale_m, scale_m : of the kernel, at first unless the prediction is in doubt, at the
        most, and at last
    variance : of a range, σ² in m²
    min_information, min_signal : per weight, and times what noise would feign, below which a direction is not
        determined
    insertions : into the map so far
    """

    optimizer: int
    max_iterations: int
    reach: int
    max_distance_m: float
    last_reach: int
    last_distance_m: float
    first_scale_m: float
    widest_scale_m: float
    scale_m: float
    variance: float
    min_information: float
    min_signal: float
    insertions: int
    tolerance_m: float
    tolerance_rad: float


class Problem(NamedTuple):
    """What stays through an alignment, but for ``partner`` and ``trust`` (N,), the pairs of the moment."""

    voxels: Voxels
    points: NDArray[np.float64]
    origin: NDArray[np.float64]
    prior: NDArray[np.float64]
    partner: NDArray[np.int32]
    trust: NDArray[np.float64]
    terms: Terms


class Estimate(NamedTuple):
    """A pose, the twist ``away`` from the predicted one, and the normal equations there; ``sums`` (4,) above."""

    T: NDArray[np.float64]
    away: NDArray[np.float64]
    H: NDArray[np.float64]
    b: NDArray[np.float64]
    sums: NDArray[np.float64]


@njit(cache=True, nogil=True)
def linearize(problem, scale_m: float, estimate):
    """Fill the estimate's normal equations and sums at its pose, the prediction's pull included."""
    terms = problem.terms
    cost, weights, squares = normal_equations(
        problem.voxels,
        problem.points,
        estimate.T,
        problem.origin,
        problem.partner,
        problem.trust,
        scale_m,
        1.0 if terms.optimizer == NEWTON else 0.0,
        estimate.H,
        estimate.b,
    )
    for i in range(estimate.b.shape[0]):
        pull = 0.0
        for j in range(estimate.b.shape[0]):
            pull += problem.prior[i, j] * estimate.away[j]
            estimate.H[i, j] += problem.prior[i, j]
        estimate.b[i] += pull
        cost += 0.5 * pull * estimate.away[i]
    estimate.sums[COST], estimate.sums[WEIGHTS], estimate.sums[SQUARES] = cost, weights, squares


@njit(cache=True, nogil=True)
def weigh_up(problem, scale_m: float, estimate):
    """Fill the estimate's sums at its pose, and leave its normal equations alone."""
    cost, weights, squares = robust_sums(
        problem.voxels, problem.points, estimate.T, problem.partner, problem.trust, scale_m
    )
    cost += pull(problem.prior, estimate.away)
    estimate.sums[COST], estimate.sums[WEIGHTS], estimate.sums[SQUARES] = cost, weights, squares


@njit(cache=True, nogil=True)
def leave_out_points(voxels, partner, trust):
    """Take the weight from correspondences (N,) with a voxel that has no shape."""
    for i in range(partner.shape[0]):
        if partner[i] >= 0 and voxels.cells[partner[i], SHAPE] == POINT:
            trust[i] = 0.0


@njit(cache=True, nogil=True)
def take(now, trial):
    """Make the trial the present estimate."""
    for i in range(now.T.shape[0]):
        for j in range(now.T.shape[0]):
            now.T[i, j] = trial.T[i, j]
    for i in range(now.b.shape[0]):
        now.away[i], now.b[i] = trial.away[i], trial.b[i]
        for j in range(now.b.shape[0]):
            now.H[i, j] = trial.H[i, j]
    for i in range(now.sums.shape[0]):
        now.sums[i] = trial.sums[i]


@njit(cache=True, nogil=True)
def pull(prior, away) -> float:
    """½ ξᵀ prior ξ."""
    total = 0.0
    for i in range(away.shape[0]):
        for j in range(away.shape[0]):
            total += away[i] * prior[i, j] * away[j]
    return 0.5 * total
