"""Slow, clear twins of the kernels of matching, search and loop closure; every test of one says fast == naive."""

from itertools import pairwise

import numpy as np

from scanchain import lie
from scanchain.kernels import voxels
from scanchain.kernels.registration.icp import Ending, align, problem_of


def voxel_of(point, size):
    return tuple(np.floor(np.append(point, [0.0] * (3 - len(point))) / size).astype(int))


def group(points, size):
    """Points by voxel."""
    groups = {}
    for point in points:
        groups.setdefault(voxel_of(point, size), []).append(point)
    return {key: np.array(members) for key, members in groups.items()}


def members_of(points, neighbors, alone, size, noise=0.0):
    """A voxel's own points where they are many and show some width, else those of the neighbors too."""
    if len(points) >= alone and len(points) >= (3 if points.shape[1] == 2 else 5):
        width2 = np.linalg.eigvalsh(np.cov(points.T, bias=True))[1] - noise
        if width2 >= (size / 8) ** 2:
            return points
    return np.concatenate([points, *neighbors])


def mean_of(points, members, direction, size, noise):
    """Mean of a voxel's own points, moved to the plane of all members as far as that is better known."""
    own, thickness = points.mean(axis=0), np.linalg.eigvalsh(np.cov(members.T, bias=True))[0]
    variance = noise / len(points) + noise * (2.5**2 * noise / size**2) ** 2
    share = variance / (variance + max(thickness - noise, 0.0))
    return own + share * direction * (direction @ (members.mean(axis=0) - own))


def shape(members, noise=0.0):
    """Shape name and direction of points that are so noisy, m²."""
    d = members.shape[1]
    if len(members) < (3 if d == 2 else 5):
        return "point", None
    values, vectors = np.linalg.eigh(np.cov(members.T, bias=True))
    values -= noise
    if d == 2:
        return ("plane", vectors[:, 0]) if values[0] < 0.1 * values[1] else ("point", None)
    if values[0] < 0.1 * values[1]:
        return "plane", vectors[:, 0]
    if values[1] < 0.1 * values[2]:
        return "line", vectors[:, 2]
    return "point", None


def weight_of(p, T, mean, kind, direction, members, size, variance):
    """Sensor variance over the variance of the residual of a point p of the map's frame, the lidar at T."""
    d = len(p)
    if kind == "plane" and d == 2:
        return 1.0
    off_shapes = variance / (variance + size**2 / 4)
    if kind == "point" or d == 2:
        return off_shapes
    values, vectors = np.linalg.eigh(np.cov(members.T, bias=True))
    ray = p - T[:3, 3]
    ray /= np.linalg.norm(ray)
    if kind == "line":
        up = T[:3, 2] - ray * (ray @ T[:3, 2])
        cosine2 = (direction @ up) ** 2 / (up @ up)
        return max(cosine2 / (cosine2 + 0.25) * variance / max(variance, values[1]), off_shapes)
    e, n = p - mean, min(len(members), 30)
    uncertainty = 1 / n + (vectors[:, 1] @ e) ** 2 / (n * values[1]) + (vectors[:, 2] @ e) ** 2 / (n * values[2])
    sine2 = (direction @ ray) ** 2
    clarity = sine2 / (sine2 + 0.05**2 + 4 * values[0] / values[1]) * values[1] / (values[1] + 9 * variance)
    return clarity * variance / (max(values[0], variance) * (1 + uncertainty))


def nearest_mean(point, means, size, reach, max_distance):
    """Key of the nearest voxel mean among the (2·reach)ᵈ voxels around a point, None if none is near."""
    d = len(point)
    base = np.floor(point / size - 0.5).astype(int) - reach + 1
    best, chosen = max_distance, None
    for key, mean in means.items():
        offset = np.array(key[:d]) - base
        if (offset >= 0).all() and (offset < 2 * reach).all() and np.linalg.norm(mean - point) < best:
            best, chosen = np.linalg.norm(mean - point), key
    return chosen


def residual(p, mean, kind, direction, weight):
    """Residual vector whose squared length the cost counts."""
    e = p - mean
    if kind == "plane":
        e = np.array([direction @ e])
    if kind == "line":
        e = e - direction * (direction @ e)
    return np.sqrt(weight) * e


def cost(points, pairs, T, scale, weight):
    """Σ ½ s²r²/(s²+r²) over pairs (index, mean, kind, direction)."""
    total = 0.0
    moved = lie.transform(T, points)
    for i, mean, kind, direction in pairs:
        r2 = float((residual(moved[i], mean, kind, direction, weight[i]) ** 2).sum())
        total += 0.5 * scale**2 * r2 / (scale**2 + r2)
    return total


