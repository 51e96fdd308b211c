"""The linear landmark problem: steps between poses and landmarks' positions relative to them."""

from __future__ import annotations

import numpy as np

from scanchain.landmarks.problem import LandmarkData, Values
from scanchain.landmarks.system import (
    Layout,
    LinearSystem,
    Rows,
    difference_rows,
    landmark_columns,
    pattern_of,
    pose_columns,
    whitening,
)

_ANCHOR = 100.0  # weight of the first pose over that of a step


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
        Rows(poses[0][:, None], _ANCHOR * W_odometry.diagonal()[:, None]),
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
