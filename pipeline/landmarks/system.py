"""The whitened linear system A x = b of a landmark problem, and what its columns are called."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

_COMPONENTS = ("x", "y", "heading")


@dataclass(frozen=True, slots=True)
class Layout:
    """What the columns of A stand for: pose after pose, the robot's calibration, landmark after landmark.

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
    """Where A may be nonzero, row by row: the columns of row r are columns[row_start[r] : row_start[r + 1]].

    One object is one pattern: solvers keep what they found out about it as long as they are given the same one.
    """

    row_start: NDArray[np.int64]
    columns: NDArray[np.int64]
    layout: Layout

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of A."""
        return len(self.row_start) - 1, self.layout.columns

    def by_column(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where each column's rows begin (n + 1,), and the rows."""
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
