"""Normal equations of the distances between points and the shapes of their corresponding voxels."""

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.voxels.voxel_shapes import LINE, PLANE, POINT, move, shape_of

_SCATTER = 0x9E3779B1  # odd, near 2³² over the golden ratio, which scatters rows that follow each other (Knuth)


@njit(nogil=True)
def normal_equations(voxels, points, T, origin, correspondence, weight, scale_m: float, curvature: float, H, b):
    """Normal equations of all residuals at T, written to H (k, k) and b (k,).

    With p a point moved by T, q the mean of its voxel and n the normal there, a left twist ξ = (ρ, φ) about
    ``origin`` (all lengths counted from there, so that rotation and translation stay apart), T ← exp(ξ) T,
    changes the residual by
        r = nᵀ(p − q)        ∂r/∂ξ = [nᵀ, (p × n)ᵀ]     (Chen & Medioni 1992; in 2D Censi 2008)
    On a line the residuals are the two across it, on a point shape all components of p − q. Geman–McClure
    weighs each by w = (s² / (s² + r²))², r² the squared length of the residual (Geman & McClure 1985) times
    the weight of the correspondence.

    points : (N, d) meters, source frame; origin : (3,), map frame
    correspondence : (N,) rows of the map's voxels, −1 for none; weight : (N,) in [0, 1] of each
    scale_m : s; residuals far above it are all but ignored
    curvature : 1 adds the curvature of the motion, r nᵀ ∂²p/∂ξ², which makes H Newton's Hessian (the weights
        held fixed); 0 leaves it out
    H = Σ w JᵀJ, b = Σ w Jᵀr. Returns the cost Σ ½ s²r²/(s²+r²) in m², Σ w, and Σ w r² in m².
    """
    if H.shape[0] == 6:
        sums = _in_space(voxels, points, T, origin, correspondence, weight, scale_m, H, b)
    else:
        sums = _in_plane(voxels, points, T, origin, correspondence, weight, scale_m, H, b)
    if curvature > 0.0:
        _add_curvature(voxels, points, T, origin, correspondence, weight, scale_m, curvature, H)
    return sums


@njit(nogil=True)
def _in_space(voxels, points, T, origin, correspondence, weight, scale_m: float, H, b):
    """``normal_equations`` in space, without curvature: where a 3D scan spends most of its time.

    The sums are tuples, which the compiler keeps in registers; in arrays, every addition waits until the one
    before is stored.
    """
    cost = total_weight = squares = 0.0
    s2 = scale_m * scale_m
    upper, gradient = (0.0,) * 21, (0.0,) * 6
    for i in range(points.shape[0]):
        voxel = correspondence[i]
        if voxel < 0:
            continue
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(voxels.cells, voxel)
        residual, along, r2 = _residual(shape, q, normal, x, y, z)
        moved = x - origin[0], y - origin[1], z - origin[2]
        r2 *= weight[i]
        ratio = s2 / (s2 + r2)
        w = weight[i] * ratio * ratio
        cost += 0.5 * r2 * ratio
        total_weight += w
        squares += ratio * ratio * r2
        upper, gradient = _plus(upper, gradient, w, shape, normal, moved, residual, along)
    _unfold(upper, H)
    for row in range(6):
        b[row] = gradient[row]
    return cost, total_weight, squares


@njit(nogil=True)
def _in_plane(voxels, points, T, origin, correspondence, weight, scale_m: float, H, b):
    """``normal_equations`` in the plane, without curvature, as ``_in_space``."""
    cost = total_weight = squares = 0.0
    s2 = scale_m * scale_m
    upper, gradient = (0.0,) * 6, (0.0,) * 3
    for i in range(points.shape[0]):
        voxel = correspondence[i]
        if voxel < 0:
            continue
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(voxels.cells, voxel)
        residual, along, r2 = _residual(shape, q, normal, x, y, z)
        moved = x - origin[0], y - origin[1], z - origin[2]
        r2 *= weight[i]
        ratio = s2 / (s2 + r2)
        w = weight[i] * ratio * ratio
        cost += 0.5 * r2 * ratio
        total_weight += w
        squares += ratio * ratio * r2
        upper, gradient = _plus_in_plane(upper, gradient, w, shape, normal, moved, residual, along)
    _unfold(upper, H)
    for row in range(3):
        b[row] = gradient[row]
    return cost, total_weight, squares


