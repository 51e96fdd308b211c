"""How sharp the map is that a trajectory makes of a log, where there is no ground truth (Razlaw et al. 2015).

The same points of the same scans are put where a trajectory has the lidar at their instants (between two stamps
along the screw that joins the poses). Around the same query points, all neighbours within r = 0.5 m make a
covariance Σ (3, 3) with smallest eigenvalue λ₁, and over the query points q

    mean map entropy       1/Q Σ_q ½ ln det(2πe Σ(q))     in nats for Σ in m²
    plane thickness        √(1/Q Σ_q λ₁(q))               in metres, the root of the mean plane variance

A query point counts if in the map of every method it has 10 neighbours at least and a covariance that is not flat
by accident (λ₁ > 0). Lower is sharper. Moving objects blur all maps alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pipeline import lie
from pipeline.data import Scan, Trajectory
from tests.benchmarks.contest import Recording

RADIUS_M = 0.5
REACH_M = 40.0  # points further off are too sparse to judge by
MIN_NEIGHBOURS = 10
MAX_POINTS, MAX_QUERIES = 600_000, 15_000


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Lower is sharper."""

    mean_map_entropy: float
    plane_thickness_m: float


def sharpness(recording: Recording, trajectories: Sequence[Trajectory]) -> list[Sharpness]:
    """One answer a trajectory, all over the same query points."""
    eigenvalues = np.array([_eigenvalues(_map(recording, trajectory)) for trajectory in trajectories])
    counts = np.isfinite(eigenvalues).all(axis=(0, 2)) & (eigenvalues > 0.0).all(axis=(0, 2))
    eigenvalues = eigenvalues[:, counts]
    entropy = 0.5 * (3.0 * np.log(2.0 * np.pi * np.e) + np.log(eigenvalues).sum(axis=2)).mean(axis=1)
    thickness_m = np.sqrt(eigenvalues[:, :, 0].mean(axis=1))
    return [Sharpness(float(a), float(b)) for a, b in zip(entropy, thickness_m, strict=True)]


def _map(recording: Recording, trajectory: Trajectory) -> NDArray[np.float64]:
    """(M, 3) every so-many-th point within reach, in the frame of the trajectory."""
    step = max(1, sum(len(scan.points) for scan in recording.scans) // MAX_POINTS)
    seconds = np.diff(trajectory.stamps_ns)[:, None] * 1e-9
    velocities = lie.log(lie.inverse(trajectory.poses[:-1]) @ trajectory.poses[1:]) / seconds
    before, after = np.vstack([velocities[:1], velocities]), np.vstack([velocities, velocities[-1:]])
    scans = zip(recording.scans, trajectory.poses, before, after, strict=True)
    return np.concatenate([lie.transform(pose, _deskewed(scan, step, v, w)) for scan, pose, v, w in scans])


def _deskewed(
    scan: Scan, step: int, before: NDArray[np.float64], after: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points as seen at the stamp, by the velocity up to it and the one from it on."""
    near = np.linalg.norm(scan.points[::step], axis=1) < REACH_M
    points = scan.points[::step][near].astype(np.float64)
    if not len(scan.times_s):
        return points
    times_s = scan.times_s[::step][near].astype(np.float64)[:, None]
    T_stamp_point = lie.exp(np.where(times_s < 0.0, before, after) * times_s)
    return np.einsum("nij,nj->ni", T_stamp_point[:, :3, :3], points) + T_stamp_point[:, :3, 3]


def _eigenvalues(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(Q, 3) ascending, m², of the covariance around every query point; NaN where there are too few neighbours."""
    queries = points[:: max(1, len(points) // MAX_QUERIES)]
    neighbours = KDTree(points).query_ball_point(queries, RADIUS_M, return_sorted=False)
    result = np.full((len(queries), 3), np.nan)
    for row, chosen in enumerate(neighbours):
        if len(chosen) >= MIN_NEIGHBOURS:
            result[row] = np.linalg.eigvalsh(np.cov(points[chosen].T))
    return result
