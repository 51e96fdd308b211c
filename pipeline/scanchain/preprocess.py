"""Preprocessing of a raw scan: cropped and downsampled, in voxels adapted to the surroundings, and deskewed."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.clock import working_s
from scanchain.config import PreprocessConfig
from scanchain.data import Matrix, Points, Pose, RaySpan, Scan
from scanchain.kernels import scans as kernels
from scanchain.range_noise import RangeNoise

_SLOTS = (1 << 10, 1 << 22)  # least and most of a table for downsampling that is kept
RANGE_VOXELS = 14.0  # least number of voxels of the local map that the median range spans
_DENSE = (60_000, 40_000)  # returns at which scans become dense, and at which they remain so
_FINE = math.sqrt(0.5)  # factor on the voxels of the map of dense scans, whose points fill finer ones
_HYSTERESIS = 0.75  # distance to the target scale, in powers of two, above which the scale changes
_STEP = 2.0  # factor by which the voxels of matching shrink or grow from one scan to the next, at most
_STRAIGHT_RAD = 0.005  # turn between two poses, whose chord is 0.2 mm off at 50 m
_ENOUGH = 0.9  # share of the old size above which a new one is not adopted: the choice of points would flicker


class Turning(NamedTuple):
    """Measured rotation around the middle of a scan.

    knots_s : (K,) seconds after the middle, ascending, the first below 0 and the last above
    rates : (K−1, r) rad/s between them, in the lidar's own frame; r = 1 in the plane, 3 in space
    """

    knots_s: NDArray[np.float64]
    rates: NDArray[np.float64]

    def poses(self, velocity: NDArray[np.float64]) -> tuple[NDArray[np.float64], Matrix]:
        """Times (P,) and poses (P, d+1, d+1) in the frame of the middle, at a velocity (d,) in the lidar's frame.

        Between two the lidar turns so little that the pose is linear.
        """
        return kernels.poses_along(self.knots_s, self.rates, np.ascontiguousarray(velocity), _STRAIGHT_RAD)


class ScanMotion(NamedTuple):
    """Motion of the lidar during a scan: at a constant twist, or with a measured rotation in place of its own.

    twist : (k,) per second, lidar frame
    turning : the rotation; None where none was measured
    """

    twist: NDArray[np.float64]
    turning: Turning | None = None

    def over(self, seconds: float) -> Pose:
        """Motion (d+1, d+1) from the middle over some seconds."""
        if self.turning is None:
            return lie.exp(seconds * self.twist)
        times_s, poses = self.turning.poses(self.twist[: 2 if len(self.twist) == 3 else 3])
        k = min(max(int(np.searchsorted(times_s, seconds, side="right")) - 1, 0), len(times_s) - 2)
        share = (seconds - times_s[k]) / (times_s[k + 1] - times_s[k])
        return lie.normalize(poses[k] + share * (poses[k + 1] - poses[k]))

    def deskew(self, points: Points, times_s: NDArray[np.float64]) -> None:
        """Move points (N, d), each in the lidar frame of its time (N,), to that of the middle, in place."""
        if self.turning is not None:
            kernels.deskew_along(points, times_s, *self.turning.poses(self.twist[: points.shape[1]]))
            return
        move = kernels.deskew_in_plane if points.shape[1] == 2 else kernels.deskew_in_space
        move(points, times_s, self.twist)


@dataclass(frozen=True, slots=True)
class Sweep:
    """Points of a scan, one per voxel, with their times.

    points : (M, d) float64 meters, each in the lidar frame of its own instant
    times_s : (M,) seconds after the middle of the scan; (0,) where all are taken as simultaneous
    middle_s : seconds from the scan's stamp to its middle
    spans : origins of the rays; () where all start at the origin of the frame
    """

    points: Points
    times_s: NDArray[np.float64]
    middle_s: float
    spans: tuple[RaySpan, ...] = ()

    @property
    def own(self) -> int:
        """Number of points of the scan's own lidar, which are the first ones."""
        return self.spans[0].rays if self.spans else len(self.points)

    @property
    def is_distorted(self) -> bool:
        """True if the points are distorted by the lidar's motion."""
        return len(self.times_s) > 0

    @property
    def duration_s(self) -> float:
        """Seconds from the first point to the last."""
        return float(np.ptp(self.times_s)) if self.is_distorted else 0.0

    def downsampled(self, voxel_m: float) -> Sweep:
        """The first point of every voxel of this size."""
        chosen = first_per_voxel(self.points, voxel_m, 0.0, np.inf)
        times_s = self.times_s[chosen] if self.is_distorted else self.times_s
        spans = RaySpan.among(self.spans, chosen)
        return Sweep(self.points.take(chosen, axis=0), times_s, self.middle_s, spans)

    def from_middle(self, motion: ScanMotion) -> Points:
        """The points (M, d) deskewed to the lidar's pose in the middle of the scan.

        Why the middle: an error of the velocity then moves as many points forward as back, and the pose stays
        right. Relative to the first point it would shift the pose by half of itself, the next velocity by as
        much in the other direction, and so on.
        """
        if not self.is_distorted:
            return self.points
        points = self.points.copy()
        motion.deskew(points, self.times_s)
        return points