@njit(forceinline=True)
def _plus(h, b, w, shape, normal, moved, residual, along):
    """Upper triangle h (21), by rows, and gradient b (6) with one correspondence of weight w, by its shape."""
    if shape != PLANE:
        h, b = _plus_point(h, b, w, moved, residual)
        w, along = -w, 0.0
    if shape != POINT:
        h, b = _plus_plane(h, b, w, moved, normal, along)
    return h, b


@njit(forceinline=True)
def _plus_in_plane(h, b, w, shape, normal, moved, residual, r):
    """Upper triangle h (6), by rows, and gradient b (3) with one correspondence of weight w.

    Point-to-line: J = [n, p × n]; point-to-point: J = [I, (−p_y, p_x)ᵀ].
    """
    (px, py, _), (ex, ey, _), (nx, ny, _) = moved, residual, normal
    if shape != PLANE:
        upper = h[0] + w, h[1], h[2] - w * py, h[3] + w, h[4] + w * px, h[5] + w * (px * px + py * py)
        return upper, (b[0] + w * ex, b[1] + w * ey, b[2] + w * (px * ey - py * ex))
    turn = px * ny - py * nx
    upper = (
        h[0] + w * nx * nx, h[1] + w * nx * ny, h[2] + w * nx * turn,
        h[3] + w * ny * ny, h[4] + w * ny * turn, h[5] + w * turn * turn,
    )  # fmt: skip
    return upper, (b[0] + w * nx * r, b[1] + w * ny * r, b[2] + w * turn * r)


@njit(forceinline=True)
def _unfold(upper, H):
    """Write an upper triangle, by rows, to the symmetric H."""
    k = 0
    for row in range(H.shape[0]):
        for column in range(row, H.shape[0]):
            H[row, column] = H[column, row] = upper[k]
            k += 1


@njit(forceinline=True)
def _plus_plane(h, b, w, moved, normal, r):
    """Upper triangle h (21), by rows, and gradient b (6) with one residual: J = [n, p × n]."""
    (px, py, pz), (nx, ny, nz) = moved, normal
    cx, cy, cz = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
    wx, wy, wz, wcx, wcy, wcz, wr = w * nx, w * ny, w * nz, w * cx, w * cy, w * cz, r * w
    upper = (
        h[0] + wx * nx, h[1] + wx * ny, h[2] + wx * nz, h[3] + wx * cx, h[4] + wx * cy, h[5] + wx * cz,
        h[6] + wy * ny, h[7] + wy * nz, h[8] + wy * cx, h[9] + wy * cy, h[10] + wy * cz,
        h[11] + wz * nz, h[12] + wz * cx, h[13] + wz * cy, h[14] + wz * cz,
        h[15] + wcx * cx, h[16] + wcx * cy, h[17] + wcx * cz,
        h[18] + wcy * cy, h[19] + wcy * cz,
        h[20] + wcz * cz,
    )  # fmt: skip
    return upper, (b[0] + wr * nx, b[1] + wr * ny, b[2] + wr * nz, b[3] + wr * cx, b[4] + wr * cy, b[5] + wr * cz)


@njit(forceinline=True)
def _plus_point(h, b, w, moved, residual):
    """Upper triangle h (21), by rows, and gradient b (6) with three residuals: J = [I, −p×]."""
    (px, py, pz), (ex, ey, ez) = moved, residual
    upper = (
        h[0] + w, h[1], h[2], h[3], h[4] + w * pz, h[5] - w * py,
        h[6] + w, h[7], h[8] - w * pz, h[9], h[10] + w * px,
        h[11] + w, h[12] + w * py, h[13] - w * px, h[14],
        h[15] + w * (py * py + pz * pz), h[16] - w * px * py, h[17] - w * px * pz,
        h[18] + w * (px * px + pz * pz), h[19] - w * py * pz,
        h[20] + w * (px * px + py * py),
    )  # fmt: skip
    turn = w * (py * ez - pz * ey), w * (pz * ex - px * ez), w * (px * ey - py * ex)
    return upper, (b[0] + w * ex, b[1] + w * ey, b[2] + w * ez, b[3] + turn[0], b[4] + turn[1], b[5] + turn[2])


