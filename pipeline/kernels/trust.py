"""How much a pair is worth: the sensor's variance over the variance of the pair's residual."""

from numba import njit

from pipeline.kernels.voxels import (
    ACROSS,
    DIRECTION,
    MEAN_TERM,
    PLANE,
    SHAPE,
    SLOPE_ACROSS,
    SLOPE_ALONG,
    THICKNESS,
    move,
)

_GRAZING = 0.05  # sine of the angle between ray and plane at which a pair counts half


@njit(cache=True, nogil=True)
def weigh(voxels, points, T, partner, variance: float, trust):
    """Fill ``trust`` (N,) with σ²/(variance of the residual) ≤ 1 of every pair at the pose T; 0 without a partner.

    On a plane of thickness τ, fitted to n points with eigenvalues λ along and λ' across it, the residual at
    (a, c) from the mean has the variance max(τ², σ²)·(1 + 1/n + a²/(nλ) + c²/(nλ'))    (after Yuan et al. 2022)
    and a ray that grazes it tells little: rings that cross a far wall lie in a plane of their own, seen edge-on,
    which turns with the lidar. In the plane (2D) every pair on a line counts in full.
    Off planes the mean of a voxel of size s only stands for the surface to within s²/12, the variance of a point
    in a voxel.

    points : (N, d) metres, source frame; partner : (N,) rows of the map's voxels, −1 for none
    variance : σ² of the sensor, m²
    """
    planar = points.shape[1] == 2
    off_planes = variance / (variance + voxels.size_m * voxels.size_m / 12.0)
    for i in range(points.shape[0]):
        if partner[i] < 0:
            trust[i] = 0.0
            continue
        cell = voxels.cells[partner[i]]
        if cell[SHAPE] != PLANE:
            trust[i] = off_planes
        elif planar:
            trust[i] = 1.0
        else:
            x, y, z = move(T, points, i)
            fit = _uncertainty(cell, x - cell[0], y - cell[1], z - cell[2])
            sine2 = _sine_squared(cell, x - T[0, 3], y - T[1, 3], z - T[2, 3])
            grazing = sine2 / (sine2 + _GRAZING * _GRAZING)
            trust[i] = grazing * variance / (max(cell[THICKNESS], variance) * (1.0 + fit))


@njit(cache=True, inline="always")
def _uncertainty(cell, ex, ey, ez) -> float:
    """Variance of the fitted plane at a place (ex, ey, ez) from the mean, over that of a point on it."""
    out = cell[DIRECTION] * ex + cell[DIRECTION + 1] * ey + cell[DIRECTION + 2] * ez
    across = cell[ACROSS] * ex + cell[ACROSS + 1] * ey + cell[ACROSS + 2] * ez
    along2 = max(ex * ex + ey * ey + ez * ez - out * out - across * across, 0.0)
    return cell[MEAN_TERM] + cell[SLOPE_ACROSS] * across * across + cell[SLOPE_ALONG] * along2


@njit(cache=True, inline="always")
def _sine_squared(cell, x, y, z) -> float:
    """Squared sine of the angle between the ray (x, y, z) and the plane."""
    out = cell[DIRECTION] * x + cell[DIRECTION + 1] * y + cell[DIRECTION + 2] * z
    return out * out / max(x * x + y * y + z * z, 1e-300)
