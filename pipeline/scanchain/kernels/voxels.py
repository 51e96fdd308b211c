"""A hash map of voxels with running moments of their points and the local shape fitted to them.

A voxel's row of ``moments`` holds n, Σx, Σy, Σz, Σxx, Σxy, Σxz, Σyy, Σyz, Σzz relative to the voxel's center, so
that no precision is lost far from the origin. Its row of ``cells`` holds what matching reads, in two cache lines:
mean (3), direction (3), shape; for a line or plane the variance across it; and for a plane in space its second
direction (3), and the factors from that variance to the variance of the fit: at the mean, and per squared distance
along both directions. Its row of ``history`` holds the ticks of the first and of the last insertion, and the
number of points when the shape was fitted. A 2D map is the plane z = 0 of the same layout.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.matrices import eigenvalues_3d, eigenvector_3d, normal_2d

EMPTY = np.int64(-1)  # no key
_OFFSET = 1 << 20
_LIMIT = (1 << 21) - 1
REACH = float(_OFFSET - 64)  # voxels around any point, within which keys are unique
POINT, LINE, PLANE = 0.0, 1.0, 2.0
CELL = 16  # columns of a cell, two more than are used, to fill the second cache line
_GROWN = 1.3  # factor by which the points of a voxel must grow to refit it
_FILLED = 2.5  # voxel size, in σ of a range, at which the mean is as far off the surface as the points
_BROAD = 0.125  # least width, in voxels, of a plane fitted to a voxel's own points alone
_BLOCK = 256  # points whose voxels are looked up together
MANY = 30.0  # number of points above which more add no information, since their poses share errors


class Cell(IntEnum):
    """Columns of ``cells``, after the mean."""

    DIRECTION, SHAPE, THICKNESS, ACROSS = 3, 6, 7, 8
    MEAN_TERM, SLOPE_ACROSS, SLOPE_ALONG = 11, 12, 13


class History(IntEnum):
    """Columns of ``history``."""

    BORN, SEEN, FITTED = 0, 1, 2


class Voxels(NamedTuple):
    """The arrays of a voxel map.

    ``rows`` (S,) is the hash table; it holds rows of ``keys`` (V,), ``moments`` (V, 10), ``cells`` (V, 16) and
    ``history`` (V, 3).
    """

    rows: NDArray[np.int32]
    keys: NDArray[np.int64]
    moments: NDArray[np.float64]
    cells: NDArray[np.float64]
    history: NDArray[np.int32]
    used: NDArray[np.int64]
    size_m: float


@njit(nogil=True)
def insert(voxels, points, T, tick: int, alone: float, variance: float):
    """Add points (N, d), moved by T into the map's frame, and refit the voxels that have grown enough.

    alone : number of points at which a voxel is fitted without its neighbors
    variance : σ² of the points, m², that is subtracted from shapes; 0 where it is small against the voxels
    There must be room for N more voxels.
    """
    touched = np.empty(points.shape[0], np.int32)
    sums = np.empty(10)
    moved, keys, rows = np.empty((_BLOCK, 3)), np.empty(_BLOCK, np.int64), np.empty(_BLOCK, np.int64)
    touches, voxel = 0, -1
    for start in range(0, points.shape[0], _BLOCK):
        part = points[start : start + _BLOCK]
        _locate(voxels, part, T, moved, keys, rows)
        for i in range(part.shape[0]):
            if i == 0 or keys[i] != keys[i - 1]:
                voxel = rows[i] if rows[i] >= 0 else _voxel_at(voxels, keys[i], tick)
                if voxels.history[voxel, History.SEEN] != tick:
                    voxels.history[voxel, History.SEEN] = tick
                    touched[touches] = voxel
                    touches += 1
            (ix, iy, iz), size = unpack(voxels.keys[voxel]), voxels.size_m
            x = moved[i, 0] - (ix + 0.5) * size
            y = moved[i, 1] - (iy + 0.5) * size
            z = moved[i, 2] - (iz + 0.5) * size
            add_moments(voxels.moments, voxel, x, y, z)
    for k in range(touches):
        voxel = touched[k]
        if voxels.moments[voxel, 0] >= _GROWN * voxels.history[voxel, History.FITTED]:
            _fit(voxels, voxel, points.shape[1], alone, variance, sums)
            voxels.history[voxel, History.FITTED] = np.int32(voxels.moments[voxel, 0])


@njit(nogil=True)
def _locate(voxels, points, T, moved, keys, rows):
    """Points moved by T, keys of their voxels, and rows of those found in the first slot of the table, else −1.

    Without branches on values read, so that the cache misses overlap.
    """
    scale = 1.0 / voxels.size_m
    for i in range(points.shape[0]):
        x, y, z = move(T, points, i)
        moved[i, 0], moved[i, 1], moved[i, 2] = x, y, z
        keys[i] = key_of(x, y, z, scale)
    for i in range(points.shape[0]):
        rows[i] = voxels.rows[first_slot(voxels.rows.size, keys[i])]
    for i in range(points.shape[0]):
        if voxels.keys[max(rows[i], 0)] != keys[i]:
            rows[i] = -1


@njit(inline="always")
def move(T, points, i: int):
    """Point i moved by the pose T; z is 0 in 2D."""
    x, y = points[i, 0], points[i, 1]
    if points.shape[1] == 2:
        return T[0, 0] * x + T[0, 1] * y + T[0, 2], T[1, 0] * x + T[1, 1] * y + T[1, 2], 0.0
    z = points[i, 2]
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@njit(inline="always")
def shape_of(cells, voxel: int):
    """Shape of a voxel, its mean and its direction.

    Returned as numbers: passing a row of ``cells`` would cost reference counting at every point.
    """
    q = cells[voxel, 0], cells[voxel, 1], cells[voxel, 2]
    normal = cells[voxel, Cell.DIRECTION], cells[voxel, Cell.DIRECTION + 1], cells[voxel, Cell.DIRECTION + 2]
    return cells[voxel, Cell.SHAPE], q, normal


@njit(nogil=True)
def keep(voxels, kept, x: float, y: float, z: float, radius_m: float, oldest_tick: int):
    """Copy to ``kept``, an empty map, the voxels within the radius of (x, y, z) and not older than the tick."""
    for voxel in range(voxels.used[0]):
        dx, dy, dz = voxels.cells[voxel, 0] - x, voxels.cells[voxel, 1] - y, voxels.cells[voxel, 2] - z
        is_old = voxels.history[voxel, History.SEEN] < oldest_tick
        if is_old or dx * dx + dy * dy + dz * dz > radius_m * radius_m:
            continue
        new = _voxel_at(kept, voxels.keys[voxel], 0)
        _copy_row(kept.moments, new, voxels.moments, voxel)
        _copy_row(kept.cells, new, voxels.cells, voxel)
        _copy_row(kept.history, new, voxels.history, voxel)


@njit(inline="always")
def _copy_row(to, row: int, source, other: int):
    """Copy one row element by element: takes half the time of a slice, whose references are counted."""
    for k in range(source.shape[1]):
        to[row, k] = source[other, k]


@njit(inline="always")
def _voxel_at(voxels, key: int, tick: int) -> int:
    """Row of the voxel with that key; a new one is empty."""
    row = find_row(voxels.rows, voxels.keys, key)
    if row >= 0:
        return row
    voxel = voxels.used[0]
    voxels.used[0] = voxel + 1
    voxels.rows[~row] = np.int32(voxel)
    voxels.keys[voxel] = key
    voxels.moments[voxel].fill(0.0)
    voxels.cells[voxel].fill(0.0)
    history = voxels.history[voxel]
    history[History.BORN], history[History.SEEN], history[History.FITTED] = tick, -1, 0
    return voxel


@njit(inline="always")
def add_moments(moments, row: int, x: float, y: float, z: float):
    """Add a point to the moments (10,) in a row."""
    moments[row, 0] += 1.0
    moments[row, 1] += x
    moments[row, 2] += y
    moments[row, 3] += z
    moments[row, 4] += x * x
    moments[row, 5] += x * y
    moments[row, 6] += x * z
    moments[row, 7] += y * y
    moments[row, 8] += y * z
    moments[row, 9] += z * z


@njit(inline="always")
def covariance_of(m):
    """xx, xy, xz, yy, yz, zz of the points with the moments m (10,)."""
    n = m[0]
    x, y, z = m[1] / n, m[2] / n, m[3] / n
    xx, xy, xz = m[4] / n - x * x, m[5] / n - x * y, m[6] / n - x * z
    return xx, xy, xz, m[7] / n - y * y, m[8] / n - y * z, m[9] / n - z * z


@njit(nogil=True)
def _fit(voxels, voxel: int, dimension: int, alone: float, variance: float, sums):
    """Fit the mean of the voxel's own points, and shape and direction of these or of the neighbors' too.

    The neighbors are included where the points are few or have no width: a ring that is measured repeatedly while
    the lidar stands still gives many points and no surface. Where points are noisy, the mean moves towards the
    plane of all by v / (v + r): v the mean's variance (σ²/n, more where noise fills the voxel), r the roughness.
    """
    ix, iy, iz = unpack(voxels.keys[voxel])
    m, cell, size = voxels.moments[voxel], voxels.cells[voxel], voxels.size_m
    cell[0] = (ix + 0.5) * size + m[1] / m[0]
    cell[1] = (iy + 0.5) * size + m[2] / m[0]
    cell[2] = (iz + 0.5) * size + m[3] / m[0] if dimension == 3 else 0.0
    width2 = _fit_shape(m, dimension, variance, cell) if m[0] >= alone else 0.0
    if width2 < (_BROAD * size) ** 2:
        _sum_neighborhood(voxels, ix, iy, iz, 1 if dimension == 3 else 0, sums)
        _fit_shape(sums, dimension, variance, cell)
        if variance > 0.0 and cell[Cell.SHAPE] == PLANE:
            x = sums[1] / sums[0] - m[1] / m[0]
            y = sums[2] / sums[0] - m[2] / m[0]
            z = sums[3] / sums[0] - m[3] / m[0]
            along = cell[Cell.DIRECTION] * x + cell[Cell.DIRECTION + 1] * y + cell[Cell.DIRECTION + 2] * z
            of_mean = variance / m[0] + variance * (_FILLED * _FILLED * variance / (size * size)) ** 2
            along *= of_mean / (of_mean + max(cell[Cell.THICKNESS] - variance, 0.0))
            for axis in range(3):
                cell[axis] += along * cell[Cell.DIRECTION + axis]


@njit(inline="always")
def _fit_shape(m, dimension: int, noise: float, cell) -> float:
    """Shape and direction of the points with the moments m (10,); returns its least variance within it, m²."""
    return _fit_2d(m, noise, cell) if dimension == 2 else _fit_3d(m, noise, cell)


@njit(inline="always")
def _sum_neighborhood(voxels, ix: int, iy: int, iz: int, height: int, sums):
    """Moments of the 3ᵈ voxels around one, relative to its center, written to ``sums`` (10,)."""
    sums.fill(0.0)
    size = voxels.size_m
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-height, height + 1):
                row = find_row(voxels.rows, voxels.keys, pack(ix + dx, iy + dy, iz + dz))
                if row < 0:
                    continue
                m = voxels.moments[row]
                n, x, y, z = m[0], dx * size, dy * size, dz * size
                sums[0] += n
                sums[1] += m[1] + n * x
                sums[2] += m[2] + n * y
                sums[3] += m[3] + n * z
                sums[4] += m[4] + 2.0 * x * m[1] + n * x * x
                sums[5] += m[5] + x * m[2] + y * m[1] + n * x * y
                sums[6] += m[6] + x * m[3] + z * m[1] + n * x * z
                sums[7] += m[7] + 2.0 * y * m[2] + n * y * y
                sums[8] += m[8] + y * m[3] + z * m[2] + n * y * z
                sums[9] += m[9] + 2.0 * z * m[3] + n * z * z


@njit(inline="always")
def _fit_2d(m, noise: float, cell):
    """Normal of the points where they lie along a line, by the eigenvalues of their covariance less the noise."""
    cell[Cell.SHAPE] = POINT
    n = m[0]
    if n < 3.0:
        return 0.0
    xx, xy, _, yy, _, _ = covariance_of(m)
    small, large, nx, ny = normal_2d(xx, xy, yy)
    if large > 1e-12 and small - noise < 0.1 * (large - noise):
        cell[Cell.SHAPE] = PLANE
        cell[Cell.DIRECTION], cell[Cell.DIRECTION + 1] = nx, ny
        cell[Cell.THICKNESS], cell[Cell.MEAN_TERM] = max(small, 0.0), 1.0 / min(n, MANY)
        cell[Cell.SLOPE_ALONG] = cell[Cell.MEAN_TERM] / large
    return large - noise


@njit(inline="always")
def _fit_3d(m, noise: float, cell):
    """Plane, line or point by the eigenvalues λ₁ ≤ λ₂ ≤ λ₃ of the covariance, less the noise in each.

    A plane is thin relative to its second extent, a line relative to its length in both others. For points on one
    line, rounding can make the first two negative.
    """
    cell[Cell.SHAPE] = POINT
    n = m[0]
    if n < 5.0:
        return 0.0
    xx, xy, xz, yy, yz, zz = covariance_of(m)
    small, middle, large = eigenvalues_3d(xx, xy, xz, yy, yz, zz)
    if middle > 0.0 and small - noise < 0.1 * max(middle - noise, 0.0):
        cell[Cell.SHAPE] = PLANE
        chosen = small
        wx, wy, wz = eigenvector_3d(xx, xy, xz, yy, yz, zz, middle)
        cell[Cell.ACROSS], cell[Cell.ACROSS + 1], cell[Cell.ACROSS + 2] = wx, wy, wz
        n = min(n, MANY)
        cell[Cell.THICKNESS], cell[Cell.MEAN_TERM] = max(small, 0.0), 1.0 / n
        cell[Cell.SLOPE_ACROSS], cell[Cell.SLOPE_ALONG] = 1.0 / (n * middle), 1.0 / (n * large)
    elif middle - noise < 0.1 * (large - noise):
        cell[Cell.SHAPE] = LINE
        chosen = large
        cell[Cell.THICKNESS] = max(middle, 0.0)
    else:
        return middle - noise
    vx, vy, vz = eigenvector_3d(xx, xy, xz, yy, yz, zz, chosen)
    cell[Cell.DIRECTION], cell[Cell.DIRECTION + 1], cell[Cell.DIRECTION + 2] = vx, vy, vz
    if vx == 0.0 and vy == 0.0 and vz == 0.0:
        cell[Cell.SHAPE] = POINT
    return middle - noise


@njit(inline="always")
def pack(ix: int, iy: int, iz: int) -> int:
    """One non-negative int64 for a voxel; unique for coordinates in [−2²⁰, 2²⁰), larger ones collide."""
    return (((ix + _OFFSET) & _LIMIT) << 42) | (((iy + _OFFSET) & _LIMIT) << 21) | ((iz + _OFFSET) & _LIMIT)


@njit(inline="always")
def key_of(x: float, y: float, z: float, scale: float) -> int:
    """Key of the voxel that holds a point; scale : voxels per meter."""
    return pack(int(np.floor(x * scale)), int(np.floor(y * scale)), int(np.floor(z * scale)))


@njit(inline="always")
def unpack(key: int):
    """The voxel coordinates of a key, pack's inverse."""
    return (key >> 42) - _OFFSET, ((key >> 21) & _LIMIT) - _OFFSET, (key & _LIMIT) - _OFFSET


@njit(inline="always")
def find(keys, key: int):
    """Slot that holds the key, or ~slot (negative) of the empty slot where it belongs."""
    slot = first_slot(keys.size, key)
    while True:
        held = keys[slot]
        if held == key:
            return slot
        if held == EMPTY:
            return ~slot
        slot = (slot + 1) & (keys.size - 1)


@njit(inline="always")
def find_row(rows, keys, key: int) -> int:
    """Row of ``keys`` (V,) that holds the key, or ~slot (negative) of the empty slot where that row belongs.

    rows : (S,) int32, −1 where a slot is empty; much smaller than a table of the keys, for fast probing
    """
    slot = first_slot(rows.size, key)
    while True:
        row = int(rows[slot])
        if row < 0:
            return ~slot
        if keys[row] == key:
            return row
        slot = (slot + 1) & (rows.size - 1)


@njit(inline="always")
def first_slot(slots: int, key: int) -> int:
    """The multiplicative hash of Knuth (1973, § 6.4) with 2⁶⁴/φ; the high bits are folded onto the low ones."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return int(np.int64((mixed >> np.uint64(32)) & np.uint64(slots - 1)))