def sweep_of(scan: Scan, config: PreprocessConfig, scale: float = 1.0) -> Sweep:
    """The scan cropped to the range that is used and downsampled, times left out where deskewing is off.

    scale : of the voxels, 1 for ``preprocess.map_voxel_m``
    """
    voxel_m = scale * config.map_voxel_m
    raw, times_s = scan.points, scan.times_s if config.deskew else scan.times_s[:0]
    spans: tuple[RaySpan, ...] = ()
    if scan.others or scan.origin is not None:
        origin = np.zeros(raw.shape[1]) if scan.origin is None else scan.origin
        spans = RaySpan(origin, len(raw)), *(RaySpan(each.origin, len(each.points)) for each in scan.others)
    of_middle = times_s
    if scan.others:
        times_s = times_s if len(times_s) else np.zeros(len(raw), np.float32)
        of_middle = np.concatenate([times_s, *(each.times_s for each in scan.others if each.moves_middle)])
        raw = np.concatenate([raw, *(each.points for each in scan.others)])
        times_s = np.concatenate([times_s, *(each.times_s for each in scan.others)])
    chosen = first_per_voxel(raw, voxel_m, config.min_range_m, config.max_range_m)
    if kept := RaySpan.among(spans, chosen):  # of others: not the robot around them
        origins = np.repeat([span.origin for span in kept], [span.rays for span in kept], axis=0)
        chosen = chosen[np.linalg.norm(raw[chosen] - origins, axis=1) >= config.min_range_m]
    points, spans = raw.take(chosen, axis=0).astype(np.float64), RaySpan.among(spans, chosen)
    if not len(times_s):
        return Sweep(points, np.empty(0), 0.0, spans)
    middle_s = 0.5 * (float(of_middle.min()) + float(of_middle.max()))
    return Sweep(points, times_s[chosen].astype(np.float64) - middle_s, middle_s, spans)


def downsample(points: Points, voxel_m: float) -> Points:
    """The first point of every voxel."""
    return points.take(first_per_voxel(points, voxel_m, 0.0, np.inf), axis=0).astype(np.float64, copy=False)


