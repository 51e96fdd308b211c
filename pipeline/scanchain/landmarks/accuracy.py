"""Distance of an estimate of poses and landmarks from the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose, Trajectory
from scanchain.evaluation import Alignment, absolute_error, pair
from scanchain.landmarks.files.mrclam import RangeLog
from scanchain.landmarks.problem import LandmarkData, Values

_WIDEST_GAP_S = 0.5  # between motion-capture poses that are interpolated


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Root mean squared distances from the truth; NaN without truth. ``definition`` defines them as text."""

    poses_m: float
    landmarks_m: float
    definition: str


@dataclass(frozen=True, slots=True)
class Truth:
    """Motion capture at the times of an estimate.

    Attributes
    ----------
    known : (K,) bool, poses of the estimate for which there is a truth
    poses : (k, 3) x, y, heading of those
    landmarks : (L, 2), NaN where a landmark was not surveyed
    """

    known: NDArray[np.bool_]
    poses: Matrix
    landmarks: Matrix


def of_positions(state: Values, data: LandmarkData) -> Accuracy:
    """Against the positions of an npz file, where it has them; both lie in one frame."""
    known = len(data.true_poses) > 0
    if not known and np.isnan(data.true_landmarks).all():
        return Accuracy(np.nan, np.nan, "no true positions in the file")
    return Accuracy(
        _rms(state.poses - data.true_poses) if known else np.nan,
        _rms(state.landmarks - data.true_landmarks),
        "root mean squared distance from the true positions, nothing aligned",
    )


def truth_at(log: RangeLog, nodes_s: NDArray[np.float64], landmarks: NDArray[np.int64]) -> Truth:
    """Motion capture interpolated to these times, surveyed positions of these landmarks."""
    place = {
        int(subject): position for subject, position in zip(log.true_subjects, log.true_landmarks, strict=True)
    }
    surveyed = np.array([place.get(int(subject), np.full(2, np.nan)) for subject in landmarks])
    if len(log.true_s) < 2:
        return Truth(np.zeros(len(nodes_s), np.bool_), np.empty((0, 3)), surveyed)
    after = np.clip(np.searchsorted(log.true_s, nodes_s), 1, len(log.true_s) - 1)
    inside = (nodes_s >= log.true_s[0]) & (nodes_s <= log.true_s[-1])
    known = inside & (log.true_s[after] - log.true_s[after - 1] <= _WIDEST_GAP_S)
    heading = np.unwrap(log.true_poses[:, 2])
    columns = (log.true_poses[:, 0], log.true_poses[:, 1], heading)
    poses = np.stack([np.interp(nodes_s[known], log.true_s, column) for column in columns], axis=-1)
    return Truth(known, poses, surveyed)


def against_truth(state: Values, nodes_s: NDArray[np.float64], truth: Truth) -> tuple[Accuracy, Pose]:
    """ATE of the poses after rigid alignment, landmarks by the same alignment; and T_truth_estimate (3, 3)."""
    stamps_ns = nanoseconds(nodes_s[truth.known])
    estimate = Trajectory(stamps_ns, pose_matrices(state.poses[truth.known]))
    error = absolute_error(pair(estimate, Trajectory(stamps_ns, pose_matrices(truth.poses))), Alignment.RIGID)
    T_truth_estimate = lie.flatten(error.T_reference_estimate)
    moved = lie.transform(T_truth_estimate, state.landmarks)
    definition = f"{error.definition}, over {error.pairing}"
    return Accuracy(error.translation_m.rmse, _rms(moved - truth.landmarks), definition), T_truth_estimate


def nanoseconds(times_s: NDArray[np.float64]) -> NDArray[np.int64]:
    """Whole nanoseconds of times that were written with milliseconds."""
    return np.round(times_s * 1e3).astype(np.int64) * 1_000_000


def pose_matrices(poses: Matrix) -> Matrix:
    """SE(2) matrices (K, 3, 3) of x, y, heading (K, 3)."""
    result = np.zeros((len(poses), 3, 3))
    result[:, 0, 0] = result[:, 1, 1] = np.cos(poses[:, 2])
    result[:, 1, 0] = np.sin(poses[:, 2])
    result[:, 0, 1] = -result[:, 1, 0]
    result[:, :2, 2] = poses[:, :2]
    result[:, 2, 2] = 1.0
    return result


def _rms(differences: Matrix) -> float:
    """Root mean square over the rows that are known; NaN if none is."""
    known = differences[np.isfinite(differences).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) if len(known) else float("nan")
