"""Noise of a lidar's ranges, measured on its first scans."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain.data import RawPoints

_SCANS, _EVERY = 30, 3  # number of the first scans, of which every third is measured
_PATCHES = 300  # of a scan, evenly spread
_FREEDOM = 4  # points of a patch beyond the parameters of its plane
_WITHIN = 3.0  # a patch is planar up to this many noise variances
_OF_NOISE = (0.4122, 0.8216, 0.9826)  # χ² of 4 degrees of freedom over 4: quintile, median and share below _WITHIN
_PLANAR = 0.5  # least share of planar patches at a range for its noise to be known
_FEWEST = 60  # least number of patches at a range
_CLUTTER = (0.05, 0.1)  # share of the range and meters, above both of which a mode is clutter
_LEAST_M = 1e-4  # smallest standard deviation reported: ranges may be rounded to one number
_VARIES = 2.0  # ratio of the standard deviations at two ranges above which the noise is reported by range
_KNOWN = 0.3  # least share of the patches at ranges whose noise is known
_SECTORS, _SECTOR_POINTS = 16, 8000  # a large first cloud: only parts of 16 sectors are searched for neighbors
_WEDGE = (2000, 75)  # points and patches; later clouds: one wedge each, about another azimuth
_GOLDEN = 0.618034  # share of the cloud's points between the middles of successive wedges


@dataclass(frozen=True, eq=False)
class RangeNoise:
    """Noise of ranges by patches of neighboring beams, as residuals to the plane fitted to each.

    A plane n·p = c seen along unit directions u has ranges with 1/r = (n/c)·u, which is linear in u: the residuals
    of least squares, times r², are those of ranges, whatever the incidence. Patches on edges and clutter have
    larger ones: at each range, the noise is the lowest mode of the variances.

    ranges_m, variances_m2 : (P,) median range and variance of every patch so far
    scans : number of scans so far
    by_range : ranges, a factor of √2 apart, the standard deviation there, and the patches, where known; meters
    sigma_m : standard deviation of a typical range, the geometric mean of all that are known; 0 where few are
    """

    ranges_m: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    variances_m2: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    scans: int = 0
    by_range: tuple[tuple[float, float, int], ...] = ()
    sigma_m: float = 0.0

    def measured(self, points: RawPoints) -> RangeNoise:
        """The noise updated by another scan (N, d), if it is one of the first."""
        if self.scans >= _SCANS:
            return self
        if self.scans % _EVERY:
            return replace(self, scans=self.scans + 1)
        if self.scans and points.shape[1] == 3 and len(points) > _SECTOR_POINTS:
            ranges_m, variances_m2 = _patches(
                _wedge(points, int(_GOLDEN * self.scans % 1.0 * len(points))), _WEDGE[1]
            )
        else:
            ranges_m, variances_m2 = _patches(points, _PATCHES)
        ranges_m = np.concatenate([self.ranges_m, ranges_m])
        variances_m2 = np.concatenate([self.variances_m2, variances_m2])
        by_range = _by_range(ranges_m, variances_m2)
        return RangeNoise(
            ranges_m, variances_m2, self.scans + 1, by_range, _typical_m(by_range, ranges_m, variances_m2)
        )

    @property
    def text(self) -> str:
        """The standard deviation as text, by range if it varies."""
        sigmas_m = [sigma_m for _, sigma_m, _ in self.by_range]
        if not self.sigma_m:
            return "unknown: too few surfaces whose beams lie next to each other"
        if not sigmas_m or max(sigmas_m) < _VARIES * min(sigmas_m):
            return f"{100.0 * self.sigma_m:.2g} cm of a range"
        known = ", ".join(f"{100.0 * sigma_m:.2g} cm at {range_m:.2g} m" for range_m, sigma_m, _ in self.by_range)
        return f"{100.0 * self.sigma_m:.2g} cm of a typical range: {known}"


def _by_range(
    ranges_m: NDArray[np.float64], variances_m2: NDArray[np.float64]
) -> tuple[tuple[float, float, int], ...]:
    half_octaves = np.floor(2.0 * np.log2(ranges_m))
    found = []
    for each in np.unique(half_octaves):
        chosen, range_m = variances_m2[half_octaves == each], 2.0 ** (0.5 * (each + 0.5))
        if sigma_m := _sigma_m(chosen, range_m):
            found.append((float(range_m), sigma_m, len(chosen)))
    return tuple(found)


def _typical_m(
    by_range: tuple[tuple[float, float, int], ...],
    ranges_m: NDArray[np.float64],
    variances_m2: NDArray[np.float64],
) -> float:
    _, sigmas_m, counts = np.array(by_range).reshape(-1, 3).T
    if counts.sum() > _KNOWN * len(ranges_m):
        return float(np.exp(np.average(np.log(sigmas_m), weights=counts)))
    return _sigma_m(variances_m2, float(np.median(ranges_m))) if len(ranges_m) else 0.0


def _wedge(points: RawPoints, middle: int) -> RawPoints:
    """Points of a cloud (N, 3) in a wedge about the azimuth of one, of as many points as wanted without gaps."""
    x, y = points[:, 0], points[:, 1]
    across = np.abs(x[middle] * y - y[middle] * x)
    return points[across < math.tan(math.pi * _WEDGE[0] / len(points)) * (x[middle] * x + y[middle] * y)]


def _patches(points: RawPoints, most: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Median range and variance of ranges (P,) of at most ``most`` patches of a scan (N, d)."""
    d = points.shape[1]
    size = d + _FREEDOM
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    if (share := _SECTOR_POINTS / max(len(points), 1)) < 1.0:
        sector = azimuth * (_SECTORS / (2.0 * math.pi))
        chosen = sector - np.floor(sector) < share
        points, azimuth = points[chosen], azimuth[chosen]
    rays = points.astype(np.float64)
    ranges_m = np.linalg.norm(rays, axis=1)
    is_used = ranges_m > 0.05
    rays, ranges_m, azimuth = rays[is_used], ranges_m[is_used], azimuth[is_used]
    count = len(rays)
    if count < size:
        return np.empty(0), np.empty(0)
    directions = rays / ranges_m[:, None]
    centers = np.linspace(0, count - 1, min(count, most)).astype(np.int64)
    if d == 2:
        order = np.argsort(azimuth, kind="stable")
        patches = order[(centers[:, None] + np.arange(size)) % count]
    else:
        patches = KDTree(directions).query(directions[centers], size)[1]
    of_patch_m = ranges_m[patches]
    median_m = np.median(of_patch_m, axis=1)
    weight = (of_patch_m / median_m[:, None]) ** 2  # of 1/r, whose errors are then those of ranges over r²
    q, _ = np.linalg.qr(directions[patches] * weight[..., None])
    y = weight / of_patch_m
    residual = y - (q @ (np.swapaxes(q, 1, 2) @ y[..., None]))[..., 0]
    return median_m, median_m**4 * (residual**2).sum(axis=1) / _FREEDOM


def _sigma_m(variances: NDArray[np.float64], range_m: float) -> float:
    """Standard deviation of the lowest mode of variances (P,) at that range; 0 where it is unknown."""
    if len(variances) < _FEWEST:
        return 0.0
    variances, (quintile, median, share_within) = np.sort(variances), _OF_NOISE
    variance = float(variances[len(variances) // 5]) / quintile
    for _ in range(30):
        before, count = variance, int(np.searchsorted(variances, _WITHIN * variance, side="right"))
        if count:
            variance = 0.5 * float(variances[(count - 1) // 2] + variances[count // 2]) / median
        if abs(variance - before) <= 1e-3 * before:
            break
    planar = np.searchsorted(variances, _WITHIN * variance, side="right") / len(variances) / share_within
    sigma_m = math.sqrt(variance)
    is_clutter = planar < _PLANAR or sigma_m > max(_CLUTTER[0] * range_m, _CLUTTER[1])
    return 0.0 if is_clutter else max(sigma_m, _LEAST_M)
