"""What pairs tell along a direction, over what the errors of their normals alone would feign."""

import numpy as np
from numba import njit

from scanchain.kernels.registration.observability import WEAK, is_below
from scanchain.kernels.voxels.hashing import unpack
from scanchain.kernels.voxels.voxel_shapes import (
    ACROSS,
    BORN,
    DIRECTION,
    MEAN_TERM,
    PLANE,
    SHAPE,
    SLOPE_ACROSS,
    SLOPE_ALONG,
    THICKNESS,
    move,
)

_FAR_FROM_WEAK = 0.1  # information per weight that noise of normals does not produce
_OLD = 2  # insertions after its first, from which on a voxel bears witness


@njit(cache=True, inline="always")
def listen(voxels, points, T, outcome, spectrum, terms):
    """Fill the spectrum's signals, from the weakest direction on to the first that the data are believed about."""
    k = spectrum.values.shape[0]
    twist = np.empty(k)
    for m in range(k):
        for i in range(k):
            twist[i] = spectrum.vectors[i, m] * spectrum.scale[i]
        spectrum.signals[m] = signal_along(voxels, points, T, outcome, twist, terms.insertions)
        if not is_below(spectrum, m, WEAK, terms):
            break


@njit(cache=True, inline="always")
def weakest_signal(voxels, points, T, outcome, spectrum, terms) -> float:
    """Signal along the direction of least information, infinite where that is far from weak."""
    if spectrum.values[0] > _FAR_FROM_WEAK:
        return np.inf
    twist = np.empty(spectrum.values.shape[0])
    for i in range(twist.shape[0]):
        twist[i] = spectrum.vectors[i, 0] * spectrum.scale[i]
    return signal_along(voxels, points, T, outcome, twist, terms.insertions)


@njit(cache=True, nogil=True)
def signal_along(voxels, points, T, outcome, twist, insertions: int) -> float:
    """How many times as much the pairs tell along a twist as the errors of their normals alone would feign.

    A normal n that was fitted to m points, of variance τ² about their plane and with eigenvalues λ' along u and λ
    along v, is off by some δ. Of a pair of weight w, which the twist displaces by d, the information w (n·d)² is
    too large, on average, by
        w τ²/m ((u·d)²/λ' + (v·d)²/λ)        (after Hatleskog & Alexis 2024)
    however blind the data are: where nothing else speaks the ratio is about 1, or below.
    One surface is no witness, nor is a young one: where sight ends, the points of a few rings form walls that face
    the lidar and move along with it. So the voxel that tells most does not count, nor do those around it, nor
    those that are new in the map, as far as it has older ones.

    outcome : of aligning the points (N, d) to the map; T (d+1, d+1), where it ended; twist (k,)
    """
    used_up = 2.0 if points.shape[1] == 2 else 3.0
    told = np.zeros(points.shape[0])
    total, feigned, most, loudest = 0.0, 0.0, 0.0, -1
    youngest = insertions - min(_OLD, insertions - 1)
    for i in range(points.shape[0]):
        voxel, weight = outcome.partner[i], outcome.trust[i]
        if voxel < 0 or weight == 0.0:
            continue
        cell = voxels.cells[voxel]
        dx, dy, dz = _displaced(T, points, i, outcome.origin, twist)
        along = cell[DIRECTION] * dx + cell[DIRECTION + 1] * dy + cell[DIRECTION + 2] * dz
        beside = dx * dx + dy * dy + dz * dz - along * along
        if cell[SHAPE] == PLANE:
            feigned += weight * _error(cell, dx, dy, dz, beside, used_up)
        if voxels.history[voxel, BORN] <= youngest:
            told[i] = weight * (along * along if cell[SHAPE] == PLANE else beside)
            total += told[i]
            if told[i] > most:
                most, loudest = told[i], voxel
    if loudest >= 0:
        total -= _told_around(voxels, loudest, outcome.partner, told)
    return total / max(feigned, 1e-300)


@njit(cache=True, inline="always")
def _displaced(T, points, i: int, origin, twist):
    """What a twist about the origin displaces a point by that T has moved."""
    x, y, z = move(T, points, i)
    x, y, z = x - origin[0], y - origin[1], z - origin[2]
    if points.shape[1] == 2:
        return twist[0] - twist[2] * y, twist[1] + twist[2] * x, 0.0
    return (
        twist[0] + twist[4] * z - twist[5] * y,
        twist[1] + twist[5] * x - twist[3] * z,
        twist[2] + twist[3] * y - twist[4] * x,
    )


@njit(cache=True, inline="always")
def _error(cell, dx: float, dy: float, dz: float, beside: float, used_up: float) -> float:
    """Variance of n·d for the normal of a cell, ``beside`` being the squared length of d within the plane.

    τ² is taken from m points, of which the fit has used up three, in the plane two.
    """
    across = cell[ACROSS] * dx + cell[ACROSS + 1] * dy + cell[ACROSS + 2] * dz
    m = 1.0 / cell[MEAN_TERM]
    variance = cell[THICKNESS] * m / max(m - used_up, 1.0)
    return variance * (cell[SLOPE_ACROSS] * across * across + cell[SLOPE_ALONG] * (beside - across * across))


@njit(cache=True, nogil=True)
def _told_around(voxels, voxel: int, partner, told) -> float:
    """What is told (N,) by pairs with a voxel or those beside it."""
    ix, iy, iz = unpack(voxels.keys[voxel])
    total = 0.0
    for i in range(partner.shape[0]):
        if told[i] > 0.0:
            jx, jy, jz = unpack(voxels.keys[partner[i]])
            if max(abs(jx - ix), abs(jy - iy), abs(jz - iz)) <= 1:
                total += told[i]
    return total