def gauss_newton_hessian(points, pairs, T, origin, scale, weight):
    """Σ w JᵀJ with J by central differences of the residual under a left twist about the origin."""
    k = 3 if points.shape[1] == 2 else 6
    shift = lie.identity(points.shape[1])
    shift[:-1, -1] = origin
    H = np.zeros((k, k))
    h = 1e-6
    steps = [shift @ lie.exp(h * unit) @ lie.inverse(shift) @ T for unit in np.vstack([np.eye(k), -np.eye(k)])]
    moved = [lie.transform(step, points) for step in steps]
    here = lie.transform(T, points)
    for i, mean, kind, direction in pairs:
        args = (mean, kind, direction, weight[i])
        J = np.stack(
            [(residual(moved[a][i], *args) - residual(moved[a + k][i], *args)) / (2 * h) for a in range(k)], axis=1
        )
        r2 = float((residual(here[i], *args) ** 2).sum())
        H += (scale**2 / (scale**2 + r2)) ** 2 * J.T @ J
    return H


def first_per_voxel(points, size, low, high):
    seen, chosen = set(), []
    for i, point in enumerate(points):
        if low <= np.linalg.norm(point) <= high and voxel_of(point, size) not in seen:
            seen.add(voxel_of(point, size))
            chosen.append(i)
    return chosen


def deskew(points, shares, twist):
    return np.array([lie.transform(lie.exp(s * twist), p[None])[0] for p, s in zip(points, shares, strict=True)])


def flat_cells(world, number, cell_m):
    """Points of every flat cell that three scans see, in the order of their first points, and its normal."""
    found, cells = [], {}
    for index, point in enumerate(world):
        cells.setdefault(voxel_of(point, cell_m), []).append(index)
    for members in map(np.array, cells.values()):
        if len(members) < 8 or len(set(number[members])) < 3:
            continue
        values, vectors = np.linalg.eigh(np.cov(world[members].T, bias=True))
        if values[0] < min(0.02 * values[1], (0.15 * cell_m) ** 2) and values[1] > (0.1 * cell_m) ** 2:
            found.append((members, vectors[:, 0]))
    return found


def plane_equations(points, number, plane, beside, residual, normals, poses, scale):
    """Normal equations of poses and an elevation offset, those of the planes eliminated; by finite differences."""
    size, step = 6 * len(poses) + 1, 1e-6
    H, b = np.zeros((size, size)), np.zeros(size)
    for p, normal in enumerate(normals):
        rows = []
        members = np.flatnonzero(plane == p)
        for i in members:
            J = np.zeros(size + 3)
            level = np.hypot(points[i, 0], points[i, 1])
            upward = np.array([-points[i, 2] * points[i, 0] / level, -points[i, 2] * points[i, 1] / level, level])
            for column in range(6):
                moved = [poses[number[i]] @ lie.exp(sign * step * np.eye(6)[column]) for sign in (1.0, -1.0)]
                there = [T[:3, :3] @ points[i] + T[:3, 3] for T in moved]
                J[6 * number[i] + column] = normal @ (there[0] - there[1]) / (2.0 * step)
            J[size - 1] = normal @ poses[number[i]][:3, :3] @ upward
            J[size:] = [1.0, *np.delete(beside[i] - residual[i] * normal, np.argmax(np.abs(normal)))]
            rows.append(J)
        J, w = np.array(rows), (1.0 + (residual[members] / scale) ** 2) ** -2
        whole, gradient = J.T @ (w[:, None] * J), J.T @ (w * residual[members])
        eliminated = whole[:size, size:] @ np.linalg.inv(whole[size:, size:])
        H += whole[:size, :size] - eliminated @ whole[size:, :size]
        b += gradient[:size] - eliminated @ gradient[size:]
    return H, b


