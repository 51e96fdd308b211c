"""Adaptive resolution: voxel sizes that follow the surroundings."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy

import msgspec
import numpy as np

from scanchain.clock import working_s
from scanchain.config import PreprocessConfig
from scanchain.data import Points, Scan
from scanchain.preprocess.sweep import Sweep, sweep_of

_RANGE_VOXELS = 14.0  # least number of voxels of the local map that the median range spans
_DENSE, _SPARSE = 60_000, 40_000  # returns of a scan from which on it is dense, and below which it no longer is
_FINE = math.sqrt(0.5)  # factor on the voxels of dense scans, which fill finer ones with points enough for a plane
_HYSTERESIS = 0.75  # powers of two between the present scale and the target scale, from which on it changes
_STEP = 2.0  # factor by which the voxels of matching shrink or grow from one scan to the next, at most
_MAX_TRIES = 8  # number of times the first scan is downsampled, at most
_AHEAD = 2  # scans that are prepared before they are asked for
_ENOUGH = 0.9  # share of the old size above which a new one is not adopted: the choice of points would flicker


class Resolution:
    """Voxel sizes chosen scan by scan.

    Attributes
    ----------
    scale : 1, ½, ¼ …, factor on all voxel sizes of the configuration: small in narrow places, so
        that the median range spans about _RANGE_VOXELS voxels of the local map, or more; times √½ for dense scans
    match_voxel_m : voxels of the points to match, so that about ``preprocess.match_points`` remain
    """

    def __init__(self, config: PreprocessConfig, voxel_size_m: float) -> None:
        """voxel_size_m : of the local map, at scale 1."""
        self.config = config
        self.voxel_size_m = voxel_size_m
        self.scale = self.octave = 1.0
        self.is_dense = False
        self.match_voxel_m = config.match_voxel_m
        self.tries = _MAX_TRIES
        self.is_fixed = config.min_scale == 1.0 and config.match_voxel_m <= config.map_voxel_m

    def downsampled(self, scan: Scan) -> tuple[Sweep, Sweep]:
        """The scan downsampled for the map, and that once more for matching.

        Its points set the sizes for the next scan; the first scan is downsampled again until they fit.
        """
        sweep = sweep_of(scan, self.config, self.scale)
        is_coarse = self.match_voxel_m <= self.scale * self.config.map_voxel_m
        sparse = sweep if is_coarse else sweep.downsampled(self.match_voxel_m)
        if self.is_fixed or not len(sparse.points):
            return sweep, sparse
        self.tries = 0 if self._fit(sparse.points, len(scan.points)) else self.tries - 1
        return self.downsampled(scan) if self.tries > 0 else (sweep, sparse)

    def _fit(self, points: Points, returns: int) -> bool:
        """Adapt the sizes to the points to match, of so many returns; True if they fitted already."""
        before = self.scale, self.match_voxel_m
        self.octave = self._octave_for(float(np.median(np.linalg.norm(points, axis=1))))
        self.is_dense = returns >= (_SPARSE if self.is_dense else _DENSE)
        self.scale = max(self.octave * (_FINE if self.is_dense else 1.0), self.config.min_scale)
        target_m = self.match_voxel_m * min(
            max(math.sqrt(len(points) / self.config.match_points), 1.0 / _STEP), _STEP
        )
        coarse_m, fine_m = self.octave * self.config.match_voxel_m, self.scale * self.config.map_voxel_m
        target_m = min(max(target_m, fine_m), coarse_m)
        if not _ENOUGH < target_m / self.match_voxel_m < 1.0 / _ENOUGH:
            self.match_voxel_m = target_m
        return before == (self.scale, self.match_voxel_m)

    def _octave_for(self, median_range_m: float) -> float:
        target = math.log2(median_range_m / (_RANGE_VOXELS * self.voxel_size_m))
        if abs(target - math.log2(self.octave)) <= _HYSTERESIS:
            return self.octave
        return min(max(2.0 ** round(target), self.config.min_scale), 1.0)


class Prepared(msgspec.Struct, frozen=True):
    """A scan, downsampled for the map (``sweep``) and for matching (``sparse``), before anything moves it.

    ``after`` holds the sizes for the next scan; ``seconds`` is the time that this one took.
    """

    scan: Scan
    sweep: Sweep
    sparse: Sweep
    after: Resolution
    seconds: float


def prepare(scan: Scan, resolution: Resolution) -> Prepared:
    """A scan, downsampled at a resolution, which stays as it is."""
    started, after = working_s(), resolution if resolution.is_fixed else copy(resolution)
    sweep, sparse = after.downsampled(scan)
    return Prepared(scan, sweep, sparse, after, working_s() - started)


def prepare_ahead(scans: Iterable[Scan], resolution: Resolution) -> Iterator[Prepared]:
    """Scans prepared one after the other, in a thread of its own: none depends on a pose."""

    def following(scan: Scan) -> Prepared:
        nonlocal resolution
        prepared = prepare(scan, resolution)
        resolution = prepared.after
        return prepared

    waiting: deque[Future[Prepared]] = deque()
    with ThreadPoolExecutor(1, thread_name_prefix="scanchain-prepare") as pool:
        for scan in scans:
            waiting.append(pool.submit(following, scan))
            if len(waiting) > _AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
