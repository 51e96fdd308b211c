"""Landmark problems in the plane: unknowns, measurements, pattern of A, linearization."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, triu

from scanchain.data import Matrix
from scanchain.graph.cholesky import BlockPattern
from scanchain.kernels.landmarks import factors

Kind = Literal["linear", "bearing-range"]


@dataclass(frozen=True, slots=True)
class LandmarkData:
    """A landmark problem in the plane, positions only: headings are known, everything is in the world's axes.

    kind : whether an observation is the landmark's position relative to the pose, or its bearing and range
    measurements : ``measured`` is relative x, y in m in a linear problem
    true_poses, true_landmarks : (K, 2), (L, 2) m, NaN where unknown
    """

    name: str
    kind: Kind
    measurements: Measurements
    true_poses: Matrix
    true_landmarks: Matrix


@dataclass(frozen=True, slots=True)
class Values:
    """An estimate: poses (K, 2) x, y or (K, 3) x, y, heading, landmarks (L, 2); m, rad.

    ``calibration`` (C,) are calibration unknowns of the robot, none for a file.
    """

    poses: Matrix
    landmarks: Matrix
    calibration: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def unknowns(self) -> NDArray[np.float64]:
        """All unknowns in one vector (n,): poses, calibration, landmarks."""
        return np.concatenate([self.poses.ravel(), self.calibration, self.landmarks.ravel()])

    def moved(self, step: NDArray[np.float64]) -> Values:
        """The values after a step (n,), in the order of ``unknowns``."""
        poses, calibration, landmarks = np.split(step, np.cumsum([self.poses.size, self.calibration.size]))
        return Values(
            self.poses + poses.reshape(self.poses.shape),
            self.landmarks + landmarks.reshape(self.landmarks.shape),
            self.calibration + calibration,
        )


FIRST_SHARE = 0.01  # standard deviation of the first pose as a share of a step's
_COMPONENTS = ("x", "y", "heading")


@dataclass(frozen=True, slots=True)
class Layout:
    """Columns of A: pose after pose, the robots' calibration, landmark after landmark.

    pose_size : unknowns of a pose, 2 (x, y) or 3 (x, y, heading)
    landmarks : (L,) their names, as numbers; calibration : names of its unknowns
    is_chain : whether only successive poses are joined; not if robots see each other
    """

    poses: int
    pose_size: int
    landmarks: NDArray[np.int64]
    calibration: tuple[str, ...] = ()
    is_chain: bool = True

    @property
    def split(self) -> int:
        """Number of columns of the poses, which come before all others."""
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

    Patterns are compared by identity: solvers reuse their analysis as long as they are given the same object.
    """

    row_start: NDArray[np.int64]
    columns: NDArray[np.int64]
    layout: Layout

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns of A."""
        return len(self.row_start) - 1, self.layout.columns

    def squared(self) -> BlockPattern:
        """Entries of AᵀA that may be nonzero, each a block of its own."""
        there = csr_matrix((np.ones(len(self.columns)), self.columns, self.row_start), self.shape)
        pairs = np.stack(triu(there.T @ there, k=1).nonzero(), axis=1).astype(np.int64)
        return BlockPattern(np.ones(self.layout.columns, np.int64), pairs)


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


def whitening(covariance: Matrix) -> Matrix:
    """W with WᵀW = Σ⁻¹, upper triangular; covariance (..., k, k)."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2).astype(np.float64, copy=False)


def pattern_of(groups: list[NDArray[np.int64]], layout: Layout) -> Pattern:
    """Pattern of groups of rows, one below the other; a group holds the columns (rows, entries) of its entries."""
    lengths = np.concatenate([np.full(len(group), group.shape[1], np.int64) for group in groups])
    row_start = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)])
    return Pattern(row_start, np.concatenate([group.reshape(-1) for group in groups]), layout)


def pose_columns(layout: Layout, poses: NDArray[np.int64]) -> NDArray[np.int64]:
    """Columns of each pose, (N, pose size)."""
    return poses[:, None] * layout.pose_size + np.arange(layout.pose_size)


