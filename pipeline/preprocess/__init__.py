"""A raw scan made ready for matching: cropped, thinned out, freed of the lidar's own motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.config import PreprocessConfig
from pipeline.data import Points, Pose, Scan
from pipeline.kernels import downsample as kernels


def preprocess(scan: Scan, T_previous_current: Pose, interval_s: float, config: PreprocessConfig) -> Points:
    """Points (M, d) float64 of the scan, one a voxel, all as seen from the lidar's pose at the scan's stamp.

    T_previous_current is the motion over ``interval_s`` seconds, taken as constant through this scan; without
    times in the scan, or with deskewing off, the points stay as they are.
    """
    chosen = np.empty(len(scan.points), np.int32)
    count = kernels.first_per_voxel(
        scan.points, config.map_voxel_m, config.min_range_m, config.max_range_m, chosen
    )
    points = _gather(scan.points, chosen[:count])
    if config.deskew and len(scan.times_s) and interval_s > 0.0:
        shares = scan.times_s[chosen[:count]].astype(np.float64) / interval_s
        kernels.deskew(points, shares, lie.log(T_previous_current))
    return points


def downsample(points: Points, voxel_m: float) -> Points:
    """The first point of every voxel."""
    chosen = np.empty(len(points), np.int32)
    count = kernels.first_per_voxel(points, voxel_m, 0.0, np.inf, chosen)
    return _gather(points, chosen[:count])


def _gather(points: NDArray[np.floating], chosen: NDArray[np.int32]) -> Points:
    out = np.empty((len(chosen), points.shape[1]))
    kernels.gather(points, chosen, out)
    return out
