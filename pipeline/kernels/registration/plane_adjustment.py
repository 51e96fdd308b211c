"""Plane adjustment: planes that several scans see, and equations of their poses and of an elevation offset."""

import math

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.geometry.eigen import eigenvalues_3d, eigenvector_3d
from scanchain.kernels.voxels.hashing import find_row, key_of

_FEWEST, _FEWEST_SCANS = 8, 3  # least number of points in a cell that counts as a plane, and of scans that see it
_THIN, _FLAT, _WIDE = 0.02, 0.15, 0.1  # of a plane: ratio of its variances, largest and least deviation in cells

_LEAST_SLOPE = 0.4  # of Σψ' over Σw, which bounds how much longer steps become


@njit(nogil=True)
def planes(points, number, poses, offset_rad: float, cell_m: float, lifted, beside, residual, plane, normals):
    """Find the cells of a grid whose points, of several scans, lie in a plane; returns how many, P.

    points : (N, 3) of lidar frames, by scans; number : (N,) of the scan of each; poses (K, 4, 4)
    Filled are lifted (N, 3), the points with elevations raised by the offset; plane (N,), the number of the plane
    of each, −1 outside; within, beside (N, 3), from the plane's mean, and residual (N,), along its normal; the
    first P rows of normals (N, 3), unit.
    """
    n, slots = points.shape[0], 2
    while slots < 2 * n:
        slots *= 2
    rows, keys = np.full(slots, -1, np.int32), np.empty(n, np.int64)
    sums, seen, last = np.zeros((n, 10)), np.zeros(n, np.int32), np.full(n, -1, np.int32)
    cells, sine, cosine = 0, math.sin(offset_rad), math.cos(offset_rad)
    for i in range(n):
        level = max(math.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2), 1e-9)
        stretch = cosine - sine * points[i, 2] / level
        lifted[i, 0], lifted[i, 1] = stretch * points[i, 0], stretch * points[i, 1]
        lifted[i, 2] = cosine * points[i, 2] + sine * level
        _seen_from(poses[number[i]], poses[0], lifted[i], beside[i])
        x, y, z = beside[i, 0], beside[i, 1], beside[i, 2]
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
        _add(sums[cell], x, y, z)
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
            residual[i] = 0.0
            for axis in range(3):
                beside[i, axis] -= sums[cell, 1 + axis] / sums[cell, 0]
                residual[i] += normals[p, axis] * beside[i, axis]
    return count


@njit(inline="always")
def _seen_from(T, T_origin, point, out):
    """Write T point (3,) with its coordinates relative to the position of T_origin, so that nothing cancels."""
    for row in range(3):
        out[row] = T[row, 3] - T_origin[row, 3]
        for column in range(3):
            out[row] += T[row, column] * point[column]


@njit(inline="always")
def _add(sums, x: float, y: float, z: float):
    sums[0] += 1.0
    sums[1] += x
    sums[2] += y
    sums[3] += z
    sums[4] += x * x
    sums[5] += x * y
    sums[6] += x * z
    sums[7] += y * y
    sums[8] += y * z
    sums[9] += z * z


@njit()
def _is_plane(sums, cell_m: float, normal) -> bool:
    """True if points of these sums lie in a plane, whose normal (3,) is written."""
    x, y, z = sums[1] / sums[0], sums[2] / sums[0], sums[3] / sums[0]
    xx, xy, xz = sums[4] / sums[0] - x * x, sums[5] / sums[0] - x * y, sums[6] / sums[0] - x * z
    yy, yz, zz = sums[7] / sums[0] - y * y, sums[8] / sums[0] - y * z, sums[9] / sums[0] - z * z
    small, middle, _ = eigenvalues_3d(xx, xy, xz, yy, yz, zz)
    if small >= min(_THIN * middle, (_FLAT * cell_m) ** 2) or middle <= (_WIDE * cell_m) ** 2:
        return False
    normal[0], normal[1], normal[2] = eigenvector_3d(xx, xy, xz, yy, yz, zz, small)
    return True


