"""Normal equations of the distances between points and the shapes of their corresponding voxels."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.voxels import LINE, PLANE, POINT, Voxels, move, shape_of

WITHOUT_KERNEL_M = 1e100  # scale at which every robust weight is one
_SCATTER = 0x9E3779B1  # odd, near 2³² over the golden ratio: hashes consecutive rows far apart (Knuth)


class Settings(NamedTuple):
    """Settings of a registration.

    reach, max_distance_m : of the search for correspondences while the pose moves
    last_reach, last_distance_m : of the correspondences that the result is judged by
    first_scale_m, widest_scale_m, scale_m : of the robust kernel: initial one for a certain prediction, largest
        one for an uncertain one, final one
    variance : of a range, σ² in m²
    min_information, min_signal : eigenvalue of the information per weight, and its signal-to-noise ratio, below
        which a direction is degenerate
    insertions : into the map so far
    tolerance_m, tolerance_rad : largest step of a converged pose
    """

    optimizer: int
    max_iterations: int
    reach: int
    max_distance_m: float
    last_reach: int
    last_distance_m: float
    first_scale_m: float
    widest_scale_m: float
    scale_m: float
    variance: float
    min_information: float
    min_signal: float
    insertions: int
    tolerance_m: float
    tolerance_rad: float


class Problem(NamedTuple):
    """Points (N, d) to be aligned to a map.

    origin : (3,), map frame, that twists rotate about
    prior : (k, k) information of the predicted pose times the variance of a residual, along the map's axes
    correspondence, weight : (N,) of the last association
    range_m : root mean square of the points' ranges
    """

    voxels: Voxels
    points: NDArray[np.float64]
    origin: NDArray[np.float64]
    prior: NDArray[np.float64]
    correspondence: NDArray[np.int32]
    weight: NDArray[np.float64]
    range_m: float
    settings: Settings


@njit(nogil=True)
def normal_equations(problem, T, scale_m: float, curvature: float, H, b):
    """Normal equations of all residuals at T, written to H (k, k) and b (k,).

    With p a point moved by T, q the mean of its voxel and n the normal there, a left twist ξ = (ρ, φ) about the
    problem's origin (all lengths relative to it, so that rotation and translation decouple), T ← exp(ξ) T,
    changes the residual by
        r = nᵀ(p − q)        ∂r/∂ξ = [nᵀ, (p × n)ᵀ]     (Chen & Medioni 1992; in 2D Censi 2008)
    For a line the residuals are the two across it, for a point shape all components of p − q. Geman–McClure
    weighs each by w = (s² / (s² + r²))², r² the squared length of the residual (Geman & McClure 1985) times
    the weight of the correspondence.

    scale_m : s; residuals far above it are practically ignored
    curvature : 1 adds the curvature of the motion, r nᵀ ∂²p/∂ξ², which makes H Newton's Hessian (the weights
        held fixed); 0 leaves it out
    H = Σ w JᵀJ, b = Σ w Jᵀr. Returns the cost Σ ½ s²r²/(s²+r²) in m², Σ w, and Σ w r² in m².
    """
    if H.shape[0] == 6:
        sums, upper, gradient = _sum_up(*_arrays(problem, T), scale_m, (0.0,) * 21, (0.0,) * 6)
        _unfold(upper, gradient, H, b)
    else:
        sums, upper, gradient = _sum_up(*_arrays(problem, T), scale_m, (0.0,) * 6, (0.0,) * 3)
        _unfold(upper, gradient, H, b)
    if curvature > 0.0:
        _add_curvature(*_arrays(problem, T), scale_m, curvature, H)
    return sums


@njit(nogil=True)
def robust_sums(problem, T, scale_m: float):
    """The cost Σ ½ s²r²/(s²+r²) in m², Σ w, and Σ w r² in m², as ``normal_equations`` returns them."""
    return _sum_up(*_arrays(problem, T), scale_m, (), ())[0]


@njit(nogil=True)
def gradients_by_group(problem, T, scale_m: float, group, gradients):
    """Add b of ``normal_equations`` to the gradients (G, k), each point's to that of its group (N,)."""
    if gradients.shape[1] == 6:
        _sum_by_group(*_arrays(problem, T), scale_m, (0.0,) * 21, (0.0,) * 6, group, gradients)
    else:
        _sum_by_group(*_arrays(problem, T), scale_m, (0.0,) * 6, (0.0,) * 3, group, gradients)


@njit(inline="always")
def gradient_spread(problem, T, scale_m: float):
    """Covariance (6, 6) of b in ``normal_equations``, from its contributions per voxel: Σ b_v b_vᵀ.

    Points with a correspondence in one voxel share the error of its plane, so that only their sums b_v are
    independent (cluster-robust covariance; Liang & Zeger 1986). Smooth floors then count more than rough walls.
    """
    size = 64
    while size < 2 * problem.points.shape[0]:
        size *= 2
    slots, sums = np.full(size, -1, np.int32), np.zeros((size, 6))
    group, spread = np.empty(problem.points.shape[0], np.int32), np.zeros((6, 6))
    for i in range(group.shape[0]):
        voxel = problem.correspondence[i]
        if voxel < 0 or problem.weight[i] == 0.0:
            continue
        slot = (voxel * _SCATTER) & (size - 1)
        while slots[slot] >= 0 and slots[slot] != voxel:
            slot = (slot + 1) & (size - 1)
        slots[slot] = voxel
        group[i] = slot
    gradients_by_group(problem, T, scale_m, group, sums)
    for slot in range(size):
        for m in range(6 if slots[slot] >= 0 else 0):
            for n in range(6):
                spread[m, n] += sums[slot, m] * sums[slot, n]
    return spread


