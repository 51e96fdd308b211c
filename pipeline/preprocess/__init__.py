"""A raw scan made ready for matching: cropped, thinned out, freed of the lidar's own motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.config import PreprocessConfig
from pipeline.data import Points, Pose, Scan
from pipeline.kernels import downsample as kernels


def middle_s(scan: Scan, config: PreprocessConfig) -> float:
    """Seconds from the scan's stamp to the middle of its points; 0 without times or with deskewing off."""
    if not config.deskew or not len(scan.times_s):
        return 0.0
    return 0.5 * (float(scan.times_s.min()) + float(scan.times_s.max()))


def preprocess(scan: Scan, T_previous_current: Pose, interval_s: float, config: PreprocessConfig) -> Points:
    """Points (M, d) float64 of the scan, one a voxel, all as seen from the lidar's pose in the scan's middle.

    T_previous_current is the motion over ``interval_s`` seconds, taken as constant through this scan; without
    times in the scan, or with deskewing off, the points stay as they are.
    Why the middle: an error of the assumed velocity then moves as many points forward as back and leaves the
    pose alone. Seen from the first point it would shift the pose by half of itself, the next velocity by as
    much the other way, and so on for ever.
    """
    chosen = np.empty(len(scan.points), np.int32)
    count = kernels.first_per_voxel(
        scan.points, config.map_voxel_m, config.min_range_m, config.max_range_m, chosen
    )
    points = _gather(scan.points, chosen[:count])
    if config.deskew and len(scan.times_s) and interval_s > 0.0:
        times_s = scan.times_s[chosen[:count]].astype(np.float64)
        kernels.deskew(points, (times_s - middle_s(scan, config)) / interval_s, lie.log(T_previous_current))
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
