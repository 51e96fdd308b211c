"""Adaptive resolution: voxel sizes that follow the surroundings."""

from __future__ import annotations

import math

import numpy as np

from scanchain.config import PreprocessConfig
from scanchain.data import Points, Scan
from scanchain.preprocess.sweep import Sweep, sweep_of

_HYSTERESIS = 0.75  # powers of two between the present scale and the target scale, from which on it changes
_STEP = 2.0  # factor by which the voxels of matching shrink or grow from one scan to the next, at most
_LOOKS = 8  # number of times the first scan is downsampled, at most
_ENOUGH = 0.9  # share of the old size above which a new one is not adopted: the choice of points would flicker


class Resolution:
    """Voxel sizes chosen scan by scan.

    Attributes
    ----------
    scale : 1, ½, ¼ …, what all voxel sizes of the configuration are multiplied with: small in narrow places, so
        that the median range spans about ``preprocess.range_voxels`` voxels of the local map, or more
    match_voxel_m : what scans are thinned out with to be matched, so that about ``preprocess.match_points`` remain
    """

    def __init__(self, config: PreprocessConfig, voxel_size_m: float) -> None:
        """voxel_size_m : of the local map, at scale 1."""
        self.config = config
        self.voxel_size_m = voxel_size_m
        self.scale = 1.0
        self.match_voxel_m = config.match_voxel_m
        self.looks = _LOOKS
        self.is_fixed = config.min_scale == 1.0 and config.match_voxel_m <= config.map_voxel_m

    def look(self, scan: Scan) -> tuple[Sweep, Sweep]:
        """The scan downsampled for the map, and that once more for matching.

        What is found decides about the next scan; the first one is looked at again until all fits.
        """
        sweep = sweep_of(scan, self.config, self.scale)
        is_thin = self.match_voxel_m <= self.scale * self.config.map_voxel_m
        sparse = sweep if is_thin else sweep.thinned(self.match_voxel_m)
        if self.is_fixed or not len(sparse.points):
            return sweep, sparse
        self.looks = 0 if self._fit(sparse.points) else self.looks - 1
        return self.look(scan) if self.looks > 0 else (sweep, sparse)

    def _fit(self, points: Points) -> bool:
        """Adapt the sizes to the points to match; True if they fitted already."""
        before = self.scale, self.match_voxel_m
        self.scale = self._scale_for(float(np.median(np.linalg.norm(points, axis=1))))
        wish_m = self.match_voxel_m * min(
            max(math.sqrt(len(points) / self.config.match_points), 1.0 / _STEP), _STEP
        )
        coarse_m, fine_m = self.scale * self.config.match_voxel_m, self.scale * self.config.map_voxel_m
        wish_m = min(max(wish_m, fine_m), coarse_m)
        if not _ENOUGH < wish_m / self.match_voxel_m < 1.0 / _ENOUGH:
            self.match_voxel_m = wish_m
        return before == (self.scale, self.match_voxel_m)

    def _scale_for(self, median_range_m: float) -> float:
        wanted = math.log2(median_range_m / (self.config.range_voxels * self.voxel_size_m))
        if abs(wanted - math.log2(self.scale)) <= _HYSTERESIS:
            return self.scale
        return min(max(2.0 ** round(wanted), self.config.min_scale), 1.0)
