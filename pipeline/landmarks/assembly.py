"""The fixed pattern of A for a landmark problem, put together from groups of like rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.landmarks.system import Layout, Pattern


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of A with equally many entries each: their columns and values, both (rows, entries)."""

    columns: NDArray[np.int64]
    values: Matrix


def whitening(covariance: Matrix) -> Matrix:
    """W with WᵀW = Σ⁻¹, upper triangular; covariance (..., k, k)."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2).astype(np.float64, copy=False)


def pattern_of(groups: list[NDArray[np.int64]], layout: Layout) -> Pattern:
    """One group of rows, (rows, entries) columns each, under the other."""
    lengths = np.concatenate([np.full(len(group), group.shape[1], np.int64) for group in groups])
    row_start = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)])
    return Pattern(row_start, np.concatenate([group.reshape(-1) for group in groups]), layout)


def pose_columns(layout: Layout, poses: NDArray[np.int64]) -> NDArray[np.int64]:
    """Columns of each pose, (N, pose size)."""
    return poses[:, None] * layout.pose_size + np.arange(layout.pose_size)


def landmark_columns(layout: Layout, landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Columns of each landmark, (N, 2)."""
    return layout.landmark_start + 2 * landmarks[:, None] + np.arange(2)


def difference_rows(W: Matrix, first: NDArray[np.int64], second: NDArray[np.int64]) -> Rows:
    """Rows W (second − first) of many pairs of points with one and the same whitening.

    first, second (N, 2) : columns of the points. Entries that are zero for all are left out.
    """
    if not np.any(W - np.diag(W.diagonal())):
        columns = np.stack([first, second], axis=-1)
        values = np.broadcast_to(np.stack([-W.diagonal(), W.diagonal()], axis=-1), columns.shape)
    else:
        columns = np.broadcast_to(np.concatenate([first, second], axis=1)[:, None], (len(first), 2, 4))
        values = np.broadcast_to(np.concatenate([-W, W], axis=1), columns.shape)
    width = columns.shape[-1]
    return Rows(np.ascontiguousarray(columns).reshape(-1, width), values.reshape(-1, width))
