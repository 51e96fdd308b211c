"""How much a pair is worth: the sensor's variance over the variance of the pair's residual."""

from numba import njit

from scanchain.kernels.voxels.voxel_shapes import (
    ACROSS,
    DIRECTION,
    LINE,
    MEAN_TERM,
    PLANE,
    SHAPE,
    SLOPE_ACROSS,
    SLOPE_ALONG,
    THICKNESS,
    move,
)

_GRAZING = 0.05  # sine of the angle between ray and plane at which a pair counts half
_SHEET = 2.0  # widths of a plane that a ray may spend within its thickness before the pair counts half
_NARROW = 3.0  # times σ, the width of a plane at which its normal is half noise
_UPRIGHT = 0.5  # cosine between a line and the lidar's vertical at which the line counts half


@njit(cache=True, nogil=True)
def weigh(voxels, points, T, partner, variance: float, trust):
    """Fill ``trust`` (N,) with σ²/(variance of the residual) ≤ 1 of every pair at the pose T; 0 without a partner.

    On a plane of thickness τ, fitted to n points with eigenvalues λ along and λ' across it, the residual at
    (a, c) from the mean has the variance max(τ², σ²)·(1 + 1/n + a²/(nλ) + c²/(nλ'))    (after Yuan et al. 2022).
    What a lidar strikes with one ring lies in a plane of its own, seen edge-on, that turns and rises with the
    lidar and would hold it back: little is known where a ray grazes the plane, where it would run through τ for
    longer than √λ', and where √λ' is but noise. In the plane (2D) every pair on a line counts in full.
    A line is worth its thickness where it stands upright, so that several rings have struck it: poles and trunks.
    Other lines are rings, mostly, and like voxels without a shape their mean stands for a surface to within s/2
    of a voxel of size s.

    points : (N, d) meters, source frame; partner : (N,) rows of the map's voxels, −1 for none
    T : (d+1, d+1), the lidar's z axis is that of its rings
    variance : σ² of the sensor, m²
    """
    planar = points.shape[1] == 2
    off_shapes = variance / (variance + 0.25 * voxels.size_m * voxels.size_m)
    for i in range(points.shape[0]):
        if partner[i] < 0:
            trust[i] = 0.0
            continue
        cell = voxels.cells[partner[i]]
        if planar:
            trust[i] = 1.0 if cell[SHAPE] == PLANE else off_shapes
            continue
        x, y, z = move(T, points, i)
        ex, ey, ez = x - cell[0], y - cell[1], z - cell[2]
        x, y, z = x - T[0, 3], y - T[1, 3], z - T[2, 3]
        if cell[SHAPE] == PLANE:
            worth = _clarity(cell, x, y, z, variance) / (1.0 + _uncertainty(cell, ex, ey, ez))
            trust[i] = worth * variance / max(cell[THICKNESS], variance)
        elif cell[SHAPE] == LINE:
            trust[i] = max(_uprightness(cell, T, x, y, z) * variance / max(cell[THICKNESS], variance), off_shapes)
        else:
            trust[i] = off_shapes


@njit(cache=True, inline="always")
def _uncertainty(cell, ex, ey, ez) -> float:
    """Variance of the fitted plane at a place (ex, ey, ez) from the mean, over that of a point on it."""
    out = cell[DIRECTION] * ex + cell[DIRECTION + 1] * ey + cell[DIRECTION + 2] * ez
    across = cell[ACROSS] * ex + cell[ACROSS + 1] * ey + cell[ACROSS + 2] * ez
    along2 = max(ex * ex + ey * ey + ez * ez - out * out - across * across, 0.0)
    return cell[MEAN_TERM] + cell[SLOPE_ACROSS] * across * across + cell[SLOPE_ALONG] * along2


@njit(cache=True, inline="always")
def _clarity(cell, x, y, z, variance: float) -> float:
    """How clearly the ray (x, y, z) shows that the plane is a surface and not the sheet of a ring, 0 to 1."""
    out = cell[DIRECTION] * x + cell[DIRECTION + 1] * y + cell[DIRECTION + 2] * z
    sine2 = out * out / max(x * x + y * y + z * z, 1e-300)
    width2 = cell[MEAN_TERM] / cell[SLOPE_ACROSS]
    edge = _GRAZING * _GRAZING + _SHEET * _SHEET * cell[THICKNESS] / width2
    return sine2 / (sine2 + edge) * width2 / (width2 + _NARROW * _NARROW * variance)


@njit(cache=True, inline="always")
def _uprightness(cell, T, x, y, z) -> float:
    """How far a line runs from ring to ring, the way the ray (x, y, z) goes when its elevation grows, 0 to 1."""
    zx, zy, zz = T[0, 2], T[1, 2], T[2, 2]
    height = (x * zx + y * zy + z * zz) / max(x * x + y * y + z * z, 1e-300)
    ux, uy, uz = zx - height * x, zy - height * y, zz - height * z
    cosine = cell[DIRECTION] * ux + cell[DIRECTION + 1] * uy + cell[DIRECTION + 2] * uz
    cosine2 = cosine * cosine / max(ux * ux + uy * uy + uz * uz, 1e-300)
    return cosine2 / (cosine2 + _UPRIGHT * _UPRIGHT)
