"""Point-to-shape ICP against a voxel map: associate, linearize, step, until the pose stands still."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanchain.kernels.geometry.twist import orthonormalize, perturb
from scanchain.kernels.registration.association import associate
from scanchain.kernels.registration.descent import LEVENBERG_MARQUARDT, predicted_decrease, relax, step
from scanchain.kernels.registration.linearization import (
    COST,
    DAMPING,
    SQUARES,
    WEIGHTS,
    Estimate,
    Problem,
    leave_out_points,
    linearize,
    pull,
    take,
    weigh_up,
)
from scanchain.kernels.registration.residuals import information
from scanchain.kernels.registration.weights import weigh

CONVERGED, OUT_OF_ITERATIONS, NO_PARTNERS, SINGULAR = 0, 1, 2, 3

SHRINK = 0.6  # of the kernel's scale from one association to the next
SLACK = 0.02  # voxels that points may move before they look for new partners
PATIENCE = 20  # steps at the last scale
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-9, 1e8


class Outcome(NamedTuple):
    """How an alignment ended.

    H (k, k) : Σ w JᵀJ over planes and lines alone, twists about the first value's position, map axes; the mean
        of a voxel without a shape holds a pose in every direction, whether the surface there does or not
    unweighted (k, k) : the same without robust weights
    cost : robust cost in m², every unpaired point at its limit ½s²
    weights, squares : Σ w and Σ w r² (m²)
    pairs, iterations, ending : points with a partner, linearizations, one of the codes above
    origin (3,), partner (N,), trust (N,) : what twists turn about, and the last pairs, points without a shape
        out of trust
    """

    H: NDArray[np.float64]
    unweighted: NDArray[np.float64]
    cost: float
    weights: float
    squares: float
    pairs: int
    iterations: int
    ending: int
    origin: NDArray[np.float64]
    partner: NDArray[np.int32]
    trust: NDArray[np.float64]


@njit(cache=True, nogil=True)
def align(voxels, points, T, away, prior, range_m: float, first_scale_m: float, terms):
    """Move T (d+1, d+1), in place, to where the points (N, d) fit the map best near its first value.

    The cost is the robust sum of ``normal_equations`` plus ½ ξᵀ prior ξ, where ξ is the twist away from the
    prediction, ``away`` (k,) for the first value: prior (k, k) is the information of the prediction times the
    variance of a residual. Twists turn about the first value's position, along the map's axes.
    Points find new partners when they have moved by more than SLACK, until PATIENCE steps were taken with the
    kernel at its last scale: pairs that flip to and fro would go on for ever. From then on the pairs stay.
    range_m : root mean square of the points' ranges; first_scale_m : that the kernel's scale shrinks from
    Returns an ``Outcome``.
    """
    k = 3 if points.shape[1] == 2 else 6
    origin = position_of(T)
    partner, trust = np.empty(points.shape[0], np.int32), np.empty(points.shape[0])
    problem = Problem(voxels, points, origin, prior, partner, trust, terms)
    now = Estimate(T, away.copy(), np.zeros((k, k)), np.zeros(k), np.zeros(4))
    trial = Estimate(T.copy(), np.zeros(k), np.zeros((k, k)), np.zeros(k), np.zeros(4))
    x, factor = np.zeros(k), np.zeros((k, k))
    now.sums[DAMPING] = _FIRST_DAMPING
    scale_m, last_scale_m, settled = first_scale_m, 0.0, 0
    moved_m = np.inf
    pairs, iterations, ending = 0, 0, OUT_OF_ITERATIONS
    while iterations < terms.max_iterations:
        iterations += 1
        if settled < PATIENCE and moved_m > SLACK * voxels.size_m:
            moved_m = 0.0
            pairs = associate(voxels, points, T, terms.reach, terms.max_distance_m, partner)
            if pairs == 0:
                ending = NO_PARTNERS
                break
            weigh(voxels, points, T, partner, terms.variance, trust)
        if moved_m == 0.0 or scale_m != last_scale_m:
            linearize(problem, scale_m, now)
        slack_m = -1.0  # a scale that shrinks changes all weights
        if scale_m <= terms.scale_m:
            slack_m = SLACK * voxels.size_m - moved_m if settled + 1 < PATIENCE else np.inf
        if not _descend(problem, scale_m, range_m, slack_m, now, trial, x, factor):
            ending = SINGULAR
            break
        if scale_m <= terms.scale_m:
            if _is_small(x, terms):
                ending = CONVERGED
                break
            settled += 1
        moved_m += _largest_move(x, range_m)
        last_scale_m, scale_m = scale_m, max(terms.scale_m, SHRINK * scale_m)
    orthonormalize(T)
    cost = now.sums[COST] - pull(prior, now.away) + 0.5 * terms.scale_m**2 * (points.shape[0] - pairs)
    leave_out_points(voxels, partner, trust)
    information(voxels, points, T, origin, partner, trust, terms.scale_m, now.H, trial.H)
    return Outcome(
        now.H,
        trial.H,
        cost,
        now.sums[WEIGHTS],
        now.sums[SQUARES],
        pairs,
        iterations,
        ending,
        origin,
        partner,
        trust,
    )


@njit(cache=True, nogil=True)
def position_of(T):
    """Of a pose (d+1, d+1), as (3,); z is 0 in the plane."""
    out, d = np.zeros(3), T.shape[0] - 1
    for axis in range(d):
        out[axis] = T[axis, d]
    return out


@njit(cache=True, nogil=True)
def _descend(problem, scale_m: float, range_m: float, slack_m: float, now, trial, x, factor) -> bool:
    """Take one step x (k,) with the present pairs; False where the equations determine none.

    Levenberg–Marquardt takes back a step that raises the cost and damps harder (Marquardt 1963), by a factor
    that doubles each time (Nielsen 1999); x is zero where no step lowers the cost any more. After a step by which
    a point moves further than slack_m the normal equations are due to be made anew: none are made here.
    """
    terms = problem.terms
    growth = 2.0
    while step(terms.optimizer, now.H, now.b, now.sums[DAMPING], factor, x):
        perturb(x, now.T, problem.origin, trial.T)
        for i in range(x.shape[0]):
            trial.away[i] = now.away[i] + x[i]
        if _largest_move(x, range_m) > slack_m:
            weigh_up(problem, scale_m, trial)
        else:
            linearize(problem, scale_m, trial)
        lowered = now.sums[COST] - trial.sums[COST]
        if terms.optimizer != LEVENBERG_MARQUARDT or lowered >= 0.0:
            gain = lowered / max(predicted_decrease(now.H, now.b, x), 1e-300)
            trial.sums[DAMPING] = max(relax(now.sums[DAMPING], min(gain, 1.0)), _LEAST_DAMPING)
            take(now, trial)
            return True
        if _is_small(x, terms) or now.sums[DAMPING] > _MOST_DAMPING:
            x.fill(0.0)
            return True
        now.sums[DAMPING] *= growth
        growth *= 2.0
    return False


@njit(cache=True, inline="always")
def _largest_move(x, range_m: float) -> float:
    """How far a step x moves a point at that range, at most; meters."""
    shift, turn = _squares(x)
    return np.sqrt(shift) + np.sqrt(turn) * range_m


@njit(cache=True, inline="always")
def _is_small(x, terms) -> bool:
    shift, turn = _squares(x)
    return shift < terms.tolerance_m**2 and turn < terms.tolerance_rad**2


@njit(cache=True, inline="always")
def _squares(x):
    """Squared length of the shift and of the turn in a step x (k,)."""
    d = 2 if x.shape[0] == 3 else 3
    shift = turn = 0.0
    for i in range(x.shape[0]):
        if i < d:
            shift += x[i] * x[i]
        else:
            turn += x[i] * x[i]
    return shift, turn
