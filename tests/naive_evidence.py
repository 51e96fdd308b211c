"""Slow, clear twins of the kernels that say what an alignment is worth."""

import numpy as np

from pipeline import lie


def spectrum(H, weights, range_m):
    k = len(H)
    scale = np.append(np.ones(k // 2 + k % 2), np.full(k // 2, 1.0 / range_m))
    values, vectors = np.linalg.eigh(np.diag(scale) @ H @ np.diag(scale) / weights)
    return scale, values, vectors


def hold(H, weights, range_m, expected, min_information):
    scale, values, vectors = spectrum(H, weights, range_m)
    total = np.zeros(H.shape)
    for value, vector in zip(values, vectors.T, strict=True):
        if value < 10.0 * min_information:
            twist = vector * scale
            strength = twist @ expected @ twist if value >= min_information else 1e3 * weights
            total += strength * np.outer(vector / scale, vector / scale)
    return total


def seen_from_source(T, T_first, H, worst, variance):
    """Information and worst direction of twists in the source's frame."""
    centred = T.copy()
    centred[:-1, -1] -= T_first[:-1, -1]
    turned = centred.copy()
    turned[:-1, -1] = 0.0
    return lie.adjoint(centred).T @ H @ lie.adjoint(centred) / variance, lie.adjoint(turned).T @ worst