@njit(nogil=True)
def information(
    voxels, points, T, origin, correspondence, weight, scale_m: float, range_m: float, H, unweighted, gradients
):
    """H = Σ w JᵀJ of ``normal_equations``, and ``unweighted`` (k, k), the same without robust weights.

    Written as well are the gradients (8, k), b of ``normal_equations`` by sector, which lie ahead or behind, left
    or right, nearer or farther than range_m. Calibration, motion within the scan and surfaces that repeat shift
    the points of a sector together.
    """
    gradients.fill(0.0)
    if H.shape[0] == 6:
        _information_in_space(
            voxels, points, T, origin, correspondence, weight, scale_m, range_m, H, unweighted, gradients
        )
    else:
        _information_in_plane(
            voxels, points, T, origin, correspondence, weight, scale_m, range_m, H, unweighted, gradients
        )


@njit(nogil=True)
def _information_in_space(
    voxels, points, T, origin, correspondence, weight, scale_m: float, range_m: float, H, unweighted, gradients
):
    """``information`` in space."""
    s2, none = scale_m * scale_m, (0.0,) * 6
    upper, plain = (0.0,) * 21, (0.0,) * 21
    for i in range(points.shape[0]):
        voxel = correspondence[i]
        if voxel < 0 or weight[i] == 0.0:
            continue
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(voxels.cells, voxel)
        residual, along, r2 = _residual(shape, q, normal, x, y, z)
        moved = x - origin[0], y - origin[1], z - origin[2]
        ratio = s2 / (s2 + r2 * weight[i])
        upper, b = _plus(upper, none, weight[i] * ratio * ratio, shape, normal, moved, residual, along)
        plain, _ = _plus(plain, none, weight[i], shape, normal, moved, residual, along)
        sector = _sector(points, i, range_m)
        for m in range(6):
            gradients[sector, m] += b[m]
    _unfold(upper, H)
    _unfold(plain, unweighted)


@njit(nogil=True)
def _information_in_plane(
    voxels, points, T, origin, correspondence, weight, scale_m: float, range_m: float, H, unweighted, gradients
):
    """``information`` in the plane."""
    s2, none = scale_m * scale_m, (0.0,) * 3
    upper, plain = (0.0,) * 6, (0.0,) * 6
    for i in range(points.shape[0]):
        voxel = correspondence[i]
        if voxel < 0 or weight[i] == 0.0:
            continue
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(voxels.cells, voxel)
        residual, along, r2 = _residual(shape, q, normal, x, y, z)
        moved = x - origin[0], y - origin[1], z - origin[2]
        ratio = s2 / (s2 + r2 * weight[i])
        upper, b = _plus_in_plane(upper, none, weight[i] * ratio * ratio, shape, normal, moved, residual, along)
        plain, _ = _plus_in_plane(plain, none, weight[i], shape, normal, moved, residual, along)
        sector = _sector(points, i, range_m)
        for m in range(3):
            gradients[sector, m] += b[m]
    _unfold(upper, H)
    _unfold(plain, unweighted)


@njit(inline="always")
def _sector(points, i: int, range_m: float) -> int:
    squared = 0.0
    for axis in range(points.shape[1]):
        squared += points[i, axis] * points[i, axis]
    return (points[i, 0] > 0.0) + 2 * (points[i, 1] > 0.0) + 4 * (squared > range_m * range_m)


