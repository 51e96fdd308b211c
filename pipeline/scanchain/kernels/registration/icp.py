"""Point-to-shape ICP against a voxel map: associate, linearize, step, until the pose is at a minimum."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.geometry import orthonormalize, perturb
from scanchain.kernels.matrices import factorize, substitute
from scanchain.kernels.registration.association import associate, weigh
from scanchain.kernels.registration.residuals import Problem, gradients_by_group, normal_equations, robust_sums
from scanchain.kernels.voxels import LINE, PLANE, POINT, Cell, move, shape_of

SHRINK = 0.6  # ratio of the kernel's scale from one iteration to the next
SLACK = 0.02  # voxels that points may move before they are re-associated
PATIENCE = 20  # steps at the final scale, after which correspondences are fixed
_DAMPING = (1e-9, 1e8)  # least and most
_SECTORS = 8  # of a scan


class Ending(IntEnum):
    """Why the iterations ended."""

    CONVERGED, OUT_OF_ITERATIONS, NO_CORRESPONDENCES, SINGULAR = 0, 1, 2, 3


class Sums(IntEnum):
    """Entries of ``Iterate.sums``: cost in m², Σ w, Σ w r² in m², damping."""

    COST, WEIGHT, SQUARES, DAMPING = 0, 1, 2, 3


class Optimizer(IntEnum):
    """Rules for a step."""

    GRADIENT_DESCENT, NEWTON, GAUSS_NEWTON, LEVENBERG_MARQUARDT = 0, 1, 2, 3


class Iterate(NamedTuple):
    """A pose, its twist ``offset`` (k,) from the predicted one, and its normal equations.

    sums : (4,) as in ``Sums``
    """

    T: NDArray[np.float64]
    offset: NDArray[np.float64]
    H: NDArray[np.float64]
    b: NDArray[np.float64]
    sums: NDArray[np.float64]


class Fit(NamedTuple):
    """Residuals of a problem at a pose.

    H (k, k) : Σ w JᵀJ over planes and lines, twists about the problem's origin, map axes; the mean of a voxel
        without a shape would constrain a pose in every direction, whether the surface does or not
    cost : robust cost in m², with the limit ½s² for every point without a correspondence
    total_weight, squares : Σ w and Σ w r² (m²)
    pairs, iterations, ending : correspondences, linearizations, an ``Ending``
    """

    H: NDArray[np.float64]
    cost: float
    total_weight: float
    squares: float
    pairs: int
    iterations: int
    ending: int


@njit(nogil=True)
def problem_of(voxels, points, T_first, prior, settings):
    """``Problem`` of points (N, d), twists about the position of T_first (d+1, d+1)."""
    (N, d), origin, squares = points.shape, np.zeros(3), 0.0
    for axis in range(d):
        origin[axis] = T_first[axis, d]
    for i in range(N):
        for axis in range(d):
            squares += points[i, axis] * points[i, axis]
    range_m = np.sqrt(squares / max(N, 1))
    return Problem(voxels, points, origin, prior, np.empty(N, np.int32), np.empty(N), range_m, settings)


@njit(nogil=True)
def align(problem, T, offset, first_scale_m: float):
    """``Fit`` at a minimum near T (d+1, d+1), which is moved there in place.

    The cost is the robust sum of ``normal_equations`` plus ½ ξᵀ prior ξ, ξ being the twist from the predicted
    pose, ``offset`` (k,) at first. Points are re-associated when they have moved by more than SLACK, until
    PATIENCE steps were taken at the final kernel scale: correspondences may alternate endlessly.
    first_scale_m : initial kernel scale
    """
    settings, size_m, k = problem.settings, problem.voxels.size_m, offset.shape[0]
    now = Iterate(T, offset.copy(), np.zeros((k, k)), np.zeros(k), np.zeros(4))
    trial = Iterate(T.copy(), np.zeros(k), np.zeros((k, k)), np.zeros(k), np.zeros(4))
    x, factor = np.zeros(k), np.zeros((k, k))
    now.sums[Sums.DAMPING] = 1e-4
    scale_m, last_scale_m, steps_at_last = first_scale_m, 0.0, 0
    moved_m = np.inf
    pairs, iterations, ending = 0, 0, Ending.OUT_OF_ITERATIONS.value
    while iterations < settings.max_iterations:
        iterations += 1
        if steps_at_last < PATIENCE and moved_m > SLACK * size_m:
            moved_m = 0.0
            pairs = correspond(problem, T, settings.reach, settings.max_distance_m)
            if pairs == 0:
                ending = Ending.NO_CORRESPONDENCES.value
                break
        if moved_m == 0.0 or scale_m != last_scale_m:
            _linearize(problem, scale_m, now)
        slack_m = -1.0  # a scale that shrinks changes all weights
        if scale_m <= settings.scale_m:
            slack_m = SLACK * size_m - moved_m if steps_at_last + 1 < PATIENCE else np.inf
        if not _descend(problem, scale_m, slack_m, now, trial, x, factor):
            ending = Ending.SINGULAR.value
            break
        if scale_m <= settings.scale_m:
            if _is_small(x, settings):
                ending = Ending.CONVERGED.value
                break
            steps_at_last += 1
        moved_m += _largest_move(x, problem.range_m)
        last_scale_m, scale_m = scale_m, max(settings.scale_m, SHRINK * scale_m)
    orthonormalize(T)
    cost = now.sums[Sums.COST] - _prior_cost(problem.prior, now.offset)
    cost += 0.5 * settings.scale_m**2 * (problem.points.shape[0] - pairs)
    H = shape_information(problem, T)
    return Fit(H, cost, now.sums[Sums.WEIGHT], now.sums[Sums.SQUARES], pairs, iterations, ending)


@njit(nogil=True)
def fit_at(problem, T, iterations: int, ending: int):
    """``Fit`` at the pose T itself, with correspondences within the final distance."""
    settings = problem.settings
    pairs = correspond(problem, T, settings.last_reach, settings.last_distance_m)
    cost, total_weight, squares = robust_sums(problem, T, settings.scale_m)
    cost += 0.5 * settings.scale_m**2 * (problem.points.shape[0] - pairs)
    return Fit(shape_information(problem, T), cost, total_weight, squares, pairs, iterations, ending)


@njit(inline="always")
def gradients_of_sectors(problem, T):
    """Gradients (8, k) of the points of each sector at the pose T.

    Sectors lie ahead or behind, left or right, nearer or farther than the problem's range: errors of calibration,
    of deskewing and from repetitive surfaces shift the points of one sector together.
    """
    points, sector = problem.points, np.empty(problem.points.shape[0], np.int32)
    for i in range(points.shape[0]):
        squared = 0.0
        for axis in range(points.shape[1]):
            squared += points[i, axis] * points[i, axis]
        sector[i] = (points[i, 0] > 0.0) + 2 * (points[i, 1] > 0.0) + 4 * (squared > problem.range_m**2)
    gradients = np.zeros((_SECTORS, problem.prior.shape[0]))
    gradients_by_group(problem, T, problem.settings.scale_m, sector, gradients)
    return gradients


@njit(nogil=True)
def correspond(problem, T, reach: int, max_distance_m: float):
    """Number of correspondences of the problem, re-associated and re-weighted at the pose T."""
    pairs = associate(problem.voxels, problem.points, T, reach, max_distance_m, problem.correspondence)
    if pairs:
        weigh(problem.voxels, problem.points, T, problem.correspondence, problem.settings.variance, problem.weight)
    else:
        problem.weight.fill(0.0)
    return pairs


@njit(nogil=True)
def closest_pairs(problem, T, scale_m: float, source, closest, weight):
    """Number of correspondences; fills moved points, the closest ones on their voxels' surfaces, and weights.

    The closest point is the projection to a plane or line (Besl & McKay 1992), or the mean without a shape.
    Correspondences are updated; weights are those of ``normal_equations``.

    scale_m : s; source, closest (N, d), weight (N,) : filled, one row per correspondence
    """
    correspond(problem, T, problem.settings.reach, problem.settings.max_distance_m)
    cells, points = problem.voxels.cells, problem.points
    correspondence, of_surface = problem.correspondence, problem.weight
    pairs, s2 = 0, scale_m * scale_m
    for i in range(points.shape[0]):
        if correspondence[i] < 0:
            continue
        p = move(T, points, i)
        shape, q, n = shape_of(cells, correspondence[i])
        e = p[0] - q[0], p[1] - q[1], p[2] - q[2]
        along = n[0] * e[0] + n[1] * e[1] + n[2] * e[2]
        foot = along * n[0], along * n[1], along * n[2]
        if shape == PLANE:
            e = foot
        elif shape == LINE:
            e = e[0] - foot[0], e[1] - foot[1], e[2] - foot[2]
        for axis in range(points.shape[1]):
            source[pairs, axis] = p[axis]
            closest[pairs, axis] = p[axis] - e[axis]
        ratio = s2 / (s2 + of_surface[i] * (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]))
        weight[pairs] = of_surface[i] * ratio * ratio
        pairs += 1
    return pairs


@njit(nogil=True)
def shape_information(problem, T):
    """Information (k, k) of planes and lines at the pose T; weights of voxels without a shape are set to 0."""
    k = problem.prior.shape[0]
    for i in range(problem.points.shape[0]):
        voxel = problem.correspondence[i]
        if voxel >= 0 and problem.voxels.cells[voxel, Cell.SHAPE] == POINT:
            problem.weight[i] = 0.0
    H, b = np.empty((k, k)), np.empty(k)
    normal_equations(problem, T, problem.settings.scale_m, 0.0, H, b)
    return H


@njit(nogil=True)
def refine(voxels, points, starts, poses, prior, least_share, settings):
    """Align many scans to one map, each pose in place, unless the scan does not fit.

    points : (N, d) meters of all scans, each in its own lidar frame; starts : (K + 1,) scan k is points[starts[k]
    : starts[k + 1]]; poses : (K, d+1, d+1)
    prior : (k, k) information of each initial pose, twists along the map's axes, times the variance of a residual
    least_share : of a scan's points with a correspondence, below which it does not fit
    """
    offset = np.zeros(prior.shape[0])
    for k in range(poses.shape[0]):
        scan = points[starts[k] : starts[k + 1]]
        T = poses[k].copy()
        problem = problem_of(voxels, scan, T, prior, settings)
        fit = align(problem, T, offset, settings.first_scale_m)
        if fit.ending == Ending.CONVERGED and fit.pairs >= least_share * scan.shape[0]:
            _copy(T, poses[k])


@njit(nogil=True)
def _descend(problem, scale_m: float, slack_m: float, now, trial, x, factor) -> bool:
    """True if one step x (k,) was taken with the current correspondences; False where H is singular.

    Levenberg–Marquardt rejects a step that raises the cost and increases the damping (Marquardt 1963), by a factor
    that doubles each time; after a step of gain ratio ρ the damping is λ · max(⅓, 1 − (2ρ − 1)³) (Nielsen 1999). x
    is zero where no step lowers the cost any more. After a step that moves a point further than slack_m, the
    normal equations are not updated: the caller re-associates.
    """
    settings = problem.settings
    growth = 2.0
    while step(settings.optimizer, now.H, now.b, now.sums[Sums.DAMPING], factor, x):
        perturb(x, now.T, problem.origin, trial.T)
        for i in range(x.shape[0]):
            trial.offset[i] = now.offset[i] + x[i]
        if _largest_move(x, problem.range_m) > slack_m:
            _evaluate(problem, scale_m, trial)
        else:
            _linearize(problem, scale_m, trial)
        lowered = now.sums[Sums.COST] - trial.sums[Sums.COST]
        if settings.optimizer != Optimizer.LEVENBERG_MARQUARDT or lowered >= 0.0:
            gain = min(lowered / max(predicted_decrease(now.H, now.b, x), 1e-300), 1.0)
            relaxed = now.sums[Sums.DAMPING] * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            trial.sums[Sums.DAMPING] = max(relaxed, _DAMPING[0])
            _accept(now, trial)
            return True
        if _is_small(x, settings) or now.sums[Sums.DAMPING] > _DAMPING[1]:
            x.fill(0.0)
            return True
        now.sums[Sums.DAMPING] *= growth
        growth *= 2.0
    return False


@njit(nogil=True)
def _linearize(problem, scale_m: float, iterate):
    """Fill the iterate's normal equations and sums at its pose, the prior included."""
    curvature = 1.0 if problem.settings.optimizer == Optimizer.NEWTON else 0.0
    cost, total_weight, squares = normal_equations(problem, iterate.T, scale_m, curvature, iterate.H, iterate.b)
    for i in range(iterate.b.shape[0]):
        gradient = 0.0
        for j in range(iterate.b.shape[0]):
            gradient += problem.prior[i, j] * iterate.offset[j]
            iterate.H[i, j] += problem.prior[i, j]
        iterate.b[i] += gradient
        cost += 0.5 * gradient * iterate.offset[i]
    iterate.sums[Sums.COST], iterate.sums[Sums.WEIGHT], iterate.sums[Sums.SQUARES] = cost, total_weight, squares


