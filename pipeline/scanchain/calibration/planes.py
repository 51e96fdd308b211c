"""Calibration of lidars by one adjustment of planes, poses and parameters: offsets of a lidar, poses of others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix, hstack

from scanchain import lie
from scanchain.calibration.motions import STEP, STEPS
from scanchain.data import Integers, Mask, Matrix, Points, Pose, Vector
from scanchain.kernels.registration.plane_adjustment import LEAST_SLOPE, planes
from scanchain.logs.messages.lidar import with_offsets
from scanchain.odometry.elevation import kernel_scale
from scanchain.preprocess import ScanMotion

_RIDGE = 1e-9  # regularizes planes and poses that few points constrain
_REGION_CELLS = 8.0  # edge, in cells, of the regions whose errors count as independent
_LEVEL = 0.7  # least vertical component of the normal of a level plane
OFFSETS = 2  # parameters of the first lidar: elevation and range; six of each other one follow
_PRIOR = np.array([math.radians(1.0), 0.02] + [0.5] * 3 + [math.radians(10.0)] * 3)  # σ of the parameters
_HELD = 1e6  # factor on the prior information of an offset that is held, not on its σ
_SYSTEMATIC = np.array([math.radians(0.03), 0.006])  # σ of the offsets that all windows share
_SCATTER = np.array([math.radians(0.02), 0.005] + [0.005] * 3 + [math.radians(0.03)] * 3)  # of a window, a priori


class Others(NamedTuple):
    """Points (N, 3) of another lidar during a scan, in its own frame, and their times (N,) after the stamp."""

    points: Points
    times_s: Vector


@dataclass
class Window:
    """Scans (K) that see the same surfaces.

    own : points of the first lidar in its frame at the stamps
    poses : (K, 4, 4) of the first lidar at its stamps; improved by the adjustment
    twists : (K, 2, 6) of the first lidar, per second, before and after each stamp
    others : for each other lidar its points in each scan
    """

    own: Sequence[Points]
    poses: Matrix
    twists: Matrix
    others: Sequence[Sequence[Others]]
    cell_m: float

    def others_in_first(self, lidar: int, T_first_other: Pose) -> list[Points]:
        """Points of another lidar in each scan, in the frame of the first one at the stamp."""
        found = []
        for seen, (before, after) in zip(self.others[lidar], self.twists, strict=True):
            points, is_after = lie.transform(T_first_other, seen.points), seen.times_s >= 0.0
            for mask, twist in ((is_after, after), (~is_after, before)):
                moved = np.ascontiguousarray(points[mask])
                ScanMotion(twist).deskew(moved, np.ascontiguousarray(seen.times_s[mask]))
                points[mask] = moved
            found.append(points)
        return found


class Adjusted(NamedTuple):
    """Offsets of elevation in rad and ranges in m, poses (L, 4, 4) of the other lidars in the first.

    covariance : (2 + 6 L,) squared of these, poses as twists in the first lidar's frame
    contradiction : of the range offset by level and upright planes, in standard deviations
    """

    offsets: Vector
    T_first_others: Matrix
    covariance: Matrix
    contradiction: float

    @property
    def sigmas(self) -> Vector:
        """Standard deviations (2 + 6 L,)."""
        return np.sqrt(self.covariance.diagonal())


class _Equations(NamedTuple):
    """Normal equations of a window, its planes and poses eliminated.

    M : information (m, m) of the parameters
    scores, is_level : gradient (C, m) by region, of level or upright planes
    variance, gain : of a residual; factor on the step and on standard deviations by the robust weights
    T_step, T_by : change (6 (K−1),) of the poses, and its derivative (6 (K−1), m) by the parameters
    """

    M: Matrix
    scores: Matrix
    is_level: Mask
    variance: float
    gain: float
    T_step: Vector
    T_by: Matrix


def adjust(
    windows: Sequence[Window],
    T_first_others: Matrix,
    *,
    holds: Sequence[bool] = (False, False),
    sigmas: Vector = _PRIOR[:OFFSETS],
) -> Adjusted | None:
    """Parameters that make the planes of all windows thinnest, by Gauss-Newton; None without planes.

    holds : whether elevation and range offset remain 0; their prior ``sigmas`` then add to those of the others

    As in ``Adjusting``, with planes and poses of each window eliminated. Standard deviations do not assume that
    points are independent: gradients are summed over regions of the planes, whose errors are (a sandwich
    estimator; Huber 1967, Liang and Zeger 1986). Windows scatter in addition, since their scans share distortions.
    """
    m, T_others = OFFSETS + 6 * len(T_first_others), T_first_others
    prior, scatter = (
        np.concatenate([each[:OFFSETS], np.tile(each[OFFSETS:], len(T_others))]) ** 2
        for each in (np.concatenate([sigmas, _PRIOR[OFFSETS:]]), _SCATTER)
    )
    found, covariance, inverse = np.zeros(m), np.diag(prior), np.zeros((m, m))
    known = list[tuple[Window, _Equations]]()
    for _ in range(STEPS):
        of_windows = [(each, _equations(each, found[:OFFSETS], T_others)) for each in windows]
        known = [(window, each) for window, each in of_windows if each is not None]
        if not known:
            return None
        P = np.diag(np.mean([each.variance for _, each in known]) / prior)
        P[:OFFSETS, :OFFSETS] *= np.where(holds, _HELD, 1.0)
        M = sum((each.M for _, each in known), P)
        b = sum((each.scores.sum(axis=0) for _, each in known), P @ found)
        gain = float(np.mean([each.gain for _, each in known]))
        inverse = np.linalg.inv(M)
        step = -gain * inverse @ b
        spread = sum((each.gain**2 * each.scores.T @ each.scores for _, each in known), P @ np.diag(prior) @ P)
        spread = sum((each.M @ np.diag(scatter) @ each.M for _, each in known), spread)
        covariance = inverse @ spread @ inverse
        for window, each in known:
            twists = each.gain * each.T_step + each.T_by @ step
            window.poses[1:] = window.poses[1:] @ lie.exp(twists.reshape(-1, 6))
        found = found + step
        T_others = lie.exp(step[OFFSETS:].reshape(-1, 6)) @ T_others if len(T_others) else T_others
        if np.all(np.abs(step) < STEP * np.sqrt(covariance.diagonal())):
            break
    for i in np.flatnonzero(~np.array(holds)):
        covariance[i, i] += _SYSTEMATIC[i] ** 2
    contradiction = _contradiction([each for _, each in known], inverse[1])
    return Adjusted(found[:OFFSETS], T_others, covariance, contradiction)


def _contradiction(known: Sequence[_Equations], by: Vector) -> float:
    """Difference, in standard deviations, of a parameter by level and by upright planes; ``by`` : row of M⁻¹."""
    found = np.concatenate([each.scores @ by for each in known])
    is_level = np.concatenate([each.is_level for each in known])
    level, upright = float(np.sum(found[is_level] ** 2)), float(np.sum(found[~is_level] ** 2))
    if not level or not upright:
        return 0.0
    return float(found[is_level].sum() / math.sqrt(level * upright / (level + upright)))


class _InPlanes(NamedTuple):
    """Points (N, 3) in the first lidar's frame that lie in P planes.

    number, lidar, plane : (N,) of each point; residual, offset : distance from its plane, and from its mean (N, 3)
    normals : (P, 3)
    """

    points: Points
    number: Integers
    lidar: Integers
    plane: Integers
    residual: Vector
    offset: Matrix
    normals: Matrix


def _in_planes(window: Window, offsets: Vector, T_others: Matrix) -> _InPlanes:
    clouds = [[with_offsets(each, *offsets) for each in window.own]]
    clouds += [window.others_in_first(lidar, T) for lidar, T in enumerate(T_others)]
    sizes = np.array([[len(cloud) for cloud in of_lidar] for of_lidar in clouds])
    points = np.concatenate([cloud for of_lidar in clouds for cloud in of_lidar])
    lidar, number = (np.repeat(each.ravel(), sizes.ravel()) for each in np.indices(sizes.shape))
    n = len(points)
    offset, normals, residual, plane = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, np.int32)
    P = planes(points, number, window.poses, window.cell_m, offset, residual, plane, normals)
    used = np.flatnonzero(plane >= 0)
    points, number, lidar = points[used], number[used], lidar[used]
    return _InPlanes(
        points, number, lidar, plane[used].astype(np.int64), residual[used], offset[used], normals[:P]
    )


def _equations(window: Window, offsets: Vector, T_others: Matrix) -> _Equations | None:
    """Equations at the current parameters; None without planes."""
    points, number, lidar, plane, residual, offset, normals = _in_planes(window, offsets, T_others)
    n, P, K, L = len(points), len(normals), len(window.poses), 1 + len(T_others)
    q = 6 * K
    if P < K:
        return None
    scale_m = kernel_scale(residual)
    square = (residual / scale_m) ** 2
    weight = (1.0 + square) ** -2
    slopes = float(np.sum(weight * (1.0 - 3.0 * square) / (1.0 + square)))
    a = np.einsum("nji,nj->ni", window.poses[number, :3, :3], normals[plane])
    J = np.hstack([a, np.cross(points, a)])
    of_lidars = [_of_offsets(points, a) * (lidar == 0)[:, None], *(J * (lidar == o)[:, None] for o in range(1, L))]
    columns = 6 * number[:, None] + np.arange(6)
    of_poses = csr_matrix((J.ravel(), columns.ravel(), np.arange(0, 6 * n + 1, 6)), (n, q))
    A = hstack([of_poses, csr_matrix(np.hstack(of_lidars))], "csr")
    Q = csr_matrix((np.ones(n), plane, np.arange(n + 1)), (n, P)).T  # sums over the points of each plane
    by_plane = np.column_stack([np.ones(n), offset - residual[:, None] * normals[plane]])  # height and slopes
    sums = np.stack([(Q @ A.multiply((weight * each)[:, None])).toarray() for each in by_plane.T], axis=1)
    S = (Q @ (weight[:, None, None] * by_plane[:, :, None] * by_plane[:, None]).reshape(n, 16)).reshape(P, 4, 4)
    S += _RIDGE * (1e-3 + np.trace(S, axis1=1, axis2=2))[:, None, None] * np.eye(4)
    solved = np.linalg.solve(S, np.dstack([sums, Q @ ((weight * residual)[:, None] * by_plane)]))
    solved, height = solved[:, :, :-1], solved[:, :, -1]
    H = (A.T @ A.multiply(weight[:, None])).toarray()
    H -= sums.reshape(4 * P, -1).T @ solved.reshape(4 * P, -1)
    gradients = (Q @ A.multiply((weight * residual)[:, None])).toarray() - np.einsum("pcs,pc->ps", sums, height)
    H_poses = H[6:q, 6:q] + _RIDGE * np.trace(H[6:q, 6:q]) * np.eye(q - 6)  # the first pose is held
    by_poses = -np.linalg.solve(H_poses, np.column_stack([gradients.sum(axis=0)[6:q], H[6:q, q:]]))
    scores = gradients[:, q:] + gradients[:, 6:q] @ by_poses[:, 1:]
    world = np.einsum("nij,nj->ni", window.poses[number, :3, :3], points) + window.poses[number, :3, 3]
    middles = (Q @ world) / np.maximum(Q.sum(axis=1), 1.0)
    cells = np.floor(np.asarray(middles) / (_REGION_CELLS * window.cell_m))
    cells = np.column_stack([cells, np.abs(normals[:, 2]) > _LEVEL])
    regions, region = np.unique(cells, axis=0, return_inverse=True)
    return _Equations(
        M=H[q:, q:] + H[q:, 6:q] @ by_poses[:, 1:],
        scores=csr_matrix((np.ones(P), region.ravel(), np.arange(P + 1)), (P, len(regions))).T @ scores,
        is_level=regions[:, 3] > 0.0,
        variance=(scale_m / 1.5) ** 2,
        gain=float(weight.sum()) / max(slopes, LEAST_SLOPE * float(weight.sum())),
        T_step=by_poses[:, 0],
        T_by=by_poses[:, 1:],
    )


def _of_offsets(points: Points, a: Matrix) -> Matrix:
    """Derivatives (N, 2) of residuals with normals a by the elevation and the ranges."""
    x, y, z = points.T
    level = np.maximum(np.hypot(x, y), 1e-9)
    by_elevation = level * a[:, 2] - z / level * (x * a[:, 0] + y * a[:, 1])
    return np.column_stack([by_elevation, np.sum(points * a, axis=1) / np.maximum(np.hypot(level, z), 1e-9)])
