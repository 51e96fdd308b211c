"""Elevation offset: a constant error of a lidar's vertical angles, found by adjusting its own scans."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Points, Pose
from scanchain.preprocess import Sweep
from scanchain.registration.correlative import evenly

_SCANS = 8  # number of scans that are adjusted together
_SPACING_VOXELS = 2.0  # least distance between two of them
_POINTS = 4000  # largest number of points of each, evenly spread
_ROUNDS, _STEP_RAD = 8, 1e-4  # largest number of Gauss-Newton steps, and the step at which they end
_FEWEST, _FEWEST_SCANS = 8, 3  # least number of points in a cell that counts as a plane, and of scans that see it
_THIN, _FLAT, _WIDE = 0.02, 0.15, 0.1  # of a plane: ratio of its variances, largest and least deviation in voxels
_TUKEY = 1.5 / 0.6745  # scale of the robust weight over the median residual
_RIDGE = 1e-6  # keeps directions that no plane sees from a division by zero
_LEAST_RAD = math.radians(0.05)  # smallest offset that is corrected
_LARGEST_RAD = math.radians(1.0)  # largest one that is believed
_SIGMAS, _LARGEST_SIGMA_RAD = 5.0, math.radians(0.02)  # significance of an offset, and its largest σ
_WINDOWS = 6  # largest number of estimates


class Adjustment(NamedTuple):
    """Scans adjusted together: their poses (K, 4, 4), the last one as it was, and the offset with its σ."""

    poses: Matrix
    offset_rad: float
    sigma_rad: float

    @property
    def is_significant(self) -> bool:
        """True if the offset is well known, worth a correction, and not beyond belief."""
        least = max(_LEAST_RAD, _SIGMAS * self.sigma_rad)
        return self.is_accurate and least < abs(self.offset_rad) < _LARGEST_RAD

    @property
    def is_accurate(self) -> bool:
        """True if the offset is known well enough to be corrected."""
        return self.sigma_rad < _LARGEST_SIGMA_RAD

    @property
    def shows_none(self) -> bool:
        """True if there is no offset worth a correction."""
        return self.is_accurate and abs(self.offset_rad) < _LEAST_RAD


class ElevationCalibration:
    """The elevation offset of a lidar, estimated a few times as it moves.

    Ground seen from afar lies too high or too low by the offset times the distance, and a map of such points
    pitches every scan that is aligned to it: an offset of 0.2°, as in KITTI, by 0.01° per meter.

    Attributes
    ----------
    offset_rad : what points are corrected by
    """

    def __init__(self, *, is_wanted: bool) -> None:
        self.offset_rad = 0.0
        self.windows_left = _WINDOWS if is_wanted else 0
        self.collected: list[tuple[Points, Pose]] = []

    def corrected(self, sweep: Sweep) -> Sweep:
        """The sweep with its points raised by the offset."""
        return replace(sweep, points=raised(sweep.points, self.offset_rad)) if self.offset_rad else sweep

    def forget(self) -> None:
        """Forget the scans that were collected: the next pose does not follow from theirs."""
        self.collected = []

    def take(self, points: Points, T_odom_lidar: Pose, voxel_m: float) -> list[tuple[Points, Pose]]:
        """Collect a scan (N, 3), deskewed; empty unless it completes a window with a significant offset.

        Then ``offset_rad`` includes it, and the scans of the window are returned, corrected, with adjusted poses,
        of which the last one stays as it was.
        """
        if not self.windows_left:
            return []
        if self.collected and lie.apart(self.collected[-1][1], T_odom_lidar)[0] < _SPACING_VOXELS * voxel_m:
            return []
        self.collected.append((points, T_odom_lidar))
        if len(self.collected) < _SCANS:
            return []
        clouds, poses = zip(*self.collected, strict=True)
        adjustment = adjusted([evenly(cloud, _POINTS) for cloud in clouds], np.array(poses), voxel_m)
        self.windows_left = 0 if adjustment.shows_none else self.windows_left - 1
        self.forget()
        if not adjustment.is_significant:
            return []
        self.offset_rad += adjustment.offset_rad
        corrected = (raised(cloud, adjustment.offset_rad) for cloud in clouds)
        return list(zip(corrected, adjustment.poses, strict=True))


def raised(points: Points, offset_rad: float) -> Points:
    """Points (N, 3) in the lidar frame with their elevation angles raised."""
    return math.cos(offset_rad) * points + math.sin(offset_rad) * _upward(points)


def _upward(points: Points) -> Points:
    """Derivative (N, 3) of points by their elevation angle."""
    range_m = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
    slope = points[:, 2] / range_m
    return np.column_stack([-slope * points[:, 0], -slope * points[:, 1], range_m])


def adjusted(scans: list[Points], poses: Matrix, voxel_m: float) -> Adjustment:
    """Poses and elevation offset with which the planes that several scans (N, 3) see are thinnest.

    Gauss-Newton over all poses and the offset δ: with p(δ) the raised point of scan k, the residuals are the
    distances n·(T_k p(δ) − mean) in the cells of a grid whose points, of at least three scans, lie in a plane
    (plane adjustment; Liu and Zhang 2021). The shape of the ground does not matter: all scans see the same.
    """
    points, number = np.concatenate(scans), np.repeat(np.arange(len(scans)), [len(scan) for scan in scans])
    offset_rad, sigma_rad, last = 0.0, math.inf, poses[-1]
    for _ in range(_ROUNDS):
        equations = _linearized(raised(points, offset_rad), number, poses, voxel_m)
        if equations is None:
            return Adjustment(poses, 0.0, math.inf)
        H, b, variance = equations
        inverse = np.linalg.inv(H)
        step = -inverse @ b
        sigma_rad = math.sqrt(variance * inverse[-1, -1])
        offset_rad += float(step[-1])
        poses = poses @ lie.exp(step[:-1].reshape(len(poses), 6))
        if abs(step[-1]) < _STEP_RAD or abs(offset_rad) > _LARGEST_RAD:
            break
    return Adjustment(last @ lie.between(poses[-1], poses), offset_rad, sigma_rad)


def _linearized(
    points: Points, number: NDArray[np.intp], poses: Matrix, voxel_m: float
) -> tuple[Matrix, NDArray[np.float64], float] | None:
    """Normal equations H (6K + 1, 6K + 1), b and variance of the residuals; None where there is no plane."""
    R = poses[number, :3, :3]
    world = np.einsum("nij,nj->ni", R, points) + poses[number, :3, 3]
    cell, chosen, normals, centered = _planes(world, number, len(poses), voxel_m)
    if not len(cell):
        return None
    number, points, R = number[chosen], points[chosen], R[chosen]
    residual = np.einsum("ni,ni->n", normals, centered)
    along = np.einsum("nij,ni->nj", R, normals)  # the normal in the scan's frame
    jacobian = np.column_stack(
        [along, np.cross(points, along), np.einsum("ni,ni->n", along, _upward(points))]
    )  # of the twist of T_k, T_k exp(ξ), and of the offset
    scale = max(_TUKEY * float(np.median(np.abs(residual))), 1e-6)
    weight = 1.0 / (1.0 + (residual / scale) ** 2) ** 2
    k, cells = len(poses), int(cell.max()) + 1
    size = 6 * k + 1
    H, b = np.zeros((size, size)), np.zeros(size)
    weighted = weight[:, None] * jacobian
    for scan in range(k):
        own = number == scan
        columns = np.r_[6 * scan : 6 * scan + 6, size - 1]
        H[np.ix_(columns, columns)] += weighted[own].T @ jacobian[own]
        b[columns] += np.einsum("ni,n->i", weighted[own], residual[own])
    # of the weighted Jacobians: the mean of a plane moves with its points; (cells, scans, 6) and (cells,)
    of_poses = np.stack([np.bincount(cell * k + number, each, cells * k) for each in weighted.T[:6]], axis=-1)
    of_poses, of_offset = of_poses.reshape(cells, k, 6), np.bincount(cell, weighted[:, -1], cells)
    of_residual = np.bincount(cell, weight * residual, cells)
    share = 1.0 / np.bincount(cell, weight, cells)
    mean = of_poses * share[:, None, None]
    # scan by scan: products so small are computed in one thread, to the same bits on every machine
    among = np.matmul(mean.transpose(1, 2, 0)[:, None], of_poses.transpose(1, 0, 2)[None])
    H[:-1, :-1] -= among.transpose(0, 2, 1, 3).reshape(size - 1, size - 1)
    with_offset = np.einsum("ckj,c->kj", mean, of_offset).ravel()
    H[:-1, -1] -= with_offset
    H[-1, :-1] -= with_offset
    H[-1, -1] -= (share * of_offset**2).sum()
    b[:-1] -= np.einsum("ckj,c->kj", mean, of_residual).ravel()
    b[-1] -= (share * of_offset * of_residual).sum()
    H += _RIDGE * np.trace(H) / size * np.eye(size)
    return H, b, float((weight * residual**2).sum() / weight.sum())


def _planes(
    world: Points, number: NDArray[np.intp], scans: int, voxel_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], Points, Points]:
    """Points that lie in planes: numbers of the cells, of the points, normals, and vectors from the means."""
    corner = np.floor(world / voxel_m).astype(np.int64)
    corner -= corner.min(axis=0)
    spans = corner.max(axis=0) + 1
    key = (corner[:, 0] * spans[1] + corner[:, 1]) * spans[2] + corner[:, 2]
    _, cell, count = np.unique(key, return_inverse=True, return_counts=True)
    seen = np.bincount(np.unique(cell * scans + number) // scans, minlength=len(count))
    is_rich = (count >= _FEWEST) & (seen >= _FEWEST_SCANS)
    chosen = np.flatnonzero(is_rich[cell])
    cell = (np.cumsum(is_rich) - 1)[cell[chosen]]
    centered, normals, is_plane = _shapes(world[chosen], cell, int(is_rich.sum()), voxel_m)
    inside = is_plane[cell]
    cell, chosen = (np.cumsum(is_plane) - 1)[cell[inside]], chosen[inside]
    return cell, chosen, normals[is_plane][cell], centered[inside]


def _shapes(
    world: Points, cell: NDArray[np.intp], cells: int, voxel_m: float
) -> tuple[Points, Points, NDArray[np.bool_]]:
    """Vectors (N, 3) of points from the means of their cells; normals (C, 3), and which cells are planes."""
    count = np.bincount(cell, minlength=cells)
    mean = np.column_stack([np.bincount(cell, world[:, axis], cells) for axis in range(3)]) / count[:, None]
    centered = world - mean[cell]
    covariance = np.empty((cells, 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = np.bincount(cell, centered[:, i] * centered[:, j], cells) / count
    values, vectors = np.linalg.eigh(covariance)
    is_plane = (values[:, 0] < _THIN * values[:, 1]) & (values[:, 0] < (_FLAT * voxel_m) ** 2)
    return centered, vectors[:, :, 0], is_plane & (values[:, 1] > (_WIDE * voxel_m) ** 2)
