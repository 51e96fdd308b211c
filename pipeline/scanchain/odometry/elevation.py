"""Elevation offset: a constant error of a lidar's vertical angles, found by adjusting its own scans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scanchain import lie
from scanchain.data import Matrix, Points, Pose, Vector
from scanchain.kernels.registration.plane_adjustment import plane_equations, planes
from scanchain.kernels.scans import raise_elevation
from scanchain.preprocess import RANGE_VOXELS, Sweep
from scanchain.registration.search import evenly

_WINDOWS = ((14, 0.6), (16, 0.9))  # scans adjusted together, and their spacing in cells: the first time, later
_SMALLEST_M = 0.125  # smallest cell
POINTS = 3500  # largest number of points of each scan, evenly spread
_STEPS, _STEP_RAD, _TURN_RAD = 8, 1e-4, 1e-3  # most Gauss-Newton steps; offset and turns of a converged one
_RIDGE = 1e-6  # regularizes directions that no plane constrains
_SCATTER_RAD = math.radians(0.02)  # prior standard deviation of a window's offset in addition to its own σ
_SHARED_RAD = math.radians(0.01)  # the part of it that is added to every window's σ for its weight
_LEAST_RAD, _SIGMAS = math.radians(0.03), 4.0  # smallest offset that is corrected, and its least significance
_LARGEST_RAD = math.radians(1.0)  # largest offset that is accepted


class Adjustment(NamedTuple):
    """Scans adjusted together: their poses (K, 4, 4), the last one unchanged, and the offset with its σ."""

    poses: Matrix
    offset_rad: float
    sigma_rad: float


class ElevationCalibration:
    """The elevation offset of a lidar, re-estimated as it moves, at growing intervals.

    Ground seen from afar lies too high or too low by the offset times the distance, and a map of such points
    pitches every scan that is aligned to it: an offset of 0.2°, as in KITTI, by 0.01° per meter.

    offset_rad : correction of the points: the mean of the windows where it is significant, else 0
    sigma_rad : standard deviation of that mean, from the scatter of the windows; infinite before the first one
    """

    def __init__(self, *, is_wanted: bool) -> None:
        self.is_wanted = is_wanted
        self.offset_rad, self.sigma_rad = 0.0, math.inf
        self.cell_m = 1.0
        self.windows = 0
        self.estimates: list[tuple[float, float]] = []  # offset and σ of each window
        self.reset()

    def corrected(self, sweep: Sweep) -> Sweep:
        """The sweep with the points of its own lidar raised by the offset."""
        if not self.offset_rad:
            return sweep
        points = raised(sweep.points[: sweep.own], self.offset_rad)
        if sweep.own < len(sweep.points):
            points = np.concatenate([points, sweep.points[sweep.own :]])
        return replace(sweep, points=points)

    def reset(self) -> None:
        """Discard the collected scans: the next pose is not connected to theirs."""
        self.T_odom_last: Pose | None = None
        self.left_out = 0
        self.collected: list[tuple[Points, Pose]] = []
        self.adjusting: Adjusting | None = None  # of the collected scans, one step per scan
        self.since: list[tuple[Points, Pose]] = []  # the scans since they were collected

    def update(self, points: Points, T_odom_lidar: Pose) -> list[tuple[Points, Pose]]:
        """Add a scan; returns corrected scans where a window changed the offset significantly, else none.

        These are the window's scans with their adjusted poses, the last one unchanged, and the scans since.
        After n windows, n scans are skipped.

        points : (N, 3) of the map, deskewed and corrected
        """
        if self.adjusting is not None:
            self.since.append((points, T_odom_lidar))
            found = self.adjusting.step()
            return self._adopt(found) if found is not None else []
        if not self.is_wanted:
            return []
        scans, spacing = _WINDOWS[self.windows > 0]
        spacing_m = spacing * self.cell_m
        if self.T_odom_last is not None and lie.apart(self.T_odom_last, T_odom_lidar)[0] < spacing_m:
            return []
        self.T_odom_last = T_odom_lidar
        if self.left_out < self.windows:
            self.left_out += 1
            return []
        if not self.collected:
            self.cell_m = cell_of(points)
        self.collected.append((points, T_odom_lidar))
        if len(self.collected) == scans:
            clouds, poses = zip(*self.collected, strict=True)
            few = [evenly(cloud, POINTS) for cloud in clouds]
            self.adjusting = Adjusting(few, np.array(poses), self.cell_m)
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
    """Weighted mean of the windows (n, 2), each an offset and its σ, and its standard deviation.

    Windows scatter by more than their own σ, since the scans of one share distortions. The standard deviation
    includes the observed scatter, with the prior _SCATTER_RAD counted as that of one more window.
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


def cell_of(points: Points) -> float:
    """Edge in m of the cells that are searched for planes: small in narrow surroundings.

    points : (N, 3) of a scan
    """
    range_m = float(np.median(np.linalg.norm(points, axis=1)))
    return min(max(2.0 ** round(math.log2(range_m / RANGE_VOXELS)), _SMALLEST_M), 1.0)


def kernel_scale(residual: Vector) -> float:
    """Scale in m of the robust weight of residuals (N,): 1.5 of their standard deviations by the median."""
    return max(1.5 / 0.6745 * float(np.median(np.abs(residual))), 1e-6)


class Adjusting:
    """Plane adjustment of poses and elevation offset: makes planes in several scans (N, 3) as thin as possible.

    Gauss-Newton over all poses and the offset δ: with p(δ) the raised point of scan k, the
    residuals are the distances of T_k p(δ) from planes, estimated too, of the grid cells whose points, from at
    least three scans, are flat (Liu and Zhang 2021). The ground may have any shape.
    """

    def __init__(self, scans: Sequence[Points], poses: Matrix, cell_m: float) -> None:
        self.points, self.number = np.concatenate(scans), np.repeat(np.arange(len(scans)), [*map(len, scans)])
        self.poses, self.last, self.cell_m = poses, poses[-1], cell_m
        self.offset_rad, self.steps = 0.0, 0

    def step(self) -> Adjustment | None:
        """Run one step; the result after the last one, else None; its σ is infinite where there are no planes."""
        n, size = len(self.points), 6 * len(self.poses) + 1
        offset, normals, residual, plane = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, np.int32)
        lifted = raised(self.points, self.offset_rad)
        count = planes(lifted, self.number, self.poses, self.cell_m, offset, residual, plane, normals)
        if not count:
            return Adjustment(self.poses, 0.0, math.inf)
        scale_m = kernel_scale(residual[plane >= 0])
        H, of_planes = np.zeros((size + 1, size + 1)), (plane, offset, residual, normals[:count])
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
        poses = self.last @ lie.between(self.poses[-1], self.poses)
        sigma_rad = math.sqrt(variance * inverse[-1, -1])
        return Adjustment(poses, self.offset_rad, sigma_rad)
