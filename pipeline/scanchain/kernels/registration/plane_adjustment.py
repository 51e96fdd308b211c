"""Plane adjustment: planes seen by several scans, and normal equations of poses and an elevation offset."""

import math

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.matrices import eigenvalues_3d, eigenvector_3d, factorize
from scanchain.kernels.voxels import add_moments, covariance_of, find_row, key_of, move

_FEWEST, _FEWEST_SCANS = 8, 3  # least number of points in the cell of a plane, and of scans that see it
_THIN, _FLAT, _WIDE = 0.02, 0.15, 0.1  # of a plane: ratio of its variances, largest and least deviation in cells
LEAST_SLOPE = 0.4  # least ratio of Σψ' to Σw, which limits the extension of steps


@njit(nogil=True)
def planes(points, number, poses, cell_m: float, beside, residual, plane, normals):
    """Find the cells of a grid whose points, from several scans, lie in a plane; returns their number P.

    points : (N, 3) in lidar frames, by scans; number : (N,) scan of each; poses (K, 4, 4)
    Filled are plane (N,), the index of the plane of each point, −1 without one; beside (N, 3), its offset from the
    plane's mean, and residual (N,), that offset along the normal; the first P rows of normals (N, 3), unit.
    """
    n, slots = points.shape[0], 2
    while slots < 2 * n:
        slots *= 2
    rows, keys = np.full(slots, -1, np.int32), np.empty(n, np.int64)
    sums, seen, last = np.zeros((n, 10)), np.zeros(n, np.int32), np.full(n, -1, np.int32)
    cells = 0
    for i in range(n):
        T = poses[number[i]]
        x, y, z = move(T, points, i)
        x, y, z = x - poses[0, 0, 3], y - poses[0, 1, 3], z - poses[0, 2, 3]
        key = key_of(x, y, z, 1.0 / cell_m)
        cell = find_row(rows, keys, key)
        if cell < 0:
            rows[~cell] = cells
            keys[cells] = key
            cell = cells
            cells += 1
        if last[cell] != number[i]:
            last[cell] = number[i]
            seen[cell] += 1
        beside[i, 0], beside[i, 1], beside[i, 2] = x, y, z
        add_moments(sums, cell, x, y, z)
        plane[i] = cell
    count = 0
    for cell in range(cells):
        is_seen = sums[cell, 0] >= _FEWEST and seen[cell] >= _FEWEST_SCANS
        seen[cell] = -1
        if is_seen and _is_plane(sums[cell], cell_m, normals[count]):
            seen[cell] = count
            count += 1
    for i in range(n):
        cell = plane[i]
        plane[i] = p = seen[cell]
        if p >= 0:
            residual[i] = _from_mean(sums, cell, normals, p, beside, i)
    return count


@njit(inline="always")
def _from_mean(sums, cell: int, normals, p: int, beside, i: int) -> float:
    """Distance of a point from its plane; the point becomes its offset from the plane's mean."""
    residual = 0.0
    for axis in range(3):
        beside[i, axis] -= sums[cell, 1 + axis] / sums[cell, 0]
        residual += normals[p, axis] * beside[i, axis]
    return residual


@njit(inline="always")
def _is_plane(sums, cell_m: float, normal) -> bool:
    """True if points with these moments lie in a plane, whose normal (3,) is written."""
    xx, xy, xz, yy, yz, zz = covariance_of(sums)
    small, middle, _ = eigenvalues_3d(xx, xy, xz, yy, yz, zz)
    if small >= min(_THIN * middle, (_FLAT * cell_m) ** 2) or middle <= (_WIDE * cell_m) ** 2:
        return False
    normal[0], normal[1], normal[2] = eigenvector_3d(xx, xy, xz, yy, yz, zz, small)
    return True


