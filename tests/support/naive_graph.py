"""Slow and clear twins of the graph kernels, by the definitions."""

import numpy as np
from scipy.linalg import expm, logm

from scanchain import lie


def error(T_i, T_j, Z):
    """log(Z⁻¹ T_i⁻¹ T_j) by the matrix logarithm, as a twist (translation, rotation)."""
    generator = np.real(logm(np.linalg.inv(Z) @ np.linalg.inv(T_i) @ T_j))
    if len(generator) == 3:
        return np.array([generator[0, 2], generator[1, 2], generator[1, 0]])
    return np.array([*generator[:3, 3], generator[2, 1], generator[0, 2], generator[1, 0]])


def generator(twist):
    """The matrix of a twist."""
    d = 2 if len(twist) == 3 else 3
    result = np.zeros((d + 1, d + 1))
    result[:d, d] = twist[:d]
    result[:d, :d] = [[0.0, -twist[2]], [twist[2], 0.0]] if d == 2 else lie.hat(twist[3:])
    return result


def exponential(twist):
    """The pose of a twist by the matrix exponential."""
    return expm(generator(twist))


def normal_equations(poses, edges, measurements, information, weights, fixed):
    """Dense H and g over the free poses, from finite differences of ``lie.log``."""
    k = information.shape[-1]
    J = np.zeros((len(edges), k, len(poses), k))
    e = np.array([residual(poses[i], poses[j], Z) for (i, j), Z in zip(edges, measurements, strict=True)])
    step = 1e-6
    for f, (i, j) in enumerate(edges):
        for end in (i, j):
            for a in range(k):
                J[f, :, end, a] = (moved(poses, i, j, end, a, step, measurements[f])
                                   - moved(poses, i, j, end, a, -step, measurements[f])) / (2 * step)  # fmt: skip
    J = J[:, :, ~fixed].reshape(len(edges), k, -1)
    H = np.einsum("f,fka,fkl,flb->ab", weights, J, information, J)
    return H, np.einsum("f,fka,fkl,fl->a", weights, J, information, e)


def residual(T_i, T_j, Z):
    return lie.log(lie.inverse(Z) @ lie.inverse(T_i) @ T_j)


def moved(poses, i, j, end, a, step, Z):
    """The residual after one pose has made a small left twist along axis a."""
    twist = np.zeros(3 if len(Z) == 3 else 6)
    twist[a] = step
    T = lie.exp(twist)
    return residual(T @ poses[i] if end == i else poses[i], T @ poses[j] if end == j else poses[j], Z)


def dense(pattern, values):
    """The symmetric matrix of a block pattern's values."""
    A = np.zeros((pattern.scalars, pattern.scalars))
    at = 0
    for row, column in zip(pattern.rows, pattern.columns, strict=True):
        height, width = pattern.sizes[row], pattern.sizes[column]
        block = values[at : at + height * width].reshape(height, width)
        rows = slice(pattern.starts[row], pattern.starts[row] + height)
        columns = slice(pattern.starts[column], pattern.starts[column] + width)
        A[rows, columns] = block
        A[columns, rows] = block.T
        at += height * width
    return A
