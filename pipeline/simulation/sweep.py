"""One scan as the lidar takes it: every ray from where the sensor is when it is fired."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import RawPoints
from scanchain.simulation.motion import Motion
from scanchain.simulation.sensors import Rays, Sensor
from scanchain.simulation.solids import Solids


@dataclass(frozen=True, slots=True)
class Sweep:
    """The rays of a scan and what came back: ``ranges_m`` (N,), inf where nothing did."""

    rays: Rays
    ranges_m: NDArray[np.float64]

    @property
    def returned(self) -> NDArray[np.bool_]:
        """(N,) whether a ray came back."""
        return np.isfinite(self.ranges_m)

    def points(self) -> RawPoints:
        """(M, 3) returns in the sensor's frame at their own firing instants."""
        hit = self.returned
        return (self.rays.directions[hit] * self.ranges_m[hit, None]).astype(np.float32)

    def times_s(self) -> NDArray[np.floating]:
        """(M,) firing instants of the returns, seconds after the scan's stamp."""
        return self.rays.instants_ns[self.rays.instant_of_ray[self.returned]] * 1e-9


def take_sweep(
    solids: Solids, motion: Motion, sensor: Sensor, index: int, start_s: float, rng: np.random.Generator
) -> Sweep:
    """Scan number ``index``, begun at ``start_s``: cast, then noise along the rays, losses and limits of range."""
    rays = sensor.rays(index)
    poses = motion.lidar(start_s + rays.instants_ns * 1e-9)
    ranges_m = solids.cast(poses, rays.instant_of_ray, rays.directions, sensor.max_range_m)
    ranges_m += sensor.noise_m * rng.standard_normal(len(ranges_m))
    lost = rng.random(len(ranges_m)) < sensor.dropout
    lost |= (ranges_m < sensor.min_range_m) | (ranges_m > sensor.max_range_m)
    ranges_m[lost] = np.inf
    return Sweep(rays, ranges_m)
