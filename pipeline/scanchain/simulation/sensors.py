"""Simulated lidars: the rays and firing times of each sensor, and the scans they take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix, RawPoints
from scanchain.simulation.motion import Motion
from scanchain.simulation.solids import Solids


@dataclass(frozen=True, slots=True)
class Rays:
    """The rays of one scan, in the order they are fired.

    directions : (N, 3) unit vectors, sensor frame
    instants_ns : (P,) int64, the firing instants after the scan's stamp, starting at 0
    instant_of_ray : (N,) int32
    ring : (N,) uint16, 0 is the lowest; all 0 where there are no rings
    """

    directions: Matrix
    instants_ns: NDArray[np.int64]
    instant_of_ray: NDArray[np.int32]
    ring: NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Sensor:
    """A lidar: ``dimension`` 2 gives LaserScan, 3 PointCloud2; ``rays`` of the scan with a given index.

    ``noise_m`` is the standard deviation of a range, ``dropout`` the share of returns that are lost.
    """

    dimension: int
    period_ns: int
    min_range_m: float
    max_range_m: float
    noise_m: float
    dropout: float
    rays: Callable[[int], Rays]


def _fired(azimuth: NDArray[np.float64], elevation: NDArray[np.float64], spacing_ns: float, columns: int) -> Rays:
    """Rays (N,) of columns that are fired one after the other, those of a column together, the lowest first."""
    level, rings = np.cos(elevation), len(azimuth) // columns
    return Rays(
        directions=np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1),
        instants_ns=np.rint(np.arange(columns) * spacing_ns).astype(np.int64),
        instant_of_ray=np.repeat(np.arange(columns, dtype=np.int32), rings),
        ring=np.tile(np.arange(rings, dtype=np.uint16), columns),
    )


def _planar(beams: int, step_deg: float, period_ns: int) -> Callable[[int], Rays]:
    """One ring that turns counter-clockwise, centered ahead; its blind sector is behind."""
    azimuth = np.deg2rad(step_deg) * (np.arange(beams) - 0.5 * (beams - 1))
    rays = _fired(azimuth, np.zeros(beams), period_ns * step_deg / 360.0, beams)
    return lambda index: rays


def spinning(elevations_deg: NDArray[np.float64], columns: int, period_ns: int) -> Callable[[int], Rays]:
    """Rings that turn clockwise from straight behind; the rays of a column are fired together."""
    azimuth = np.repeat(np.pi - 2.0 * np.pi * np.arange(columns) / columns, len(elevations_deg))
    rays = _fired(azimuth, np.tile(np.deg2rad(elevations_deg), columns), period_ns / columns, columns)
    return lambda index: rays


def _rosette(count: int, period_ns: int) -> Callable[[int], Rays]:
    """Two counter-rotating wedge prisms scan a rosette that never repeats: the directions differ in every scan.

    Half the field of view is 19.2°; the prisms turn at 7294 and −4664 rpm (Livox Mid-40: Brazeal et al. 2021).
    """

    def rays(index: int) -> Rays:
        times_s = (index * period_ns + np.rint(np.arange(count) * (period_ns / count))) * 1e-9
        first, second = (2.0 * np.pi * rpm / 60.0 * times_s for rpm in (7294.0, -4664.0))
        sideways = 0.5 * np.deg2rad(19.2) * (np.cos(first) + np.cos(second))
        upwards = 0.5 * np.deg2rad(19.2) * (np.sin(first) + np.sin(second))
        return _fired(sideways, upwards, period_ns / count, count)

    return rays


_TENTH_S = 100_000_000  # ns, the period of a lidar at 10 Hz
_HDL64_DEG = np.concatenate([np.linspace(-24.33, -8.83, 32), np.linspace(-8.33, 2.0, 32)])

SENSORS: dict[str, Sensor] = {
    "lms-270": Sensor(2, _TENTH_S, 0.1, 30.0, 0.01, 0.01, _planar(541, 0.5, _TENTH_S)),
    "utm-30": Sensor(2, 25_000_000, 0.1, 30.0, 0.01, 0.01, _planar(1081, 0.25, 25_000_000)),
    "hdl-64": Sensor(3, _TENTH_S, 1.0, 100.0, 0.02, 0.02, spinning(_HDL64_DEG, 2000, _TENTH_S)),
    "os1-32": Sensor(3, _TENTH_S, 0.5, 100.0, 0.02, 0.02, spinning(np.linspace(-22.5, 22.5, 32), 1024, _TENTH_S)),
    "vlp-16": Sensor(3, _TENTH_S, 0.5, 100.0, 0.03, 0.02, spinning(np.linspace(-15.0, 15.0, 16), 1800, _TENTH_S)),
    "rosette": Sensor(3, _TENTH_S, 0.5, 100.0, 0.02, 0.02, _rosette(10_000, _TENTH_S)),
}


@dataclass(frozen=True, slots=True)
class Sweep:
    """The rays of a scan and their ranges ``ranges_m`` (N,), inf without a return."""

    rays: Rays
    ranges_m: NDArray[np.float64]

    @property
    def returned(self) -> NDArray[np.bool_]:
        """(N,) True for every ray with a return."""
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
    """Scan number ``index``, started at ``start_s``: rays cast, noise along them, dropouts and range limits."""
    rays = sensor.rays(index)
    poses = motion.lidar(start_s + rays.instants_ns * 1e-9)
    ranges_m = solids.cast(poses, rays.instant_of_ray, rays.directions, sensor.max_range_m)
    ranges_m += sensor.noise_m * rng.standard_normal(len(ranges_m))
    lost = rng.random(len(ranges_m)) < sensor.dropout
    lost |= (ranges_m < sensor.min_range_m) | (ranges_m > sensor.max_range_m)
    ranges_m[lost] = np.inf
    return Sweep(rays, ranges_m)
