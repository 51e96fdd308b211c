"""Elevation offset: a constant error of a lidar's vertical angles, found by adjusting its own scans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scanchain import lie
from scanchain.data import Matrix, Points, Pose
from scanchain.kernels.registration.plane_adjustment import plane_equations, planes
from scanchain.kernels.scans import raise_elevation
from scanchain.preprocess import Sweep
from scanchain.registration.search import evenly

_FIRST, _LATER = (14, 0.6), (16, 0.9)  # scans adjusted together, and distance of two in cells: soon, then well
_CELL_M = 1.0  # edge of a cell
_RANGE_CELLS = 14.0  # least number of cells that the median range spans: they are small in narrow surroundings
_SMALLEST = 0.125  # smallest factor by which they shrink
_POINTS = 3500  # largest number of points of each scan, evenly spread
_STEPS, _STEP_RAD, _TURN_RAD = 8, 1e-4, 1e-3  # most Gauss-Newton steps, offset and turns of the last of them
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

    def __init__(self, *, is_wanted: bool) -> None:
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
        self.collected: list[tuple[Points, Pose]] = []
        self.adjusting: Adjusting | None = None  # the scans collected, a step at a scan
        self.since: list[tuple[Points, Pose]] = []  # the scans since then

    def take(self, points: Points, T_odom_lidar: Pose) -> list[tuple[Points, Pose]]:
        """Collect a scan; empty unless a window is adjusted and changes the offset by as much as matters.

        Then its scans, with adjusted poses, of which the last one stays as it was, and those since are returned,
        corrected. After n windows n scans are left out.

        points : (N, 3) of the map, deskewed and corrected
        """
        if self.adjusting is not None:
            self.since.append((points, T_odom_lidar))
            found = self.adjusting.step()
            return self._adopt(found) if found is not None else []
        if not self.is_wanted:
            return []
        scans, spacing = _LATER if self.windows else _FIRST
        spacing_m = spacing * self.scale * _CELL_M
        if self.T_odom_last is not None and lie.apart(self.T_odom_last, T_odom_lidar)[0] < spacing_m:
            return []
        self.T_odom_last = T_odom_lidar
        if self.left_out < self.windows:
            self.left_out += 1
            return []
        if not self.collected:
            range_m = float(np.median(np.linalg.norm(points, axis=1)))
            self.scale = min(max(2.0 ** round(math.log2(range_m / (_RANGE_CELLS * _CELL_M))), _SMALLEST), 1.0)
        self.collected.append((points, T_odom_lidar))
        if len(self.collected) == scans:
            clouds, poses = zip(*self.collected, strict=True)
            few = [evenly(cloud, _POINTS) for cloud in clouds]
            self.adjusting = Adjusting(few, np.array(poses), self.scale * _CELL_M)
        return []

    def _adopt(self, found: Adjustment) -> list[tuple[Points, Pose]]:
        collected, since = self.collected, self.since
        self.windows += 1
        self.left_out, self.collected, self.adjusting, self.since = 0, [], None, []
        offset_rad = self.offset_rad + found.offset_rad
        if not math.isfinite(found.sigma_rad) or abs(offset_rad) > _LARGEST_RAD:
            return []
        self.estimates.append((offset_rad, found.sigma_rad))
        mean_rad, self.sigma_rad = _combined(np.array(self.estimates))
        is_significant = abs(mean_rad) > max(_LEAST_RAD, _SIGMAS * self.sigma_rad)
        before_rad, self.offset_rad = self.offset_rad, mean_rad if is_significant else 0.0
        change_rad = self.offset_rad - before_rad
        if abs(change_rad) < _LEAST_RAD:
            return []
        placed = [(points, pose) for (points, _), pose in zip(collected, found.poses, strict=True)]
        return [(raised(points, change_rad), pose) for points, pose in placed + since]


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
    return raise_elevation(np.ascontiguousarray(points, np.float64), offset_rad)


class Adjusting:
    """Adjustment of poses and elevation offset such that the planes that several scans (N, 3) see are thinnest.

    Gauss-Newton over all poses and the offset δ: with p(δ) the raised point of scan k, the
    residuals are the distances of T_k p(δ) from the planes, free too, of cells of a grid whose points, of at least
    three scans, are flat (plane adjustment; Liu and Zhang 2021). The ground may have any shape.
    """

    def __init__(self, scans: Sequence[Points], poses: Matrix, cell_m: float) -> None:
        self.points, self.number = np.concatenate(scans), np.repeat(np.arange(len(scans)), [*map(len, scans)])
        self.poses, self.last, self.cell_m = poses, poses[-1], cell_m
        self.offset_rad, self.steps = 0.0, 0

    def step(self) -> Adjustment | None:
        """One step; what is found after the last one, with an infinite σ where there are no planes."""
        n, size = len(self.points), 6 * len(self.poses) + 1
        beside, normals, residual, plane = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, np.int32)
        lifted = raised(self.points, self.offset_rad)
        count = planes(lifted, self.number, self.poses, self.cell_m, beside, residual, plane, normals)
        if not count:
            return Adjustment(self.poses, 0.0, math.inf)
        scale_m = max(_KERNEL * float(np.median(np.abs(residual[plane >= 0]))), 1e-6)
        H, of_planes = np.zeros((size + 1, size + 1)), (plane, beside, residual, normals[:count])
        variance, gain = plane_equations(lifted, self.number, *of_planes, self.poses, scale_m, H)
        H, b = H[:-1, :-1], H[:-1, -1]
        inverse = np.linalg.inv(H + _RIDGE * np.trace(H) / size * np.eye(size))
        step = -gain * inverse @ b
        self.offset_rad += float(step[-1])
        twists = step[:-1].reshape(-1, 6)
        self.poses = self.poses @ lie.exp(twists)
        self.steps += 1
        has_converged = abs(step[-1]) < _STEP_RAD and np.abs(twists[:, 3:]).max() < _TURN_RAD
        if not has_converged and abs(self.offset_rad) <= _LARGEST_RAD and self.steps < _STEPS:
            return None
        poses, sigma_rad = (
            self.last @ lie.between(self.poses[-1], self.poses),
            math.sqrt(variance * inverse[-1, -1]),
        )
        return Adjustment(poses, self.offset_rad, sigma_rad)
