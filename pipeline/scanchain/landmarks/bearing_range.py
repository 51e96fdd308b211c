"""The landmark problem of bearings and ranges, with or without unknown headings."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.kernels.landmarks import factors
from scanchain.landmarks.problem import LandmarkData, Values
from scanchain.landmarks.system import Layout, LinearSystem, landmark_columns, pattern_of, pose_columns, whitening

_ANCHOR = 0.01  # noise of the first pose as a share of a step's


@dataclass(frozen=True, slots=True)
class Linearization:
    """Whitened residuals r at a state and the values of A = ∂r/∂x there.

    Attributes
    ----------
    prior, calibration, odometry, observations : residuals (p,), (C,), (K − 1, p), (N, 2); pure numbers
    prior_rows, odometry_rows, observation_rows : of A: (p, p), (K − 1, p, 2 p + C), (N, 2, p + 2)
    """

    prior: NDArray[np.float64]
    calibration: NDArray[np.float64]
    odometry: Matrix
    observations: Matrix
    prior_rows: Matrix
    odometry_rows: Matrix
    observation_rows: Matrix

    @property
    def observation_chi2(self) -> NDArray[np.float64]:
        """χ² of every observation, (N,)."""
        return np.square(self.observations).sum(axis=1)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Unknowns common to all motions of the robot.

    Attributes
    ----------
    names : (C,) what they are called
    value : (C,) at which the motions were worked out; slope (K − 1, p, C) by how much they change with them
    mean, sigma : (C,) prior
    """

    names: tuple[str, ...]
    value: NDArray[np.float64]
    slope: Matrix
    mean: NDArray[np.float64]
    sigma: NDArray[np.float64]


def no_calibration(motion: Matrix) -> Calibration:
    """Calibration without parameters, of motions (K − 1, p)."""
    return Calibration((), np.zeros(0), np.zeros((*motion.shape, 0)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, slots=True)
class Measurements:
    """Measurements of a bearing-range problem.

    Attributes
    ----------
    first_pose, first_covariance : (p,), (p, p) prior of the first pose; p is 2 without headings, 3 with them
    motion, motion_covariance : (K − 1, p), (K − 1, p, p) from each pose to the next: with headings in the frame
        of the former, without in the world's
    calibration : errors common to all motions
    observed : (N, 2) pose, landmark
    measured, measured_covariance : (N, 2), (2, 2) bearing in rad, range in m; of every one alike
    landmarks : (L,) their names, as numbers
    """

    first_pose: NDArray[np.float64]
    first_covariance: Matrix
    motion: Matrix
    motion_covariance: Matrix
    calibration: Calibration
    observed: NDArray[np.int64]
    measured: Matrix
    measured_covariance: Matrix
    landmarks: NDArray[np.int64]

    def motion_at(self, calibration: NDArray[np.float64]) -> Matrix:
        """The motions with another calibration, to first order."""
        return self.motion + self.calibration.slope @ (calibration - self.calibration.value)


class BearingRangeProblem:
    """Prior on the first pose, motion from pose to pose, bearings and ranges; its pattern is found once.

    ``motion_columns`` (K − 1, 2 p + C) and ``observation_columns`` (N, p + 2) are the unknowns of each of them,
    ``motion_whitening`` (K − 1, p, p) is W with WᵀW = Σ⁻¹.
    """

    def __init__(self, measurements: Measurements) -> None:
        given = measurements
        self.measurements = given
        size = given.motion.shape[1]
        layout = Layout(len(given.motion) + 1, size, given.landmarks, given.calibration.names)
        self._first = whitening(given.first_covariance)
        self._whiten()
        poses = pose_columns(layout, np.arange(layout.poses))
        own = np.arange(layout.split, layout.landmark_start)
        seen_from, seen = given.observed.T
        pairs = np.concatenate([poses[seen_from], landmark_columns(layout, seen)], axis=1)
        moves = np.concatenate([poses[:-1], poses[1:], np.tile(own, (len(given.motion), 1))], axis=1)
        groups = [
            np.repeat(poses[:1], size, axis=0), own[:, None], np.repeat(moves, size, axis=0),
            np.repeat(pairs, 2, axis=0),
        ]  # fmt: skip
        damping = np.arange(layout.columns)[:, None]
        self.motion_columns, self.observation_columns = moves, pairs
        self.pattern, self._damped = pattern_of(groups, layout), pattern_of([*groups, damping], layout)

    def of(self, measurements: Measurements) -> BearingRangeProblem:
        """The same pattern with other numbers."""
        result = copy(self)
        result.measurements = measurements
        result._whiten()
        return result

    def _whiten(self) -> None:
        given = self.measurements
        self.motion_whitening = whitening(given.motion_covariance)
        self._slope = -self.motion_whitening @ given.calibration.slope
        self._observation = whitening(given.measured_covariance)

    def linearize(self, state: Values) -> Linearization:
        """Residuals and Jacobians at a state."""
        given, p = self.measurements, state.poses.shape[1]
        calibration = given.calibration
        motion, J_motion = np.empty(given.motion.shape), np.empty((len(given.motion), p, 2 * p))
        if p == 3:
            factors.odometry(state.poses, given.motion, self.motion_whitening, motion, J_motion)
        else:
            W = self.motion_whitening
            motion = (W @ (np.diff(state.poses, axis=0) - given.motion)[..., None])[..., 0]
            J_motion = np.concatenate([-W, W], axis=-1)
        motion += self._slope @ (state.calibration - calibration.value)
        J_motion = np.concatenate([J_motion, self._slope], axis=-1)
        seen = np.empty(given.measured.shape)
        J_seen = np.empty((len(seen), 2, p + 2))
        factors.bearing_range(
            state.poses, state.landmarks, given.observed, given.measured, self._observation, seen, J_seen
        )
        off = state.poses[0] - given.first_pose
        off[2:] = (off[2:] + np.pi) % (2.0 * np.pi) - np.pi
        own = (state.calibration - calibration.mean) / calibration.sigma
        return Linearization(self._first @ off, own, motion, seen, self._first, J_motion, J_seen)

    def system(self, at: Linearization, weights: NDArray[np.float64]) -> LinearSystem:
        """The step's system A x = −r, observations weighed by √w (N,)."""
        root = np.sqrt(weights)[:, None]
        seen = at.observation_rows * root[..., None]
        own = 1.0 / self.measurements.calibration.sigma
        values = np.concatenate([at.prior_rows.ravel(), own, at.odometry_rows.ravel(), seen.ravel()])
        b = -np.concatenate([at.prior, at.calibration, at.odometry.ravel(), (at.observations * root).ravel()])
        return LinearSystem(self.pattern, values, b)

    def damped(self, system: LinearSystem, damping: NDArray[np.float64]) -> LinearSystem:
        """The system with a row √d of its own for every unknown, so that AᵀA grows by diag(d); d (n,)."""
        values, b = np.concatenate([system.values, np.sqrt(damping)]), np.append(system.b, np.zeros(len(damping)))
        return LinearSystem(self._damped, values, b)


def world_referenced(data: LandmarkData) -> Measurements:
    """The problem of an npz file: headings are known, so that bearings are those of the world's axes."""
    return Measurements(
        first_pose=np.zeros(2),
        first_covariance=_ANCHOR**2 * data.odometry_covariance,
        motion=data.odometry,
        motion_covariance=np.broadcast_to(data.odometry_covariance, (len(data.odometry), 2, 2)),
        calibration=no_calibration(data.odometry),
        observed=data.observed,
        measured=data.measured,
        measured_covariance=data.observation_covariance,
        landmarks=np.arange(len(data.true_landmarks)),
    )
