"""Initialization: poses by odometry, landmarks by their first observation; for a long log, part by part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.robust.losses import RobustLoss
from scanchain.landmarks.bearing_range import BearingRangeProblem, Measurements
from scanchain.landmarks.minimize import minimize
from scanchain.landmarks.problem import LandmarkData, Values
from scanchain.landmarks.ranges.dead_reckoning import chain
from scanchain.landmarks.solvers import LinearSolver

_FIRST, _GROWTH = 16, 2  # number of poses of the first part, and growth factor of each further one
_STEPS = 2
_CONVEX = RobustLoss("huber", 1.345, 1.0)


def from_odometry(measurements: Measurements) -> Values:
    """Poses chained by the motions, every landmark by its first observation."""
    if measurements.motion.shape[1] == 3:
        poses = chain(measurements.first_pose, measurements.motion)
    else:
        poses = measurements.first_pose + np.cumsum(np.vstack([np.zeros(2), measurements.motion]), axis=0)
    return Values(poses, _first_seen(measurements, poses)[0], measurements.calibration.value)


def of_relative_positions(data: LandmarkData) -> Values:
    """The same for a linear problem."""
    poses = np.cumsum(np.vstack([np.zeros(2), data.odometry]), axis=0)
    _, first = np.unique(data.observed[:, 1], return_index=True)
    landmarks = np.full(data.true_landmarks.shape, np.nan)
    landmarks[data.observed[first, 1]] = poses[data.observed[first, 0]] + data.measured[first]
    return Values(poses, landmarks)


def disturbed(state: Values, shift_m: float, turn_rad: float) -> Values:
    """The poses but for the first moved by a shift along both axes and turned about the origin."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    poses = state.poses.copy()
    poses[1:, :2] = poses[1:, :2] @ np.array([[c, s], [-s, c]]) + shift_m
    poses[1:, 2:] += turn_rad
    return replace(state, poses=poses)


def growing(measurements: Measurements, solver: LinearSolver) -> Values:
    """Initialize part by part: extend the solution of the log so far, optimize, and so on to its end.

    Dead reckoning over the whole log may be meters off, where a robust loss finds but a local minimum; over a
    half of it, from poses and landmarks that are settled, it is not. The loss is convex in the residuals.
    """
    count = len(measurements.motion) + 1
    poses, landmarks = measurements.first_pose[None], np.full((len(measurements.landmarks), 2), np.nan)
    own, reach = measurements.calibration.mean, _FIRST
    while True:
        reach = min(reach, count)
        motion = measurements.motion_at(own)
        poses = np.vstack([poses, chain(poses[-1], motion[len(poses) - 1 : reach - 1])[1:]])
        part, known = _beginning(measurements, reach)
        guess, _ = _first_seen(part, poses)
        settled = np.isfinite(landmarks[known, 0])
        guess[settled] = landmarks[known[settled]]
        state = minimize(
            BearingRangeProblem(part), Values(poses, guess, own), solver, loss=_CONVEX, max_iterations=_STEPS
        ).state
        poses, landmarks[known], own = state.poses, state.landmarks, state.calibration
        if reach == count:
            return Values(poses, landmarks, own)
        reach *= _GROWTH


def _beginning(measurements: Measurements, poses: int) -> tuple[Measurements, NDArray[np.int64]]:
    """The problem of the first so many poses, and the landmarks observed from them."""
    kept = measurements.observed[:, 0] < poses
    known, landmark = np.unique(measurements.observed[kept, 1], return_inverse=True)
    part = replace(
        measurements,
        motion=measurements.motion[: poses - 1],
        motion_covariance=measurements.motion_covariance[: poses - 1],
        calibration=replace(measurements.calibration, slope=measurements.calibration.slope[: poses - 1]),
        observed=np.stack([measurements.observed[kept, 0], landmark], axis=1),
        measured=measurements.measured[kept],
        landmarks=measurements.landmarks[known],
    )
    return part, known


def _first_seen(measurements: Measurements, poses: Matrix) -> tuple[Matrix, NDArray[np.int64]]:
    """Position (L, 2) of every landmark by its first observation, and the index of that observation, (L,)."""
    _, first = np.unique(measurements.observed[:, 1], return_index=True)
    pose = poses[measurements.observed[first, 0]]
    bearing, reach = measurements.measured[first].T
    direction = bearing + (pose[:, 2] if poses.shape[1] == 3 else 0.0)
    return pose[:, :2] + reach[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1), first
