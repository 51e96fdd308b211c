"""Slow, clear twins of the observability kernels."""

import numpy as np

from scanchain import lie
from scanchain.kernels.voxels import (
    ACROSS,
    BORN,
    DIRECTION,
    MEAN_TERM,
    PLANE,
    SHAPE,
    SLOPE_ACROSS,
    SLOPE_ALONG,
    THICKNESS,
    unpack,
)


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
    voxels = voxel_map.voxels
    youngest = voxel_map.insertions - min(2, voxel_map.insertions - 1)
    informative, cells, noise = [], [], 0.0
    for point, j, weight in zip(problem.points, problem.correspondence, problem.weight, strict=True):
        if j < 0 or weight == 0.0:
            continue
        cell = voxels.cells[j]
        n, u, is_plane = cell[DIRECTION : DIRECTION + 3], cell[ACROSS : ACROSS + 3], cell[SHAPE] == PLANE
        p = lie.transform(T, point[None])[0] - problem.origin
        d = twist[:3] + np.cross(twist[3:], p)
        if is_plane:
            m = 1.0 / cell[MEAN_TERM]
            spread = cell[SLOPE_ACROSS] * np.outer(u, u) + cell[SLOPE_ALONG] * np.outer(
                np.cross(n, u), np.cross(n, u)
            )
            noise += weight * cell[THICKNESS] * m / max(m - 3.0, 1.0) * d @ spread @ d
        if voxels.history[j, BORN] <= youngest:
            informative.append(weight * ((n @ d) ** 2 if is_plane else d @ d - (n @ d) ** 2))
            cells.append(unpack(voxels.keys[j]))
    dominant = np.array(cells[int(np.argmax(informative))])
    is_away = np.abs(np.array(cells) - dominant).max(axis=1) > 1
    return np.array(informative)[is_away].sum() / noise