@njit(inline="always")
def _arrays(problem, T):
    """Arguments of loops over the points: arrays in a tuple would cost reference counting at every point."""
    return problem.voxels.cells, problem.points, T, problem.origin, problem.correspondence, problem.weight


@njit(nogil=True)
def _sum_up(cells, points, T, origin, correspondence, weight, scale_m: float, upper, gradient):
    """Cost, Σ w and Σ w r², then the sums over all residuals: the upper triangle of H, by rows, and b.

    upper, gradient : zeros, 21 and 6 in space, 6 and 3 in the plane, empty to skip both. Tuples are kept in
    registers; in arrays, every addition would wait for the previous store.
    """
    cost = total_weight = squares = 0.0
    s2 = scale_m * scale_m
    for i in range(points.shape[0]):
        if correspondence[i] < 0:
            continue
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(cells, correspondence[i])
        residual, along, r2 = _residual(shape, q, normal, x, y, z)
        moved = x - origin[0], y - origin[1], z - origin[2]
        r2 *= weight[i]
        ratio = s2 / (s2 + r2)
        w = weight[i] * ratio * ratio
        cost += 0.5 * r2 * ratio
        total_weight += w
        squares += ratio * ratio * r2
        upper, gradient = _plus(upper, gradient, w, shape, normal, moved, residual, along)
    return (cost, total_weight, squares), upper, gradient


@njit(nogil=True)
def _sum_by_group(
    cells, points, T, origin, correspondence, weight, scale_m: float, no_upper, none, group, gradients
):
    s2 = scale_m * scale_m
    for i in range(points.shape[0]):
        if correspondence[i] < 0 or weight[i] == 0.0:
            continue
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(cells, correspondence[i])
        residual, along, r2 = _residual(shape, q, normal, x, y, z)
        moved = x - origin[0], y - origin[1], z - origin[2]
        ratio = s2 / (s2 + r2 * weight[i])
        w = weight[i] * ratio * ratio
        _, b = _plus(no_upper, none, w, shape, normal, moved, residual, along)
        for m in range(gradients.shape[1]):
            gradients[group[i], m] += b[m]


@njit(nogil=True)
def _add_curvature(cells, points, T, origin, correspondence, weight, scale_m: float, curvature: float, H):
    """Add the second derivatives of eᵀ exp(ξ) p at ξ = 0 to H (k, k), e the residual of each correspondence.

    exp(ξ) p = p + φ × p + ρ + ½ φ × (φ × p) + ½ φ × ρ + …, so that the blocks are
        ½(e pᵀ + p eᵀ) − (eᵀp) I for (φ, φ), in 2D −eᵀp, and ½ φᵀ(ρ × e) for (ρ, φ).
    """
    s2 = scale_m * scale_m
    for i in range(points.shape[0]):
        if correspondence[i] < 0:
            continue
        x, y, z = move(T, points, i)
        shape, q, normal = shape_of(cells, correspondence[i])
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


@njit(forceinline=True)
def _plus(h, b, w, shape, normal, moved, residual, along):
    """Upper triangle h, by rows, and gradient b plus one correspondence of weight w; unchanged if empty."""
    if len(b) == 6:
        return _plus_in_space(h, b, w, shape, normal, moved, residual, along)
    elif len(b) == 3:
        return _plus_in_plane(h, b, w, shape, normal, moved, residual, along)
    else:
        return h, b


@njit(forceinline=True)
def _plus_in_space(h, b, w, shape, normal, moved, residual, along):
    """Upper triangle h (21), by rows, and gradient b (6) plus one correspondence of weight w, by its shape."""
    if shape != PLANE:
        h, b = _plus_point(h, b, w, moved, residual)
        w, along = -w, 0.0
    if shape != POINT:
        h, b = _plus_plane(h, b, w, moved, normal, along)
    return h, b


@njit(forceinline=True)
def _plus_plane(h, b, w, moved, normal, r):
    """Upper triangle h (21), by rows, and gradient b (6) plus one residual: J = [n, p × n]."""
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
    """Upper triangle h (21), by rows, and gradient b (6) plus three residuals: J = [I, −p×]."""
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


@njit(forceinline=True)
def _plus_in_plane(h, b, w, shape, normal, moved, residual, r):
    """Upper triangle h (6), by rows, and gradient b (3) plus one correspondence of weight w.

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
def _unfold(upper, gradient, H, b):
    """Write an upper triangle, by rows, to the symmetric H, and the gradient to b."""
    k = 0
    for row in range(H.shape[0]):
        b[row] = gradient[row]
        for column in range(row, H.shape[0]):
            H[row, column] = H[column, row] = upper[k]
            k += 1
