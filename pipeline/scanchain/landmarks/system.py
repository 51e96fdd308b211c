"""Linear systems A x = b of landmark problems: layout of the unknowns, pattern of A, its assembly.

That of a linear problem, steps between poses and landmarks' positions relative to them, is made here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from scanchain.data import Matrix
from scanchain.landmarks.problem import LandmarkData, Values

_FIRST_POSE = 100.0  # weight of the first pose over that of a step in a linear problem
_COMPONENTS = ("x", "y", "heading")


@dataclass(frozen=True, slots=True)
class Layout:
    """Columns of A: pose after pose, the robot's calibration, landmark after landmark.

    Attributes
    ----------
    poses : how many
    pose_size : unknowns of a pose, 2 (x, y) or 3 (x, y, heading)
    landmarks : (L,) their names, as numbers
    calibration : names of the unknowns that are the robot's own
    """

    poses: int
    pose_size: int
    landmarks: NDArray[np.int64]
    calibration: tuple[str, ...] = ()

    @property
    def split(self) -> int:
        """Columns of the poses; all others come after."""
        return self.poses * self.pose_size

    @property
    def landmark_start(self) -> int:
        """First column of the landmarks."""
        return self.split + len(self.calibration)

    @property
    def columns(self) -> int:
        """Unknowns in all."""
        return self.landmark_start + 2 * len(self.landmarks)

    def name(self, column: int) -> str:
        """The unknown of a column, as "pose 3 heading" or "landmark 12 x"."""
        if column < self.split:
            pose, component = divmod(column, self.pose_size)
            return f"pose {pose} {_COMPONENTS[component]}"
        if column < self.landmark_start:
            return self.calibration[column - self.split]
        landmark, component = divmod(column - self.landmark_start, 2)
        return f"landmark {self.landmarks[landmark]} {_COMPONENTS[component]}"


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """Entries of A that may be nonzero, row by row: columns of row r are columns[row_start[r] : row_start[r + 1]].

    One object is one pattern: solvers reuse their analysis of it as long as they are given the same one.
    """

    row_start: NDArray[np.int64]
    columns: NDArray[np.int64]
    layout: Layout

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns of A."""
        return len(self.row_start) - 1, self.layout.columns

    def by_column(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Start of each column's rows (n + 1,), and the rows."""
        counts = csr_matrix(
            (np.ones(len(self.columns), np.int8), self.columns, self.row_start), self.shape
        ).tocsc()
        return counts.indptr.astype(np.int64), counts.indices.astype(np.int64)


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """A x = b in the least-squares sense, every row divided by its standard deviation."""

    pattern: Pattern
    values: NDArray[np.float64]
    b: NDArray[np.float64]

    @property
    def A(self) -> csr_matrix:
        """The matrix in scipy's form."""
        return csr_matrix((self.values, self.pattern.columns, self.pattern.row_start), self.pattern.shape)


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


def linear_system(data: LandmarkData) -> LinearSystem:
    """A x = b with A = Σ^(−1/2) H, b = Σ^(−1/2) z: a prior on the first pose, odometry, observations.

    The prior puts the first pose at the origin. It can be met exactly, so that its weight, a hundredth of a step's
    noise, matters to the covariance alone.
    """
    layout = Layout(len(data.odometry) + 1, 2, np.arange(len(data.true_landmarks)))
    W_odometry, W_observation = whitening(data.odometry_covariance), whitening(data.observation_covariance)
    poses = pose_columns(layout, np.arange(layout.poses))
    seen_from, seen = data.observed.T
    groups = [
        Rows(poses[0][:, None], _FIRST_POSE * W_odometry.diagonal()[:, None]),
        difference_rows(W_odometry, poses[:-1], poses[1:]),
        difference_rows(W_observation, poses[seen_from], landmark_columns(layout, seen)),
    ]
    b = [np.zeros(2), (data.odometry @ W_odometry.T).ravel(), (data.measured @ W_observation.T).ravel()]
    values = np.concatenate([group.values.ravel() for group in groups])
    return LinearSystem(pattern_of([group.columns for group in groups], layout), values, np.concatenate(b))


def state_of(data: LandmarkData, x: np.ndarray) -> Values:
    """The unknowns as positions."""
    split = 2 * (len(data.odometry) + 1)
    return Values(x[:split].reshape(-1, 2), x[split:].reshape(-1, 2))
