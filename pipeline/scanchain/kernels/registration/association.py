"""Correspondences: the nearest voxel mean of every point, and their weights."""

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.voxels import LINE, PLANE, Cell, find_row, move, pack

_GRAZING_SINE = 0.05  # of the angle between ray and plane at which the weight is halved
_RING_WIDTHS = 2.0  # path of a ray within the thickness of a plane, in widths of it, at which the weight is halved
_NOISE_WIDTHS = 3.0  # width of a plane, in σ, at which half of its normal is noise
_UPRIGHT_COSINE = 0.5  # of the angle between a line and the lidar's vertical, at which the weight is halved


@njit(nogil=True)
def associate(voxels, points, T, reach: int, max_distance_m: float, correspondence):
    """Number of points with a voxel mean within the distance; the row of the nearest in ``correspondence`` (N,).

    points : (N, d) meters; T moves them into the map's frame
    reach : voxels searched to each side: the 2ʳᵉᵃᶜʰ-fold of each axis around the point, (2·reach)ᵈ voxels
    correspondence : −1 where no mean is near enough
    A ring of voxels is searched only if a mean in it could be nearer than those found so far: r rings contain all
    means nearer than r − ½ voxels.
    """
    scale = 1.0 / voxels.size_m
    flat = points.shape[1] == 2
    found = 0
    for i in range(points.shape[0]):
        x, y, z = move(T, points, i)
        ix, iy = int(np.floor(x * scale - 0.5)), int(np.floor(y * scale - 0.5))
        iz = 0 if flat else int(np.floor(z * scale - 0.5))
        nearest = max_distance_m * max_distance_m
        chosen = -1
        for ring in range(1, reach + 1):
            for dx in range(1 - ring, ring + 1):
                for dy in range(1 - ring, ring + 1):
                    on_side = dx == 1 - ring or dx == ring or dy == 1 - ring or dy == ring
                    for dz in range(0 if flat else 1 - ring, 1 if flat else ring + 1):
                        if ring > 1 and not on_side and (flat or (dz > 1 - ring and dz < ring)):
                            continue
                        voxel = find_row(voxels.rows, voxels.keys, pack(ix + dx, iy + dy, iz + dz))
                        if voxel < 0:
                            continue
                        ex = voxels.cells[voxel, 0] - x
                        ey = voxels.cells[voxel, 1] - y
                        ez = voxels.cells[voxel, 2] - z
                        distance = ex * ex + ey * ey + ez * ez
                        is_nearer = distance < nearest  # unpredictable, hence without a branch
                        nearest = min(distance, nearest)
                        chosen += is_nearer * (voxel - chosen)
            covered = (ring - 0.5) * voxels.size_m
            if nearest <= covered * covered:
                break
        correspondence[i] = chosen
        found += chosen >= 0
    return found


@njit(inline="always")
def weigh(voxels, points, T, correspondence, variance: float, weight):
    """Weights (N,) of all correspondences at the pose T: σ²/(variance of the residual) ≤ 1, 0 without one.

    On a plane of thickness τ, fitted to n points with eigenvalues λ along and λ' across it, the residual at
    (a, c) from the mean has the variance max(τ², σ²)·(1 + 1/n + a²/(nλ) + c²/(nλ'))    (after Yuan et al. 2022).
    The points of a single ring lie in a plane, seen edge-on, that moves along with the lidar. A plane therefore
    has a low weight where the ray grazes it, where the ray would stay within τ for longer than √λ', and where √λ'
    is no more than noise. In 2D every correspondence with a line has the weight 1.
    A line is weighted by its thickness where it is upright, i.e. measured by several rings: poles, trunks. Other
    lines are mostly single rings; like that of voxels without a shape, their mean represents the surface to within
    s/2 for a voxel of size s.

    points : (N, d) meters, source frame; correspondence : (N,) rows of the map's voxels, −1 for none
    T : (d+1, d+1); the lidar's z axis is that of its rings
    variance : σ² of the sensor, m²
    """
    planar = points.shape[1] == 2
    without_shape = variance / (variance + 0.25 * voxels.size_m * voxels.size_m)
    for i in range(points.shape[0]):
        if correspondence[i] < 0:
            weight[i] = 0.0
            continue
        cell = voxels.cells[correspondence[i]]
        if planar:
            weight[i] = 1.0 if cell[Cell.SHAPE] == PLANE else without_shape
            continue
        x, y, z = move(T, points, i)
        ex, ey, ez = x - cell[0], y - cell[1], z - cell[2]
        x, y, z = x - T[0, 3], y - T[1, 3], z - T[2, 3]
        if cell[Cell.SHAPE] == PLANE:
            surface = _surface_weight(cell, x, y, z, variance) / (1.0 + _plane_variance(cell, ex, ey, ez))
            weight[i] = surface * variance / max(cell[Cell.THICKNESS], variance)
        elif cell[Cell.SHAPE] == LINE:
            weight[i] = max(
                _upright_weight(cell, T, x, y, z) * variance / max(cell[Cell.THICKNESS], variance), without_shape
            )
        else:
            weight[i] = without_shape


@njit(inline="always")
def _plane_variance(cell, ex, ey, ez) -> float:
    """Variance of the fitted plane at (ex, ey, ez) from the mean, over that of a point on it."""
    out = cell[Cell.DIRECTION] * ex + cell[Cell.DIRECTION + 1] * ey + cell[Cell.DIRECTION + 2] * ez
    across = cell[Cell.ACROSS] * ex + cell[Cell.ACROSS + 1] * ey + cell[Cell.ACROSS + 2] * ez
    along2 = max(ex * ex + ey * ey + ez * ez - out * out - across * across, 0.0)
    return cell[Cell.MEAN_TERM] + cell[Cell.SLOPE_ACROSS] * across * across + cell[Cell.SLOPE_ALONG] * along2


@njit(inline="always")
def _surface_weight(cell, x, y, z, variance: float) -> float:
    """Weight of a plane hit by the ray (x, y, z), low where its points may be those of one ring, 0 to 1."""
    out = cell[Cell.DIRECTION] * x + cell[Cell.DIRECTION + 1] * y + cell[Cell.DIRECTION + 2] * z
    sine2 = out * out / max(x * x + y * y + z * z, 1e-300)
    width2 = cell[Cell.MEAN_TERM] / cell[Cell.SLOPE_ACROSS]
    edge = _GRAZING_SINE * _GRAZING_SINE + _RING_WIDTHS * _RING_WIDTHS * cell[Cell.THICKNESS] / width2
    return sine2 / (sine2 + edge) * width2 / (width2 + _NOISE_WIDTHS * _NOISE_WIDTHS * variance)


@njit(inline="always")
def _upright_weight(cell, T, x, y, z) -> float:
    """Weight of a line by its alignment with increasing elevation of the ray, across the rings, 0 to 1."""
    zx, zy, zz = T[0, 2], T[1, 2], T[2, 2]
    height = (x * zx + y * zy + z * zz) / max(x * x + y * y + z * z, 1e-300)
    ux, uy, uz = zx - height * x, zy - height * y, zz - height * z
    cosine = cell[Cell.DIRECTION] * ux + cell[Cell.DIRECTION + 1] * uy + cell[Cell.DIRECTION + 2] * uz
    cosine2 = cosine * cosine / max(ux * ux + uy * uy + uz * uz, 1e-300)
    return cosine2 / (cosine2 + _UPRIGHT_COSINE * _UPRIGHT_COSINE)
