"""Observability of a pose: which directions its residuals constrain, and the prior where they do not."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.geometry import adjoint, centered
from scanchain.kernels.matrices import congruent, eigensystem
from scanchain.kernels.voxels import PLANE, Cell, History, move, shape_of, unpack

WEAK = 10.0  # times the limits of a degenerate direction, below which the prior is used along a direction
_FIXED = 1e3  # information of the prior along a degenerate direction, times that of all residuals
_ROUNDING = 1e-12  # of the largest eigenvalue, below which one is zero
_OLD = 2  # insertions since a voxel's first, after which it counts as independent of the current scan


class Spectrum(NamedTuple):
    """Observability by direction, about the problem's origin and along the map's axes.

    scale : (k,) of units: rotations count as the lengths they move a point at the scan's root mean square range
    values : (k,) eigenvalues, ascending, of the information per weight; 1 if every residual constrains it fully
    vectors : (k, k) unit eigenvectors, a column each, in scaled units
    signals : (k,) signal-to-noise ratio along each; infinite where not computed
    """

    scale: NDArray[np.float64]
    values: NDArray[np.float64]
    vectors: NDArray[np.float64]
    signals: NDArray[np.float64]


@njit(nogil=True)
def spectrum_of(H, total_weight: float, range_m: float):
    """``Spectrum`` of the information H (k, k) of residuals with this sum of weights."""
    k = H.shape[0]
    scale = np.ones(k)
    for i in range(2 if k == 3 else 3, k):
        scale[i] = 1.0 / max(range_m, 1e-9)
    scaled, values, vectors = np.empty((k, k)), np.empty(k), np.empty((k, k))
    for i in range(k):
        for j in range(k):
            scaled[i, j] = H[i, j] * scale[i] * scale[j] / max(total_weight, 1e-300)
    eigensystem(scaled, values, vectors)
    return Spectrum(scale, values, vectors, np.full(k, np.inf))


@njit(inline="always")
def _twist_of(spectrum, m: int, twist):
    """Write direction m of the spectrum to ``twist`` (k,), in meters and radians."""
    for i in range(twist.shape[0]):
        twist[i] = spectrum.vectors[i, m] * spectrum.scale[i]


@njit(nogil=True)
def agreement(H, unweighted, range_m: float) -> float:
    """Share of the information that the robust kernel leaves to the direction that loses most, 0 to 1.

    The smallest eigenvalue of H x = λ U x, with H and U (k, k) the information with and without robust weights:
    near 1 where the correspondences along every direction agree with the pose, low where those that constrain a
    direction contradict it, however many others (usually the ground) fit. Directions without information are
    ignored; 0 without any information.
    """
    k = H.shape[0]
    plain = spectrum_of(unweighted, 1.0, range_m)
    largest = plain.values[k - 1]
    if not largest > 0.0:
        return 0.0
    whitened, values, vectors = np.eye(k), np.empty(k), np.empty((k, k))
    for m in range(k):
        if plain.values[m] <= _ROUNDING * largest:
            continue
        for n in range(k):
            if plain.values[n] <= _ROUNDING * largest:
                continue
            total = 0.0
            for i in range(k):
                for j in range(k):
                    along = plain.vectors[i, m] * plain.vectors[j, n]
                    total += along * H[i, j] * plain.scale[i] * plain.scale[j]
            whitened[m, n] = total / np.sqrt(plain.values[m] * plain.values[n])
    eigensystem(whitened, values, vectors)
    return max(values[0], 0.0)


@njit(inline="always")
def is_below(spectrum, m: int, times: float, settings) -> bool:
    """True if direction m is below ``times`` the limits of a degenerate one."""
    is_blind = spectrum.values[m] < times * settings.min_information
    return is_blind or spectrum.signals[m] < times * settings.min_signal


@njit(nogil=True)
def weak_prior(spectrum, total_weight: float, believed, is_fused: bool, settings):
    """Information (k, k), times the variance of a residual, of the prior, along weak directions only.

    Along degenerate directions the pose is constrained to the prior (solution remapping; Zhang, Kaess & Singh
    2016).
    Up to WEAK times the limits, the prior has its own information ``believed`` (k, k), against that of the
    residuals without its noise-induced part: the share 1 − 1/signal. Stronger directions have no prior: a braking
    vehicle may contradict any prediction.
    is_fused : True to fuse a measured motion, along degenerate directions only, weighted against the information
        of the residuals that is not noise-induced
    """
    k = believed.shape[0]
    prior, twist = np.zeros((k, k)), np.empty(k)
    for m in range(k):
        if not is_below(spectrum, m, 1.0 if is_fused else WEAK, settings):
            continue
        _twist_of(spectrum, m, twist)
        strength = 0.0
        for i in range(k):
            for j in range(k):
                strength += twist[i] * believed[i, j] * twist[j]
        real = 1.0 - 1.0 / max(spectrum.signals[m], 1e-300)
        is_frozen = is_below(spectrum, m, 1.0, settings)
        if is_fused:
            is_frozen = spectrum.values[m] < settings.min_information or real <= 0.0
        if is_frozen or strength > real * _FIXED * total_weight:
            strength, real = _FIXED * total_weight, 1.0
        _add_along(spectrum, m, strength / real, prior)
    return prior


@njit(inline="always")
def remove_noise(spectrum, H, total_weight: float, settings):
    """Subtract the noise-induced part along weak directions from the information H (k, k) of residuals.

    Along a direction of signal-to-noise ratio s, the share 1/s of the information is noise-induced.
    """
    for m in range(H.shape[0]):
        if not is_below(spectrum, m, WEAK, settings):
            continue
        noise = total_weight * spectrum.values[m] / max(spectrum.signals[m], 1.0)
        _add_along(spectrum, m, -noise, H)


@njit(inline="always")
def _add_along(spectrum, m: int, amount: float, H):
    """Add this amount of information along direction m to H (k, k)."""
    for i in range(H.shape[0]):
        for j in range(H.shape[0]):
            along = spectrum.vectors[i, m] * spectrum.vectors[j, m]
            H[i, j] += amount * along / (spectrum.scale[i] * spectrum.scale[j])


@njit(inline="always")
def add_signals(problem, T, spectrum):
    """Fill the spectrum's signals, from the weakest direction to the first that is not weak."""
    twist = np.empty(spectrum.values.shape[0])
    for m in range(spectrum.values.shape[0]):
        _twist_of(spectrum, m, twist)
        spectrum.signals[m] = signal_along(problem, T, twist)
        if not is_below(spectrum, m, WEAK, problem.settings):
            break