@njit(nogil=True)
def plane_equations(points, number, plane, beside, residual, normals, poses, scale_m: float, H):
    """Sum up the normal equations of poses and offset; returns the factors on H⁻¹ for covariance and step.

    With p the raised point of scan k in a plane of unit normal n and mean x̄, and a = R_kᵀ n, T_k ← T_k exp(ξ) and
    an elevation raised by δ change the residual r = nᵀ(T_k p − x̄) by aᵀρ + (p × a)ᵀφ + aᵀ(∂p/∂δ) δ. The plane,
    height and two slopes, is estimated too: its Schur complement is subtracted. Weights w = (1 + (r/s)²)⁻² (Geman
    & McClure 1985) with ψ = w r. Least squares use w instead of the slope ψ' = (1 − 3 (r/s)²) / (1 + (r/s)²)³:
    their step is too short by Σψ'/Σw, and the variance is Σψ² Σw / (Σψ')² (Huber 1964).

    points : (N, 3) in lidar frames, raised; number, plane, residual (N,), beside (N, 3), normals (P, 3) of planes
    H (6K + 2, 6K + 2) : zeros, filled; the gradient in its last column
    """
    count, size, total, squares, slopes = normals.shape[0], H.shape[0], 0.0, 0.0, 0.0
    J, g, among = np.empty(8), np.empty(3), np.zeros((poses.shape[0], 8, 8))  # of (ρ, φ, δ, r)
    sums, S = np.zeros((count, 3, size)), np.zeros((count, 3, 3))
    for i in range(points.shape[0]):
        k, p = number[i], plane[i]
        if p < 0:
            continue
        square = (residual[i] / scale_m) ** 2
        weight = 1.0 / (1.0 + square) ** 2
        _jacobian(points, i, normals, p, poses, k, J)
        J[7] = residual[i]
        _terms(beside, residual, i, normals, p, g)
        _add_point(among, k, J, weight)
        _add_to_plane(sums, S, p, k, J, g, weight)
        total += weight
        squares += (weight * residual[i]) ** 2
        slopes += weight * (1.0 - 3.0 * square) / (1.0 + square)
    _unfold(among, H)
    for p in range(count):
        if factorize(S[p], 0.0, S[p]):
            _eliminate(S[p], sums[p], H)
    for row in range(size):
        H[row + 1 :, row] = H[row, row + 1 :]
    slopes = max(slopes, LEAST_SLOPE * total)
    return squares * total / slopes**2, total / slopes


@njit(inline="always")
def _add_point(among, k: int, J, weight: float):
    for row in range(8):
        weighted = weight * J[row]
        for column in range(8):
            among[k, row, column] += weighted * J[column]


@njit(inline="always")
def _add_to_plane(sums, S, p: int, k: int, J, g, weight: float):
    for m in range(3):
        weighted = weight * g[m]
        for row in range(6):
            sums[p, m, 6 * k + row] += weighted * J[row]
        sums[p, m, -2] += weighted * J[6]
        sums[p, m, -1] += weighted * J[7]
        for other in range(m + 1):
            S[p, m, other] += weighted * g[other]


@njit(nogil=True)
def _unfold(among, H):
    """Write sums (K, 8, 8) over the points of each scan, of pose, offset and residual, to the upper half of H."""
    last = H.shape[0] - 2
    for k in range(among.shape[0]):
        for row in range(8):
            for column in range(row, 8):
                at = 6 * k + row if row < 6 else last + row - 6
                H[at, 6 * k + column if column < 6 else last + column - 6] += among[k, row, column]


@njit(inline="always")
def _terms(beside, residual, i: int, normals, p: int, g):
    """Write the derivative (3,) of a plane at a point by its parameters, height and slopes along two axes.

    Taken at the point's projection to the plane, so that a common turn of all poses changes slopes only.
    """
    x, y, z = abs(normals[p, 0]), abs(normals[p, 1]), abs(normals[p, 2])
    across = 0 if x >= max(y, z) else 1 if y >= z else 2
    g[0] = 1.0
    for m in range(1, 3):
        axis = (across + m) % 3
        g[m] = beside[i, axis] - residual[i] * normals[p, axis]


@njit(inline="always")
def _jacobian(points, i: int, normals, p: int, poses, k: int, J):
    """Write ∂r/∂(ρ, φ, δ) (7,)."""
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
    for axis in range(3):
        J[axis] = poses[k, 0, axis] * nx + poses[k, 1, axis] * ny + poses[k, 2, axis] * nz
    J[3], J[4], J[5] = y * J[2] - z * J[1], z * J[0] - x * J[2], x * J[1] - y * J[0]
    level = max(math.sqrt(x * x + y * y), 1e-9)
    J[6] = level * J[2] - z / level * (x * J[0] + y * J[1])


@njit(nogil=True)
def _eliminate(L, sums, H):
    """Subtract the Schur complement of a plane from the upper half of H; sums ← L⁻¹ sums (3, 6K + 2)."""
    size = H.shape[0]
    for m in range(3):
        for i in range(m):
            for column in range(size):
                sums[m, column] -= L[m, i] * sums[i, column]
        for column in range(size):
            sums[m, column] /= L[m, m]
    for row in range(size - 1):
        x, y, z = sums[0, row], sums[1, row], sums[2, row]
        if x != 0.0 or y != 0.0 or z != 0.0:
            for column in range(row, size):
                H[row, column] -= x * sums[0, column] + y * sums[1, column] + z * sums[2, column]