@njit(nogil=True)
def plane_equations(points, number, plane, beside, residual, normals, poses, scale_m: float, H, b):
    """Add up the normal equations of poses and offset; returns what scales H⁻¹ to a covariance, and a step.

    With p the raised point of scan k in a plane of unit normal n and mean x̄, and a = R_kᵀ n, T_k ← T_k exp(ξ) and
    an elevation raised by δ change the residual r = nᵀ(T_k p − x̄) by aᵀρ + (p × a)ᵀφ + aᵀ(∂p/∂δ) δ. The plane,
    height and two slopes, is free: its Schur complement is subtracted. Weights w = (1 + (r/s)²)⁻² of Geman and
    McClure (1985) with ψ = w r, of which least squares take w for the slope ψ' = (1 − 3 (r/s)²) / (1 + (r/s)²)³:
    their step is too short by Σψ'/Σw, and the variance is Σψ² Σw / (Σψ')² (Huber 1964).

    points : (N, 3) of lidar frames, raised; number, plane, residual (N,), beside (N, 3), normals (P, 3) of planes
    H (6K + 1, 6K + 1), b (6K + 1,) : zeros, filled
    """
    count, scans = normals.shape[0], poses.shape[0]
    J, g, total, squares, slopes = np.empty(7), np.empty(3), 0.0, 0.0, 0.0
    sums, S = np.zeros((count, scans, 6, 3)), np.zeros((count, 3, 3))
    of_offset, of_residual = np.zeros((count, 3)), np.zeros((count, 3))
    for i in range(points.shape[0]):
        k, p = number[i], plane[i]
        if p < 0:
            continue
        square = (residual[i] / scale_m) ** 2
        weight = 1.0 / (1.0 + square) ** 2
        _jacobian(points[i], normals[p], poses[k], J)
        _terms(beside[i], normals[p], g)
        _add_point(J, 6 * k, weight, residual[i], H, b)
        for m in range(3):
            weighted = weight * g[m]
            for row in range(6):
                sums[p, k, row, m] += weighted * J[row]
            of_offset[p, m] += weighted * J[6]
            of_residual[p, m] += weighted * residual[i]
            for other in range(m + 1):
                S[p, m, other] += weighted * g[other]
        total += weight
        squares += (weight * residual[i]) ** 2
        slopes += weight * (1.0 - 3.0 * square) / (1.0 + square)
    for p in range(count):
        _eliminate(sums[p], of_offset[p], of_residual[p], S[p], H, b)
    for row in range(H.shape[0]):
        for column in range(row):
            H[row, column] = H[column, row]
    slopes = max(slopes, _LEAST_SLOPE * total)
    return squares * total / slopes**2, total / slopes


@njit()
def _terms(beside, normal, g):
    """Write the derivative (3,) of a plane at a point by its parameters, height and slopes along two axes."""
    x, y, z = abs(normal[0]), abs(normal[1]), abs(normal[2])
    across = 0 if x >= max(y, z) else 1 if y >= z else 2
    g[0], g[1], g[2] = 1.0, beside[(across + 1) % 3], beside[(across + 2) % 3]


@njit()
def _jacobian(point, normal, T, J):
    """Write ∂r/∂(ρ, φ, δ) (7,)."""
    x, y, z = point[0], point[1], point[2]
    for axis in range(3):
        J[axis] = T[0, axis] * normal[0] + T[1, axis] * normal[1] + T[2, axis] * normal[2]
    J[3], J[4], J[5] = y * J[2] - z * J[1], z * J[0] - x * J[2], x * J[1] - y * J[0]
    level = max(math.sqrt(x * x + y * y), 1e-9)
    J[6] = level * J[2] - z / level * (x * J[0] + y * J[1])


@njit(inline="always")
def _add_point(J, first: int, weight: float, residual: float, H, b):
    """Add JᵀJ and Jᵀr to the upper half of H and to b, with the columns of a pose from ``first`` on."""
    last = H.shape[0] - 1
    for row in range(7):
        at = first + row if row < 6 else last
        for column in range(row, 7):
            H[at, first + column if column < 6 else last] += weight * J[row] * J[column]
        b[at] += weight * J[row] * residual


@njit()
def _eliminate(sums, of_offset, of_residual, S, H, b):
    """Subtract the Schur complement of a plane from its weighted sums, which are overwritten: S = L Lᵀ."""
    last = H.shape[0] - 1
    _factorize(S)
    _solve(S, of_offset)
    _solve(S, of_residual)
    for m in range(3):
        H[last, last] -= of_offset[m] ** 2
        b[last] -= of_offset[m] * of_residual[m]
    for k in range(sums.shape[0]):
        if sums[k, 0, 0] == 0.0 and sums[k, 1, 0] == 0.0 and sums[k, 2, 0] == 0.0:
            continue
        for row in range(6):
            _solve(S, sums[k, row])
            for m in range(3):
                H[6 * k + row, last] -= sums[k, row, m] * of_offset[m]
                b[6 * k + row] -= sums[k, row, m] * of_residual[m]
        for before in range(k + 1):
            _subtract_product(sums[before], sums[k], H[6 * before : 6 * before + 6, 6 * k : 6 * k + 6])


@njit(inline="always")
def _subtract_product(A, B, out):
    for row in range(6):
        for column in range(6):
            for m in range(3):
                out[row, column] -= A[row, m] * B[column, m]


@njit(inline="always")
def _factorize(S):
    """S (3, 3) ← L with S = L Lᵀ, in the lower half."""
    for m in range(3):
        for other in range(m + 1):
            for i in range(other):
                S[m, other] -= S[m, i] * S[other, i]
            S[m, other] = S[m, other] / S[other, other] if other < m else math.sqrt(max(S[m, m], 1e-12))


@njit(inline="always")
def _solve(L, right):
    """The right side (3,) ← L⁻¹ right."""
    for m in range(3):
        for i in range(m):
            right[m] -= L[m, i] * right[i]
        right[m] /= L[m, m]