def first_per_voxel(
    points: NDArray[np.floating], voxel_m: float, min_range_m: float, max_range_m: float
) -> NDArray[np.int32]:
    """Indices (M,) of the first point (N, d) in each voxel, near and far points left out.

    Raises InputError where the voxels are too small for the points.
    """
    checks.within_voxels(points, voxel_m, "points", max_range_m=max_range_m)
    table, chosen = _scratch.table, _scratch.chosen
    enough = 1 << max(2 * len(points) - 1, 1).bit_length()
    while True:
        slots = min(len(table), enough)
        room = table[:slots], chosen[: slots // 2]
        count = kernels.first_per_voxel(points, voxel_m, min_range_m, max_range_m, *room)
        if count >= 0:
            return chosen[:count].copy()
        slots *= 4
        table, chosen = np.empty(slots, np.int64), np.empty(slots // 2, np.int32)
        if slots <= _SLOTS[1]:
            _scratch.table, _scratch.chosen = table, chosen


class _Scratch(threading.local):
    """Reused work arrays of each thread, no larger than its scans need: small ones stay in the CPU's cache."""

    def __init__(self) -> None:
        self.table, self.chosen = np.empty(_SLOTS[0], np.int64), np.empty(_SLOTS[0] // 2, np.int32)


_scratch = _Scratch()


class Resolution:
    """Voxel sizes chosen scan by scan.

    octave : 1, ½, ¼ …, factor on all voxel sizes of the configuration: small in narrow places, so
        that the median range spans about RANGE_VOXELS voxels of the local map, or more
    scale : of the local map's voxels: ``octave``, times √½ for dense scans, whose number of points stays the same
    match_voxel_m : voxels of the points to match, so that about ``preprocess.match_points`` remain
    noise : of the ranges, measured on the first scans
    """

    def __init__(self, config: PreprocessConfig, voxel_size_m: float) -> None:
        """voxel_size_m : of the local map, at scale 1."""
        self.config = config
        self.voxel_size_m = voxel_size_m
        self.scale = self.octave = 1.0
        self.is_dense = False
        self.match_voxel_m = config.match_voxel_m
        self.tries = 8  # to downsample the first scan
        self.noise = RangeNoise()
        self.is_fixed = config.min_scale == 1.0 and config.match_voxel_m <= config.map_voxel_m

    def downsampled(self, scan: Scan) -> tuple[Sweep, Sweep]:
        """The scan downsampled for the map, and that once more for matching.

        Its points set the sizes for the next scan; the first scan is downsampled again until they fit.
        """
        sweep = sweep_of(scan, self.config, self.octave)
        is_coarse = self.match_voxel_m <= self.octave * self.config.map_voxel_m
        sparse = sweep if is_coarse else sweep.downsampled(self.match_voxel_m)
        if self.is_fixed or not len(sparse.points):
            return sweep, sparse
        self.tries = 0 if self._fit(sparse.points, len(scan.points)) else self.tries - 1
        return self.downsampled(scan) if self.tries > 0 else (sweep, sparse)

    def _fit(self, points: Points, returns: int) -> bool:
        """Adapt the sizes to the points to match and the number of returns; True if they were right already."""
        before = self.scale, self.match_voxel_m
        median_range_m = float(np.median(np.linalg.norm(points, axis=1)))
        target = math.log2(median_range_m / (RANGE_VOXELS * self.voxel_size_m))
        if abs(target - math.log2(self.octave)) > _HYSTERESIS:
            self.octave = min(max(2.0 ** round(target), self.config.min_scale), 1.0)
        self.is_dense = returns >= _DENSE[self.is_dense]
        self.scale = max(self.octave * (_FINE if self.is_dense else 1.0), self.config.min_scale)
        target_m = self.match_voxel_m * min(
            max(math.sqrt(len(points) / self.config.match_points), 1.0 / _STEP), _STEP
        )
        coarse_m, fine_m = self.octave * self.config.match_voxel_m, self.octave * self.config.map_voxel_m
        target_m = min(max(target_m, fine_m), coarse_m)
        if not _ENOUGH < target_m / self.match_voxel_m < 1.0 / _ENOUGH:
            self.match_voxel_m = target_m
        return before == (self.scale, self.match_voxel_m)


class Prepared(msgspec.Struct, frozen=True):
    """A scan, downsampled for the map (``sweep``) and for matching (``sparse``), not yet deskewed.

    ``after`` holds the sizes for the next scan; ``seconds`` is the time that this one took.
    """

    scan: Scan
    sweep: Sweep
    sparse: Sweep
    after: Resolution
    seconds: float


def prepare(scan: Scan, resolution: Resolution) -> Prepared:
    """A scan, downsampled at a resolution, which is not modified."""
    started, after = working_s(), copy(resolution)
    after.noise = after.noise.measured(scan.points)
    sweep, sparse = after.downsampled(scan)
    return Prepared(scan, sweep, sparse, after, working_s() - started)


def prepare_ahead(scans: Iterable[Scan], resolution: Resolution) -> Iterator[Prepared]:
    """Scans prepared in order, in a separate thread: preparation does not depend on poses."""

    def following(scan: Scan) -> Prepared:
        nonlocal resolution
        prepared = prepare(scan, resolution)
        resolution = prepared.after
        return prepared

    waiting: deque[Future[Prepared]] = deque()
    with ThreadPoolExecutor(1, thread_name_prefix="scanchain-prepare") as pool:
        for scan in scans:
            waiting.append(pool.submit(following, scan))
            if len(waiting) > 2:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
