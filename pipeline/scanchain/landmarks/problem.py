"""The landmark problems of a file: odometry, observations, their noise, and the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix

Kind = Literal["linear", "bearing-range"]


@dataclass(frozen=True, slots=True)
class LandmarkData:
    """A landmark problem in the plane, positions only: headings are known, everything is in the world's axes.

    Attributes
    ----------
    name : of the file
    kind : whether an observation is the landmark's position relative to the pose, or its bearing and range
    odometry : (K − 1, 2) step from each pose to the next, m
    observed : (N, 2) pose, landmark
    measured : (N, 2) relative x, y in m; or bearing in rad, range in m
    odometry_covariance : (2, 2) m²
    observation_covariance : (2, 2) of ``measured``
    true_poses, true_landmarks : (K, 2), (L, 2) m; (0, 2) and NaN where unknown
    """

    name: str
    kind: Kind
    odometry: Matrix
    observed: NDArray[np.int64]
    measured: Matrix
    odometry_covariance: Matrix
    observation_covariance: Matrix
    true_poses: Matrix
    true_landmarks: Matrix


@dataclass(frozen=True, slots=True)
class Values:
    """An estimate: poses (K, 2) x, y or (K, 3) x, y, heading, landmarks (L, 2); m, rad.

    ``calibration`` (C,) are unknowns of the robot itself, none for a file.
    """

    poses: Matrix
    landmarks: Matrix
    calibration: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def unknowns(self) -> NDArray[np.float64]:
        """All in one, poses first, landmarks last, (n,)."""
        return np.concatenate([self.poses.ravel(), self.calibration, self.landmarks.ravel()])

    def moved(self, step: NDArray[np.float64]) -> Values:
        """The values a step (n,) away, poses first, landmarks last."""
        poses, calibration, landmarks = np.split(step, np.cumsum([self.poses.size, self.calibration.size]))
        return Values(
            self.poses + poses.reshape(self.poses.shape),
            self.landmarks + landmarks.reshape(self.landmarks.shape),
            self.calibration + calibration,
        )
