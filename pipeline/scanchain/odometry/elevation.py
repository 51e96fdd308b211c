"""Elevation offset: a constant error of a lidar's vertical angles, found by adjusting its own scans."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np

from scanchain import lie
from scanchain.config import PreprocessConfig
from scanchain.data import Matrix, Points, Pose, Scan
from scanchain.kernels.registration.plane_adjustment import plane_equations, planes
from scanchain.preprocess import Sweep, sweep_of
from scanchain.registration.search import evenly

_FIRST, _LATER = (14, 0.6), (16, 0.9)  # scans adjusted together, and distance of two in cells: soon, then well
_CELL_M, _POINT_M = 1.0, 0.3  # edge of a cell, and of the voxels to which scans are downsampled
_RANGE_CELLS = 14.0  # least number of cells that the median range spans: they are small in narrow surroundings
_SMALLEST = 0.125  # smallest factor by which they shrink
_POINTS = 7000  # largest number of points of each scan, evenly spread
_ROUNDS, _STEP_RAD, _TURN_RAD = 8, 1e-4, 1e-3  # most Gauss-Newton steps, offset and turns of the last of them
_KERNEL = 1.5 / 0.6745  # scale of the robust weight over the median residual
_RIDGE = 1e-6  # keeps directions that no plane sees from a division by zero
_SCATTER_RAD = math.radians(0.02)  # standard deviation assumed of a window, beyond its own, before others are seen
_SHARED_RAD = math.radians(0.01)  # the part of it that is in every window's weight
_LEAST_RAD, _SIGMAS = math.radians(0.03), 4.0  # smallest offset that is corrected, and its least significance
_LARGEST_RAD = math.radians(1.0)  # largest one that is believed


class Adjustment(NamedTuple):
    """Scans adjusted together: their poses (K, 4, 4), the last one as it was, and the offset with its σ."""

    poses: Matrix
    offset_rad: float
    sigma_rad: float


class ElevationCalibration:
    """The elevation offset of a lidar, estimated again and again as it moves, ever more seldom.

    Ground seen from afar lies too high or too low by the offset times the distance, and a map of such points
    pitches every scan that is aligned to it: an offset of 0.2°, as in KITTI, by 0.01° per meter.

    offset_rad : what points are corrected by: the mean of the windows where it is significant, else 0
    sigma_rad : standard deviation of that mean, by the scatter of the windows; infinite before the first one
    """

    def __init__(self, config: PreprocessConfig, *, is_wanted: bool) -> None:
        self.config = msgspec.structs.replace(config, map_voxel_m=_POINT_M)
        self.is_wanted = is_wanted
        self.offset_rad, self.sigma_rad = 0.0, math.inf
        self.scale = 1.0
        self.windows = 0
        self.estimates: list[tuple[float, float]] = []  # offset and σ of each window
        self.forget()

    def corrected(self, sweep: Sweep) -> Sweep:
        """The sweep with its points raised by the offset."""
        return replace(sweep, points=raised(sweep.points, self.offset_rad)) if self.offset_rad else sweep

    def forget(self) -> None:
        """Forget the scans that were collected: the next pose does not follow from theirs."""
        self.T_odom_last: Pose | None = None
        self.left_out = 0
        self.collected: list[tuple[Points, Points, Pose]] = []

    def take(self, scan: Scan, points: Points, T_odom_lidar: Pose, velocity: Matrix) -> list[tuple[Points, Pose]]:
        """Collect a scan; empty unless it completes a window that changes the offset by as much as matters.

        Then the scans of the window are returned, corrected, with adjusted poses, of which the last one stays as
        it was. After n windows n scans are left out, and any without a velocity, as the first one.

        points : (N, 3) of the map, deskewed and corrected; velocity : (6,) by which the scan is deskewed
        """
        if not self.is_wanted or not velocity.any():
            return []
        scans, spacing = _LATER if self.windows else _FIRST
        spacing_m = spacing * self.scale * _CELL_M
        if self.T_odom_last is not None and lie.apart(self.T_odom_last, T_odom_lidar)[0] < spacing_m:
            return []
        self.T_odom_last = T_odom_lidar
        if self.left_out < self.windows:
            self.left_out += 1
            return []
        own = sweep_of(scan, self.config, self.scale).from_middle(velocity)
        if not self.collected:
            octaves = round(math.log2(float(np.median(np.linalg.norm(own, axis=1))) / (_RANGE_CELLS * _CELL_M)))
            self.scale = min(max(2.0**octaves, _SMALLEST), 1.0)
        self.collected.append((evenly(own, _POINTS), points, T_odom_lidar))
        return self._adjust() if len(self.collected) == scans else []

    def _adjust(self) -> list[tuple[Points, Pose]]:
        own, clouds, poses = zip(*self.collected, strict=True)
        found = adjusted(list(own), np.array(poses), self.scale * _CELL_M, self.offset_rad)
        self.windows += 1
        self.left_out, self.collected = 0, []
        if not math.isfinite(found.sigma_rad) or abs(found.offset_rad) > _LARGEST_RAD:
            return []
        self.estimates.append((found.offset_rad, found.sigma_rad))
        mean_rad, self.sigma_rad = _combined(np.array(self.estimates))
        is_significant = abs(mean_rad) > max(_LEAST_RAD, _SIGMAS * self.sigma_rad)
        before_rad, self.offset_rad = self.offset_rad, mean_rad if is_significant else 0.0
        change_rad = self.offset_rad - before_rad
        if abs(change_rad) < _LEAST_RAD:
            return []
        corrected = (raised(cloud, change_rad) for cloud in clouds)
        return list(zip(corrected, found.poses, strict=True))


def _combined(estimates: Matrix) -> tuple[float, float]:
    """Mean of windows (n, 2), each an offset and its σ, and its standard deviation.

    Beyond their own σ windows scatter, as the scans of one share distortions: by as much as they are seen to, and
    by what is assumed of one of them.
    """
    offset_rad, variance = estimates[:, 0], estimates[:, 1] ** 2
    weight = 1.0 / (variance + _SHARED_RAD**2)
    weight /= weight.max()
    mean_rad = float(weight @ offset_rad / weight.sum())
    scatter = (_SCATTER_RAD**2 + weight @ (offset_rad - mean_rad) ** 2) / weight.sum() ** 2
    return mean_rad, math.sqrt(scatter + 1.0 / (1.0 / variance).sum())


def raised(points: Points, offset_rad: float) -> Points:
    """Points (N, 3) in the lidar frame with their elevation angles raised."""
    x, y, z = np.asarray(points, np.float64).T
    sine, cosine, level = math.sin(offset_rad), math.cos(offset_rad), np.maximum(np.sqrt(x**2 + y**2), 1e-9)
    stretch = cosine - sine * z / level
    return np.column_stack([stretch * x, stretch * y, cosine * z + sine * level])


def adjusted(scans: list[Points], poses: Matrix, cell_m: float, offset_rad: float = 0.0) -> Adjustment:
    """Poses and elevation offset with which the planes that several scans (N, 3) see are thinnest.

    Gauss-Newton over all poses and the offset δ, from ``offset_rad`` on: with p(δ) the raised point of scan k, the
    residuals are the distances of T_k p(δ) from the planes, free too, of cells of a grid whose points, of at least
    three scans, are flat (plane adjustment; Liu and Zhang 2021). The ground may have any shape.
    """
    points, number = np.concatenate(scans), np.repeat(np.arange(len(scans)), [len(scan) for scan in scans])
    sigma_rad, last, n, size = math.inf, poses[-1], len(points), 6 * len(poses) + 1
    beside, normals, residual, plane = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, np.int32)
    for _ in range(_ROUNDS):
        lifted = raised(points, offset_rad)
        count = planes(lifted, number, poses, cell_m, beside, residual, plane, normals)
        if not count:
            return Adjustment(poses, 0.0, math.inf)
        scale_m = max(_KERNEL * float(np.median(np.abs(residual[plane >= 0]))), 1e-6)
        H, of_planes = np.zeros((size + 1, size + 1)), (plane, beside, residual, normals[:count])
        variance, gain = plane_equations(lifted, number, *of_planes, poses, scale_m, H)
        H, b = H[:-1, :-1], H[:-1, -1]
        inverse = np.linalg.inv(H + _RIDGE * np.trace(H) / size * np.eye(size))
        step = -gain * inverse @ b
        sigma_rad = math.sqrt(variance * inverse[-1, -1])
        offset_rad += float(step[-1])
        twists = step[:-1].reshape(len(poses), 6)
        poses = poses @ lie.exp(twists)
        has_converged = abs(step[-1]) < _STEP_RAD and np.abs(twists[:, 3:]).max() < _TURN_RAD
        if has_converged or abs(offset_rad) > _LARGEST_RAD:
            break
    return Adjustment(last @ lie.between(poses[-1], poses), offset_rad, sigma_rad)