def landmark_columns(layout: Layout, landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Columns of each landmark, (N, 2)."""
    return layout.landmark_start + 2 * landmarks[:, None] + np.arange(2)


def _differences(
    W: Matrix, first: NDArray[np.int64], second: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Matrix]:
    """Columns and values of the rows W (second − first) of many pairs of points, without entries zero for all.

    first, second (N, 2) : columns of the points
    """
    if not np.any(W - np.diag(W.diagonal())):
        columns = np.stack([first, second], axis=-1)
        values = np.stack([-W.diagonal(), W.diagonal()], axis=-1)
    else:
        columns = np.repeat(np.concatenate([first, second], axis=1)[:, None], 2, axis=1)
        values = np.concatenate([-W, W], axis=1)
    return columns.reshape(-1, columns.shape[-1]), np.broadcast_to(values, columns.shape)


def linear_system(given: Measurements) -> LinearSystem:
    """A x = b with A = Σ^(−1/2) H, b = Σ^(−1/2) z: a prior on the first pose, odometry, observations.

    The prior puts the first pose at the origin. It can be satisfied exactly, so that its noise, a hundredth of a
    step's, affects only the covariance.
    """
    layout = Layout(len(given.motion) + 1, 2, given.landmarks)
    W_odometry, W_observation = whitening(given.motion_covariance[0]), whitening(given.measured_covariance[0])
    poses = pose_columns(layout, np.arange(layout.poses))
    seen_from, seen = given.observed.T
    steps, stepped = _differences(W_odometry, poses[:-1], poses[1:])
    pairs, weighed = _differences(W_observation, poses[seen_from], landmark_columns(layout, seen))
    values = [1.0 / FIRST_SHARE * W_odometry.diagonal(), stepped.ravel(), weighed.ravel()]
    b = [np.zeros(2), (given.motion @ W_odometry.T).ravel(), (given.measured @ W_observation.T).ravel()]
    pattern = pattern_of([poses[0][:, None], steps, pairs], layout)
    return LinearSystem(pattern, np.concatenate(values), np.concatenate(b))


@dataclass(frozen=True, slots=True)
class Linearization:
    """Whitened residuals r at a state and the values of A = ∂r/∂x there.

    prior, calibration, odometry, observations : residuals (p,), (C,), (K − 1, p), (N, 2); pure numbers
    odometry_rows, observation_rows : of A: (K − 1, p, 2 p + A), (N, 2, p + 2 + B)
    """

    prior: NDArray[np.float64]
    calibration: NDArray[np.float64]
    odometry: Matrix
    observations: Matrix
    odometry_rows: Matrix
    observation_rows: Matrix

    @property
    def chi2(self) -> NDArray[np.float64]:
        """χ² of every observation, (N,)."""
        return np.square(self.observations).sum(axis=1)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Systematic errors of the wheels, common to all motions, and of the sensor, common to all observations.

    names, value, sigma : (C,) the value for which the motions were computed, and the prior's about zero
    moving, slope : (K − 1, A), (K − 1, p, A) unknowns of a motion, the first its scale, and its derivative by them
    sensing : (N, B) unknowns of an observation
    """

    names: tuple[str, ...]
    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    moving: NDArray[np.int64]
    slope: Matrix
    sensing: NDArray[np.int64]

    def moved(self, motion: Matrix, value: NDArray[np.float64]) -> Matrix:
        """Motions (K − 1, p) for another value (C,), to first order."""
        return motion + (self.slope @ (value - self.value)[self.moving][..., None])[..., 0]


def no_calibration(motion: Matrix, measured: Matrix) -> Calibration:
    """Calibration without parameters, of motions (K − 1, p) and observations (N, 2)."""
    nothing, (moving, sensing) = np.zeros(0), (np.zeros((len(each), 0), np.int64) for each in (motion, measured))
    return Calibration((), nothing, nothing, moving, np.zeros((*motion.shape, 0)), sensing)


@dataclass(frozen=True, slots=True)
class Measurements:
    """Measurements of a bearing-range problem.

    first_pose, first_covariance : (p,), (p, p) prior of the first pose; p is 2 without headings, 3 with them
    motion, motion_covariance : (K − R, p), (K − R, p, p) from each pose to the robot's next: with headings in the
        frame of the former, without in the world's
    observed : (N, 2) pose, and landmark or, from L on, the pose of a robot that is seen
    measured, measured_covariance : (N, 2), (N, 2, 2) bearing in rad, range in m
    landmarks : (L,) their names, as numbers
    starts : (R,) first pose of each robot; their poses stand one robot after the other
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
    starts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, np.int64))

    @property
    def poses(self) -> int:
        """Number of poses, K."""
        return len(self.motion) + len(self.starts)

    @property
    def before(self) -> NDArray[np.int64]:
        """Poses from which the motions start, (K − R,)."""
        return np.setdiff1d(np.arange(self.poses), np.append(self.starts[1:], self.poses) - 1)


class BearingRangeProblem:
    """Prior on the first pose, motion from pose to pose, bearings and ranges.

    ``motion_columns`` (K − R, 2 p + A) and ``observation_columns`` (N, p + 2 + B) are the columns of their
    unknowns, ``motion_whitening`` (K − R, p, p) is W with WᵀW = Σ⁻¹.
    """

    def __init__(self, measurements: Measurements) -> None:
        given = measurements
        self.measurements = given
        size = given.motion.shape[1]
        seen_from, seen = given.observed.T
        is_robot = seen >= len(given.landmarks)
        layout = Layout(given.poses, size, given.landmarks, given.calibration.names, not is_robot.any())
        self._first, self.motion_whitening = whitening(given.first_covariance), whitening(given.motion_covariance)
        self._observation = np.ascontiguousarray(whitening(given.measured_covariance))
        poses = pose_columns(layout, np.arange(layout.poses))
        own = np.arange(layout.split, layout.landmark_start)
        sensing, moving = (layout.split + each for each in (given.calibration.sensing, given.calibration.moving))
        points = landmark_columns(layout, seen)
        points[is_robot] = poses[seen[is_robot] - len(given.landmarks), :2]
        pairs = np.concatenate([poses[seen_from], points, sensing], axis=1)
        self._before = given.before
        moves = np.concatenate([poses[self._before], poses[self._before + 1], moving], axis=1)
        groups = [
            np.repeat(poses[:1], size, axis=0), own[:, None], np.repeat(moves, size, axis=0),
            np.repeat(pairs, 2, axis=0),
        ]  # fmt: skip
        damping = np.arange(layout.columns)[:, None]
        self.motion_columns, self.observation_columns = moves, pairs
        self.pattern, self._damped = pattern_of(groups, layout), pattern_of([*groups, damping], layout)

    def linearize(self, state: Values) -> Linearization:
        """Residuals and Jacobians at a state.

        A motion's residual is divided by the scale of the logged distances: noise of a fixed variance in the
        world's units would favor a small world, as the scale of the ranges is unknown as well.
        """
        given, p, W, before = self.measurements, state.poses.shape[1], self.motion_whitening, self._before
        calibration = given.calibration
        motion, J_motion = np.empty(given.motion.shape), np.empty((len(given.motion), p, 2 * p))
        if p == 2:
            motion = (W @ (state.poses[before + 1] - state.poses[before] - given.motion)[..., None])[..., 0]
            J_motion = np.concatenate([-W, W], axis=-1)
        elif not calibration.names:
            factors.odometry(state.poses, before, given.motion, W, motion, J_motion)
        else:
            scale = 1.0 + state.calibration[calibration.moving[:, :1]]
            W = W / np.concatenate([scale, scale, np.ones_like(scale)], axis=1)[:, None]
            moved = calibration.moved(given.motion, state.calibration)
            factors.odometry(state.poses, before, moved, W, motion, J_motion)
            slope = -W @ calibration.slope
            slope[..., 0] -= (motion - W[..., 2] * motion[:, 2:] / W[:, 2, 2:]) / scale
            J_motion = np.concatenate([J_motion, slope], axis=-1)
        seen = np.empty(given.measured.shape)
        J_seen = np.empty((len(seen), 2, p + 2 + calibration.sensing.shape[1]))
        factors.bearing_range(
            state.poses, np.vstack([state.landmarks, state.poses[:, :2]]), given.observed, given.measured,
            self._observation, state.calibration, calibration.sensing, seen, J_seen,
        )  # fmt: skip
        off = state.poses[0] - given.first_pose
        off[2:] = (off[2:] + np.pi) % (2.0 * np.pi) - np.pi
        own = state.calibration / calibration.sigma
        return Linearization(self._first @ off, own, motion, seen, J_motion, J_seen)

    def system(self, at: Linearization, weights: NDArray[np.float64]) -> LinearSystem:
        """The step's system A x = −r, observations weighed by √w (N,)."""
        root = np.sqrt(weights)[:, None]
        seen = at.observation_rows * root[..., None]
        own = 1.0 / self.measurements.calibration.sigma
        values = np.concatenate([self._first.ravel(), own, at.odometry_rows.ravel(), seen.ravel()])
        b = -np.concatenate([at.prior, at.calibration, at.odometry.ravel(), (at.observations * root).ravel()])
        return LinearSystem(self.pattern, values, b)

    def damped(self, system: LinearSystem, damping: NDArray[np.float64]) -> LinearSystem:
        """The system with an additional row √d for every unknown, so that AᵀA grows by diag(d); d (n,)."""
        values, b = np.concatenate([system.values, np.sqrt(damping)]), np.append(system.b, np.zeros(len(damping)))
        return LinearSystem(self._damped, values, b)