@njit(inline="always")
def _evaluate(problem, scale_m: float, iterate):
    """Fill the iterate's sums at its pose, without updating its normal equations."""
    cost, total_weight, squares = robust_sums(problem, iterate.T, scale_m)
    cost += _prior_cost(problem.prior, iterate.offset)
    iterate.sums[Sums.COST], iterate.sums[Sums.WEIGHT], iterate.sums[Sums.SQUARES] = cost, total_weight, squares


@njit(inline="always")
def _accept(now, trial):
    _copy(trial.T, now.T)
    _copy(trial.H, now.H)
    for i in range(now.b.shape[0]):
        now.offset[i], now.b[i] = trial.offset[i], trial.b[i]
    for i in range(now.sums.shape[0]):
        now.sums[i] = trial.sums[i]


@njit(inline="always")
def _copy(matrix, out):
    """Copy a matrix by its entries: for an assignment, Numba compiles a shape check, which takes seconds."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = matrix[i, j]


@njit(inline="always")
def _prior_cost(prior, offset) -> float:
    """½ ξᵀ prior ξ."""
    total = 0.0
    for i in range(offset.shape[0]):
        for j in range(offset.shape[0]):
            total += offset[i] * prior[i, j] * offset[j]
    return 0.5 * total


@njit(inline="always")
def _largest_move(x, range_m: float) -> float:
    """Largest distance that a step x moves a point at that range; meters."""
    shift, turn = _squares(x)
    return np.sqrt(shift) + np.sqrt(turn) * range_m


@njit(inline="always")
def _is_small(x, settings) -> bool:
    shift, turn = _squares(x)
    return shift < settings.tolerance_m**2 and turn < settings.tolerance_rad**2


@njit(inline="always")
def _squares(x):
    """Squared length of the translation and of the rotation in a step x (k,)."""
    d = 2 if x.shape[0] == 3 else 3
    shift = turn = 0.0
    for i in range(x.shape[0]):
        if i < d:
            shift += x[i] * x[i]
        else:
            turn += x[i] * x[i]
    return shift, turn


@njit(nogil=True)
def step(optimizer: int, H, b, damping: float, factor, x) -> bool:
    """True if the normal equations could be solved; the step ξ of one iteration is written to ``x`` (k,).

    Gradient descent    ξ = −(bᵀb / bᵀHb) b, the exact minimizer along the gradient (Cauchy's point)
    Newton              ξ = −H⁻¹b with the full Hessian; where that is indefinite the diagonal is raised
    Gauss–Newton        ξ = −(JᵀJ)⁻¹Jᵀr
    Levenberg–Marquardt ξ = −(JᵀJ + λ diag(JᵀJ))⁻¹Jᵀr (Marquardt 1963)
    factor : (k, k), buffer for the factorization
    """
    k = b.shape[0]
    if optimizer == Optimizer.GRADIENT_DESCENT:
        along = square = 0.0
        for i in range(k):
            square += b[i] * b[i]
            for j in range(k):
                along += b[i] * H[i, j] * b[j]
        for i in range(k):
            x[i] = -b[i] * square / along if along > 0.0 else 0.0
        return along > 0.0
    if optimizer != Optimizer.LEVENBERG_MARQUARDT:
        damping = 0.0
    while not factorize(H, damping, factor):
        if optimizer != Optimizer.NEWTON or damping >= 1e6:
            return False
        damping = max(4.0 * damping, 1e-3)
    substitute(factor, b, x)
    return True


@njit(inline="always")
def predicted_decrease(H, b, x) -> float:
    """Decrease of the quadratic model along the step, −bᵀx − ½ xᵀHx."""
    total = 0.0
    for i in range(b.shape[0]):
        row = b[i]
        for j in range(b.shape[0]):
            row += 0.5 * H[i, j] * x[j]
        total -= x[i] * row
    return total