@njit(nogil=True)
def gradient_spread(voxels, points, T, origin, correspondence, weight, scale_m: float):
    """Covariance (6, 6) of b in ``normal_equations``, by how b differs from voxel to voxel: Σ b_v b_vᵀ.

    Points with a correspondence in one voxel share the error of its plane, so that only their sums b_v are
    independent (cluster-robust covariance; Liang & Zeger 1986). Smooth floors then say more than rough walls.
    """
    size = 64
    while size < 2 * points.shape[0]:
        size *= 2
    slots, sums = np.full(size, -1, np.int32), np.zeros((size, 6))
    s2, no_upper, none = scale_m * scale_m, (0.0,) * 21, (0.0,) * 6
    for i in range(points.shape[0]):
        voxel = correspondence[i]
        if voxel < 0 or weight[i] == 0.0:
            continue
        slot = (voxel * _SCATTER) & (size - 1)
        while slots[slot] >= 0 and slots[slot] != voxel:
            slot = (slot + 1) & (size - 1)
        slots[slot] = voxel
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(voxels.cells, voxel)
        residual, along, r2 = _residual(shape, q, normal, x, y, z)
        moved = x - origin[0], y - origin[1], z - origin[2]
        ratio = s2 / (s2 + r2 * weight[i])
        w = weight[i] * ratio * ratio
        _, gradient = _plus(no_upper, none, w, shape, normal, moved, residual, along)
        for m in range(6):
            sums[slot, m] += gradient[m]
    spread = np.zeros((6, 6))
    for slot in range(size):
        if slots[slot] >= 0:
            for m in range(6):
                for n in range(6):
                    spread[m, n] += sums[slot, m] * sums[slot, n]
    return spread


@njit(nogil=True)
def robust_sums(voxels, points, T, correspondence, weight, scale_m: float):
    """The cost Σ ½ s²r²/(s²+r²) in m², Σ w, and Σ w r² in m², as ``normal_equations`` returns them."""
    cost = total_weight = squares = 0.0
    s2 = scale_m * scale_m
    for i in range(points.shape[0]):
        voxel = correspondence[i]
        if voxel < 0:
            continue
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(voxels.cells, voxel)
        r2 = weight[i] * _residual(shape, q, normal, x, y, z)[2]
        ratio = s2 / (s2 + r2)
        cost += 0.5 * r2 * ratio
        total_weight += weight[i] * ratio * ratio
        squares += ratio * ratio * r2
    return cost, total_weight, squares


@njit(forceinline=True)
def _residual(shape, q, normal, x, y, z):
    """Residual vector (3) of a point, its offset along the voxel's direction, and its squared length."""
    (qx, qy, qz), (nx, ny, nz) = q, normal
    ex, ey, ez = x - qx, y - qy, z - qz
    along = nx * ex + ny * ey + nz * ez
    if shape == PLANE:
        return (along * nx, along * ny, along * nz), along, along * along
    if shape == LINE:
        ex, ey, ez = ex - along * nx, ey - along * ny, ez - along * nz
    return (ex, ey, ez), along, ex * ex + ey * ey + ez * ez


@njit(nogil=True)
def _add_curvature(voxels, points, T, origin, correspondence, weight, scale_m: float, curvature: float, H):
    """Add the second derivatives of eᵀ exp(ξ) p at ξ = 0 to H (k, k), e the residual of each correspondence.

    exp(ξ) p = p + φ × p + ρ + ½ φ × (φ × p) + ½ φ × ρ + …, so that the blocks are
        ½(e pᵀ + p eᵀ) − (eᵀp) I for (φ, φ), in 2D −eᵀp, and ½ φᵀ(ρ × e) for (ρ, φ).
    """
    s2 = scale_m * scale_m
    for i in range(points.shape[0]):
        voxel = correspondence[i]
        if voxel < 0:
            continue
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(voxels.cells, voxel)
        (ex, ey, ez), _, r2 = _residual(shape, q, normal, x, y, z)
        px, py, pz = x - origin[0], y - origin[1], z - origin[2]
        ratio = s2 / (s2 + r2 * weight[i])
        w = curvature * weight[i] * ratio * ratio
        dot = ex * px + ey * py + ez * pz
        half = 0.5 * w
        if H.shape[0] == 3:
            H[2, 2] -= w * dot
            H[0, 2] += half * ey
            H[1, 2] -= half * ex
            continue
        H[0, 4] -= half * ez
        H[0, 5] += half * ey
        H[1, 3] += half * ez
        H[1, 5] -= half * ex
        H[2, 3] -= half * ey
        H[2, 4] += half * ex
        H[3, 3] += w * (ex * px - dot)
        H[4, 4] += w * (ey * py - dot)
        H[5, 5] += w * (ez * pz - dot)
        H[3, 4] += half * (ex * py + ey * px)
        H[3, 5] += half * (ex * pz + ez * px)
        H[4, 5] += half * (ey * pz + ez * py)
    for row in range(1, H.shape[0]):
        for column in range(row):
            H[row, column] = H[column, row]