@njit(nogil=True)
def signal_along(problem, T, twist) -> float:
    """Signal-to-noise ratio of the information along a twist (k,) (after Hatleskog & Alexis 2024).

    A normal n fitted to m points, with variance τ² about their plane and eigenvalues λ' along u and λ along v, has
    an error. A correspondence of weight w, displaced by d under the twist, therefore has, on average, the
    noise-induced information
        w τ²/m ((u·d)²/λ' + (v·d)²/λ)
    whether the direction is observable or not: where it is not, the ratio is about 1 or less.
    The informative voxels must be independent of the scan and of each other. Where the field of view ends, the
    points of a few rings form apparent walls that face the lidar and move along with it. So the most informative
    voxel and its neighbors are ignored, and so are voxels that are new in the map, if it has older ones.

    T (d+1, d+1) : pose at which the problem's points were associated
    """
    voxels, points, origin = problem.voxels, problem.points, problem.origin
    insertions = problem.settings.insertions
    parameters = 2.0 if points.shape[1] == 2 else 3.0
    informative = np.zeros(points.shape[0])
    total, noise, most, dominant = 0.0, 0.0, 0.0, np.int64(-1)  # a literal would compile it twice
    youngest = insertions - min(_OLD, insertions - 1)
    for i in range(points.shape[0]):
        voxel, weight = problem.correspondence[i], problem.weight[i]
        if voxel < 0 or weight == 0.0:
            continue
        x, y, z = move(T, points, i)
        x, y, z = x - origin[0], y - origin[1], z - origin[2]
        if points.shape[1] == 2:
            dx, dy, dz = twist[0] - twist[2] * y, twist[1] + twist[2] * x, 0.0
        else:
            dx = twist[0] + twist[4] * z - twist[5] * y
            dy = twist[1] + twist[5] * x - twist[3] * z
            dz = twist[2] + twist[3] * y - twist[4] * x
        shape, _, (nx, ny, nz) = shape_of(voxels.cells, voxel)
        along = nx * dx + ny * dy + nz * dz
        beside = dx * dx + dy * dy + dz * dz - along * along
        if shape == PLANE:
            noise += weight * _normal_variance(voxels.cells, voxel, dx, dy, dz, beside, parameters)
        if voxels.history[voxel, History.BORN] <= youngest:
            informative[i] = weight * (along * along if shape == PLANE else beside)
            total += informative[i]
            if informative[i] > most:
                most, dominant = informative[i], voxel
    if dominant >= 0:
        total -= _sum_around(voxels, dominant, problem.correspondence, informative)
    return max(total, 0.0) / max(noise, 1e-300)


@njit(inline="always")
def _normal_variance(cells, voxel: int, dx, dy, dz, beside: float, parameters: float) -> float:
    """Variance of n·d by the fit of a voxel's normal n, ``beside`` the squared length of d within the plane.

    τ² is estimated from m points less the parameters of the fit.
    """
    across = (
        cells[voxel, Cell.ACROSS] * dx + cells[voxel, Cell.ACROSS + 1] * dy + cells[voxel, Cell.ACROSS + 2] * dz
    )
    m = 1.0 / cells[voxel, Cell.MEAN_TERM]
    variance = cells[voxel, Cell.THICKNESS] * m / max(m - parameters, 1.0)
    slope_across, slope_along = cells[voxel, Cell.SLOPE_ACROSS], cells[voxel, Cell.SLOPE_ALONG]
    return variance * (slope_across * across * across + slope_along * (beside - across * across))


@njit(inline="always")
def _sum_around(voxels, voxel: int, correspondence, informative) -> float:
    """Sum of the information (N,) of correspondences with a voxel or its neighbors."""
    ix, iy, iz = unpack(voxels.keys[voxel])
    total = 0.0
    for i in range(correspondence.shape[0]):
        if informative[i] > 0.0:
            jx, jy, jz = unpack(voxels.keys[correspondence[i]])
            if max(abs(jx - ix), abs(jy - iy), abs(jz - iz)) <= 1:
                total += informative[i]
    return total


@njit(inline="always")
def seen_from_source(T, T_first, H, direction, variance: float):
    """Information (k, k) and a direction (k,) of twists, transformed to the source's own frame.

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
