"""Sharpness of the map by a trajectory of a log, where there is no ground truth (Razlaw et al. 2015).

The same points of the same scans are put where a trajectory has the lidar at their instants (between two stamps
along the screw that joins the poses). Around the same query points, all neighbors within a radius make a
covariance Σ (d, d) with smallest eigenvalue λ₁, and over the query points q

    mean map entropy       1/Q Σ_q ½ ln det(2πe Σ(q))     in nats for Σ in m²
    surface thickness      √(1/Q Σ_q λ₁(q))               in meters, the root of the mean variance across it

A query point counts if in the map of every trajectory it has 10 neighbors at least and a covariance that is not
flat by accident (λ₁ > 0). Lower is sharper. Moving objects blur all maps alike. It is not ground truth: a map that
is bent but sharp scores well.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Points, Scan, Trajectory

RADIUS_M = {2: 0.2, 3: 0.5}
REACH_M = 40.0  # largest range of the points that are compared: those farther off are too sparse
MIN_NEIGHBORS = 10
MAX_POINTS, MAX_QUERIES = 600_000, 15_000
_AT_ONCE = 64  # number of queries whose neighbors are in memory at a time
_MIN_COVERAGE = 0.5  # least share of the query points of the best map that another must cover to be compared


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Lower is sharper."""

    mean_map_entropy: float
    thickness_m: float


def sharpness(maps: Sequence[Points]) -> list[Sharpness | None]:
    """Sharpness of each map of ``sampled_map``, all over the same query points.

    None for a fragmented map: it would leave too few points to compare the others at.
    """
    eigenvalues = np.array([_eigenvalues(points) for points in maps])
    good: NDArray[np.bool_] = np.all(np.isfinite(eigenvalues) & (eigenvalues > 0.0), axis=2)
    covered = good.sum(axis=1) >= _MIN_COVERAGE * good.sum(axis=1).max(initial=0)
    counts = good[covered].all(axis=0)
    if not counts.any():
        return [None] * len(maps)
    chosen = eigenvalues[:, counts]
    return [_sharpness(each) if is_covered else None for each, is_covered in zip(chosen, covered, strict=True)]


def sampled_map(scans: Iterable[Scan], trajectory: Trajectory, step: int) -> Points:
    """(M, d) every ``step``-th point within reach, in the frame of the trajectory, deskewed by it.

    scans : one a pose of the trajectory
    """
    after = velocities(trajectory)
    before = np.vstack([after[:1], after[:-1]])
    rows = zip(scans, trajectory.poses, before, after, strict=True)
    return np.concatenate([lie.transform(pose, _deskewed(scan, step, v, w)) for scan, pose, v, w in rows])


def velocities(trajectory: Trajectory) -> NDArray[np.float64]:
    """(N, k) twist per second from each pose to the next, of the last one as before; 0 where stamps stand."""
    seconds = 1e-9 * np.diff(trajectory.stamps_ns)[:, None]
    twists = lie.log(lie.between(trajectory.poses[:-1], trajectory.poses[1:]))
    result = np.zeros((len(trajectory), twists.shape[1]))
    np.divide(twists, seconds, out=result[:-1], where=seconds > 0.0)
    result[-1] = result[max(len(result) - 2, 0)]
    return result


def sampling_step(points: int) -> int:
    """Of all points of a log every so many-th is taken."""
    return max(1, points // MAX_POINTS)


def _sharpness(eigenvalues: NDArray[np.float64]) -> Sharpness:
    """Of eigenvalues (Q, d), ascending, m²."""
    d = eigenvalues.shape[1]
    entropy = 0.5 * (d * np.log(2.0 * np.pi * np.e) + np.log(eigenvalues).sum(axis=1)).mean()
    return Sharpness(float(entropy), float(np.sqrt(eigenvalues[:, 0].mean())))


def _deskewed(scan: Scan, step: int, before: NDArray[np.float64], after: NDArray[np.float64]) -> Points:
    """Points as seen at the stamp, by the velocity up to it and the one from it on."""
    near = np.linalg.norm(scan.points[::step], axis=1) < REACH_M
    points = scan.points[::step][near].astype(np.float64)
    if not len(scan.times_s):
        return points
    times_s = scan.times_s[::step][near].astype(np.float64)[:, None]
    T_stamp_point = lie.exp(np.where(times_s < 0.0, before, after) * times_s)
    d = points.shape[1]
    return np.einsum("nij,nj->ni", T_stamp_point[:, :d, :d], points) + T_stamp_point[:, :d, d]


def _eigenvalues(points: Points) -> NDArray[np.float64]:
    """(Q, d) ascending, m², of the covariance around every query point; NaN where there are too few neighbors."""
    d = points.shape[1]
    queries = points[:: max(1, len(points) // MAX_QUERIES)]
    tree = KDTree(points)
    result = np.full((len(queries), d), np.nan)
    for begin in range(0, len(queries), _AT_ONCE):  # all neighbors of all queries take gigabytes
        some = queries[begin : begin + _AT_ONCE]
        for row, chosen in enumerate(tree.query_ball_point(some, RADIUS_M[d], return_sorted=False), begin):
            if len(chosen) >= MIN_NEIGHBORS:
                result[row] = np.linalg.eigvalsh(np.cov(points[chosen].T))
    return result
