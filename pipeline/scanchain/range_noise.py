"""Noise of a lidar's ranges, measured on its first scans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain.data import RawPoints

_SCANS = 30  # that are measured: the first ones
_PATCHES = 300  # of a scan, evenly spread
_FREEDOM = 4  # points of a patch beyond the parameters of its plane
_MEDIAN_WITHIN, _FIFTH = 0.8216, 0.4122  # χ² of 4 degrees of freedom over 4: median below _WITHIN, first quintile
_WITHIN, _SHARE_WITHIN = 3.0, 0.9826  # variances of a plane's residuals: most that counts as noise, share of those
_PLANAR = 0.5  # least share of the patches at a range that are planar, of a range whose noise is known
_FEWEST = 60  # patches at a range
_NEAREST_M = 0.05
_SECTORS, _SECTOR_POINTS = 16, 8000  # of large clouds only parts of 16 sectors are searched for neighbors


@dataclass(frozen=True)
class RangeNoise:
    """Noise of ranges by patches of neighboring beams, each against the plane through its points.

    A plane n·p = c seen along unit directions u has ranges with 1/r = (n/c)·u, which is linear in u: the residuals
    of least squares, times r², are those of ranges, whatever the incidence. Patches on edges and clutter have
    larger ones: at each range, the noise is the lowest mode of the variances.

    ranges_m, variances_m2 : (P,) median range and variance of every patch so far, of this many scans
    """

    ranges_m: NDArray[np.float64]
    variances_m2: NDArray[np.float64]
    scans: int

    @classmethod
    def none(cls) -> RangeNoise:
        """That of no scan."""
        return cls(np.empty(0), np.empty(0), 0)

    def measured(self, points: RawPoints) -> RangeNoise:
        """With another scan (N, d), as long as it is one of the first."""
        if self.scans >= _SCANS:
            return self
        ranges_m, variances_m2 = _patches(points)
        ranges_m = np.concatenate([self.ranges_m, ranges_m])
        return RangeNoise(ranges_m, np.concatenate([self.variances_m2, variances_m2]), self.scans + 1)

    @cached_property
    def by_range(self) -> tuple[tuple[float, float], ...]:
        """Ranges, a factor of √2 apart, and the standard deviation there, of those where it is known; meters."""
        octave = self._half_octaves
        found = []
        for each in np.unique(octave):
            chosen = self.variances_m2[octave == each]
            sigma_m, planar = _mode(chosen) if len(chosen) >= _FEWEST else (0.0, 0.0)
            if planar >= _PLANAR:
                found.append((2.0 ** (0.5 * (each + 0.5)), sigma_m))
        return tuple(found)

    @cached_property
    def sigma_m(self) -> float:
        """Standard deviation of half of the ranges or more, 0 where it is unknown."""
        if not self.by_range:
            return _mode(self.variances_m2)[0] if len(self.variances_m2) >= _FEWEST else 0.0
        known_m, sigmas_m = np.array(self.by_range).T
        places = np.searchsorted(known_m, 2.0 ** (0.5 * (self._half_octaves + 0.5)), side="right") - 1
        return float(np.median(sigmas_m[np.maximum(places, 0)]))

    @property
    def _half_octaves(self) -> NDArray[np.float64]:
        return np.floor(2.0 * np.log2(self.ranges_m))


def _patches(points: RawPoints) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Median range and variance of ranges (P,) of patches of a scan (N, d)."""
    d = points.shape[1]
    size = d + _FREEDOM
    points = points.astype(np.float64)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    if (share := _SECTOR_POINTS / max(len(points), 1)) < 1.0:
        chosen = (azimuth * (_SECTORS / (2.0 * math.pi))) % 1.0 < share
        points, azimuth = points[chosen], azimuth[chosen]
    ranges_m = np.linalg.norm(points, axis=1)
    is_used = ranges_m > _NEAREST_M
    points, ranges_m, azimuth = points[is_used], ranges_m[is_used], azimuth[is_used]
    if len(points) < size:
        return np.empty(0), np.empty(0)
    directions = points / ranges_m[:, None]
    centers = np.linspace(0, len(points) - 1, min(len(points), _PATCHES)).astype(np.int64)
    if d == 2:
        order = np.argsort(azimuth, kind="stable")
        patches = order[(centers[:, None] + np.arange(size)) % len(points)]
    else:
        patches = KDTree(directions).query(directions[centers], size)[1]
    of_patch_m = ranges_m[patches]
    median_m = np.median(of_patch_m, axis=1)
    weight = (of_patch_m / median_m[:, None]) ** 2  # of 1/r, whose errors are then those of ranges over r²
    q, _ = np.linalg.qr(directions[patches] * weight[..., None])
    y = weight / of_patch_m
    residual = y - (q @ (np.swapaxes(q, 1, 2) @ y[..., None]))[..., 0]
    return median_m, median_m**4 * (residual**2).sum(axis=1) / _FREEDOM


def _mode(variances: NDArray[np.float64]) -> tuple[float, float]:
    """Standard deviation of the lowest mode of variances (P,), and the share of these that belong to it."""
    variance = float(np.quantile(variances, 0.2)) / _FIFTH
    for _ in range(30):
        before, within = variance, variances[variances <= _WITHIN * variance]
        variance = float(np.median(within)) / _MEDIAN_WITHIN if len(within) else variance
        if abs(variance - before) <= 1e-3 * before:
            break
    return math.sqrt(variance), float(np.mean(variances <= _WITHIN * variance)) / _SHARE_WITHIN