def spectrum(H, weights, range_m):
    k = len(H)
    scale = np.append(np.ones(k // 2 + k % 2), np.full(k // 2, 1.0 / range_m))
    values, vectors = np.linalg.eigh(np.diag(scale) @ H @ np.diag(scale) / weights)
    return scale, values, vectors


def weak_prior(H, weights, range_m, expected, signals, limits, is_fused):
    """limits : the least information and the least signal"""
    scale, values, vectors = spectrum(H, weights, range_m)
    total = np.zeros(H.shape)
    for value, signal, vector in zip(values, signals, vectors.T, strict=True):
        times = min(value / limits[0], signal / limits[1])
        if times < (1.0 if is_fused else 10.0):
            twist = vector * scale
            is_frozen = (value < limits[0] or signal <= 1.0) if is_fused else times < 1.0
            strength = 1e3 * weights if is_frozen else twist @ expected @ twist / (1.0 - 1.0 / signal)
            total += min(strength, 1e3 * weights) * np.outer(vector / scale, vector / scale)
    return total


def seen_from_source(T, T_first, H, worst, variance):
    """Information and worst direction of twists in the source's frame."""
    centered = T.copy()
    centered[:-1, -1] -= T_first[:-1, -1]
    turned = centered.copy()
    turned[:-1, -1] = 0.0
    return lie.adjoint(centered).T @ H @ lie.adjoint(centered) / variance, lie.adjoint(turned).T @ worst


def signal_along(voxel_map, problem, T, twist):
    """Signal-to-noise ratio along a twist, without the dominant surface and young ones."""
    of_map = voxel_map.voxels
    youngest = voxel_map.insertions - min(2, voxel_map.insertions - 1)
    informative, cells, noise = [], [], 0.0
    for point, j, weight in zip(problem.points, problem.correspondence, problem.weight, strict=True):
        if j < 0 or weight == 0.0:
            continue
        cell = of_map.cells[j]
        n, u = (
            cell[voxels.Cell.DIRECTION : voxels.Cell.DIRECTION + 3],
            cell[voxels.Cell.ACROSS : voxels.Cell.ACROSS + 3],
        )
        v, is_plane = np.cross(n, u), cell[voxels.Cell.SHAPE] == voxels.PLANE
        p = lie.transform(T, point[None])[0] - problem.origin
        d = twist[:3] + np.cross(twist[3:], p)
        if is_plane:
            m = 1.0 / cell[voxels.Cell.MEAN_TERM]
            spread = cell[voxels.Cell.SLOPE_ACROSS] * np.outer(u, u) + cell[voxels.Cell.SLOPE_ALONG] * np.outer(
                v, v
            )
            noise += weight * cell[voxels.Cell.THICKNESS] * m / max(m - 3.0, 1.0) * d @ spread @ d
        if of_map.history[j, voxels.History.BORN] <= youngest:
            informative.append(weight * ((n @ d) ** 2 if is_plane else d @ d - (n @ d) ** 2))
            cells.append(voxels.unpack(of_map.keys[j]))
    dominant = np.array(cells[int(np.argmax(informative))])
    is_away = np.abs(np.array(cells) - dominant).max(axis=1) > 1
    return np.array(informative)[is_away].sum() / noise


def hits(means, origin, resolution_m, shape):
    """2 in cells with a surface point, 1 in those around them."""
    grid = np.zeros(shape, int)
    cells = [tuple(np.floor((mean[1::-1] - origin[::-1]) / resolution_m).astype(int)) for mean in means]
    for row, column in cells:
        grid[row - 1 : row + 2, column - 1 : column + 2] = 1
    for cell in cells:
        grid[cell] = 2
    return grid


def windows(grid, size):
    """The largest value among the size × size cells that start at each cell."""
    padded = np.pad(grid, ((0, size - 1), (0, size - 1)))
    return np.max(
        [padded[r : r + grid.shape[0], c : c + grid.shape[1]] for r in range(size) for c in range(size)], axis=0
    )


def scores(grid, origin, resolution_m, points, T, shifts, turns, turn_rad):
    """Share of the highest score of every pose of the window, by (turn, shift along x, along y)."""
    result = {}
    for turn in range(-turns, turns + 1):
        rotated = lie.transform(lie.pose_2d(T[0, 2], T[1, 2], float(lie.yaw(T)) + turn * turn_rad), points)
        cells = np.floor((rotated - origin) / resolution_m).astype(int)
        for dx in range(-shifts, shifts + 1):
            for dy in range(-shifts, shifts + 1):
                column, row = cells[:, 0] + dx, cells[:, 1] + dy
                inside = (row >= 0) & (row < grid.shape[0]) & (column >= 0) & (column < grid.shape[1])
                result[turn, dx, dy] = grid[row[inside], column[inside]].sum() / (2 * len(points))
    return result


def bin_of(point, shape):
    range_m = np.linalg.norm(point)
    row = int((np.arcsin(point[2] / range_m) / np.pi + 0.5) * shape[0])
    column = int((np.arctan2(point[1], point[0]) / (2 * np.pi) + 0.5) * shape[1])
    return (min(row, shape[0] - 1), min(column, shape[1] - 1)), range_m


def agreement(seen, points, T, shape, margin_m, margin_share):
    """Points that lie where the lidar saw something, and points that it looked through."""
    nearest = {}
    for point in seen:
        place, range_m = bin_of(point, shape)
        nearest[place] = min(nearest.get(place, np.inf), range_m)
    yes = no = 0
    for point in lie.transform(T, points):
        place, range_m = bin_of(point, shape)
        if place in nearest:
            margin = margin_m + margin_share * nearest[place]
            yes += abs(range_m - nearest[place]) <= margin
            no += range_m < nearest[place] - margin
    return yes, no


def refine(voxels, points, starts, poses, prior, least_share, settings):
    """Each scan aligned by itself."""
    for k, (first, last) in enumerate(pairwise(starts)):
        T = poses[k].copy()
        scan = points[first:last]
        problem = problem_of(voxels, scan, T, prior, settings)
        fit = align(problem, T, np.zeros(len(prior)), settings.first_scale_m)
        if fit.ending == Ending.CONVERGED and fit.pairs >= least_share * (last - first):
            poses[k] = T
