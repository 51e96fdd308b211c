"""A cropped and downsampled scan as measured: each point from the lidar's pose at its own instant."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import checks
from scanchain.config import PreprocessConfig
from scanchain.data import Points, Scan
from scanchain.kernels import scans as kernels

_LEAST_SLOTS, _MOST_SLOTS = 1 << 10, 1 << 22  # of a table for downsampling; larger ones are not kept
_GROWTH = 4  # of a table that has no room for all voxels


@dataclass(frozen=True, slots=True)
class Sweep:
    """Points of a scan, one a voxel, with their times.

    Attributes
    ----------
    points : (M, d) float64 meters, each in the lidar frame of its own instant
    times_s : (M,) seconds after the middle of the scan; (0,) where all count as measured at once
    middle_s : seconds from the scan's stamp to its middle
    """

    points: Points
    times_s: NDArray[np.float64]
    middle_s: float

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
        return Sweep(_gather(self.points, chosen), times_s, self.middle_s)

    def from_middle(self, velocity: NDArray[np.float64]) -> Points:
        """The points (M, d) as seen from the lidar in the middle of the scan.

        velocity : (k,) twist per second in the lidar frame, constant through the scan
        Why the middle: an error of the velocity then moves as many points forward as back and leaves the pose
        alone. Seen from the first point it would shift the pose by half of itself, the next velocity by as much
        in the other direction, and so on.
        """
        if not self.is_distorted:
            return self.points
        points = self.points.copy()
        deskew = kernels.deskew_in_plane if points.shape[1] == 2 else kernels.deskew_in_space
        deskew(points, self.times_s, velocity)
        return points


def sweep_of(scan: Scan, config: PreprocessConfig, scale: float = 1.0) -> Sweep:
    """The scan cropped to the range that is used and downsampled, times left out where deskewing is off.

    scale : of the voxels, 1 for ``preprocess.map_voxel_m``
    """
    voxel_m = scale * config.map_voxel_m
    chosen = first_per_voxel(scan.points, voxel_m, config.min_range_m, config.max_range_m)
    points = _gather(scan.points, chosen)
    if not config.deskew or not len(scan.times_s):
        return Sweep(points, np.empty(0), 0.0)
    middle_s = 0.5 * (float(scan.times_s.min()) + float(scan.times_s.max()))
    return Sweep(points, scan.times_s[chosen].astype(np.float64) - middle_s, middle_s)


def downsample(points: Points, voxel_m: float) -> Points:
    """The first point of every voxel."""
    return _gather(points, first_per_voxel(points, voxel_m, 0.0, np.inf))


def first_per_voxel(
    points: NDArray[np.floating], voxel_m: float, min_range_m: float, max_range_m: float
) -> NDArray[np.int32]:
    """Indices (M,) of the first point (N, d) in each voxel, near and far points left out.

    Raises InputError where the voxels are too small for the points.
    """
    checks.within_voxels(points, voxel_m, "points", max_range_m=max_range_m)
    while True:
        table, chosen = _scratch.room(len(points))
        count = kernels.first_per_voxel(points, voxel_m, min_range_m, max_range_m, table, chosen)
        if count >= 0:
            break
        _scratch.resize(_GROWTH * len(table))
    result = chosen[:count].copy()
    if len(_scratch.table) > _MOST_SLOTS:
        _scratch.resize(_LEAST_SLOTS)
    return result


class _Scratch(threading.local):
    """Arrays of each thread, reused, as large as scans with so many voxels need: small ones stay in the cache."""

    def __init__(self) -> None:
        self.resize(_LEAST_SLOTS)

    def resize(self, slots: int) -> None:
        """Make others of this size."""
        self.table, self.chosen = np.empty(slots, np.int64), np.empty(slots // 2, np.int32)

    def room(self, count: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Table and indices to downsample so many points, none larger than they need at most."""
        slots = min(1 << max(2 * count - 1, 1).bit_length(), len(self.table))
        return self.table[:slots], self.chosen[: slots // 2]


_scratch = _Scratch()


def _gather(points: NDArray[np.floating], chosen: NDArray[np.int32]) -> Points:
    out = np.empty((len(chosen), points.shape[1]))
    kernels.gather(points, chosen, out)
    return out
