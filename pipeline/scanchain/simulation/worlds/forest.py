"""A forest: trunks, crowns, shrubs, boulders and fallen logs on rough ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.simulation.motion import Vehicle, mount
from scanchain.simulation.routes import sampled
from scanchain.simulation.solids import Scenery, Solids
from scanchain.simulation.worlds.outdoors import BELOW_M

_SPACING_M, _BEYOND_M = 4.6, 45.0  # between trunks; how far the forest goes on beyond the route
_FREE_M = 1.6  # kept free beside the route
_WAVES = 4

MULE = Vehicle(
    speed_m_s=2.5,
    acceleration_m_s2=1.0,
    lateral_acceleration_m_s2=1.2,
    corner_m=2.5,
    deviation_m=0.25,
    sway_rad=0.025,
    heave_m=0.03,
    radius_m=0.6,
    T_base_lidar=mount(0.3, 1.1),
    swing_rad=0.02,
)

ROUTE = np.array([
    [0.0, 0.0], [16.0, 3.0], [26.0, -6.0], [40.0, 0.0], [44.0, 14.0], [32.0, 22.0], [34.0, 34.0], [16.0, 36.0],
    [10.0, 22.0], [-6.0, 20.0], [-10.0, 6.0],
])  # fmt: skip


def forest(rng: np.random.Generator) -> Solids:
    """The forest: a tree somewhere in every square of 4.6 m that is free of the route."""
    scenery = Scenery(_relief(rng))
    low, high = ROUTE.min(axis=0) - _BEYOND_M, ROUTE.max(axis=0) + _BEYOND_M
    route = sampled(ROUTE, 0.2)
    for x in np.arange(low[0], high[0], _SPACING_M):
        for y in np.arange(low[1], high[1], _SPACING_M):
            place = np.array([x, y]) + rng.uniform(0.0, _SPACING_M, 2)
            off_route = float(np.linalg.norm(route - place, axis=1).min()) - _FREE_M
            if off_route > 0.4:
                _tree(scenery, place, rng)
            undergrowth = place + rng.uniform(-2.0, 2.0, 2)
            room = float(np.linalg.norm(route - undergrowth, axis=1).min()) - _FREE_M
            if room > 0.6 and rng.random() < 0.35:
                _undergrowth(scenery, undergrowth, room, rng)
    return scenery.finish()


def _relief(rng: np.random.Generator) -> NDArray[np.float64]:
    """Hills of 0.8 m and on them waves 4 to 12 m long, at most 9 cm high each."""
    phase_x, phase_y = rng.uniform(0.0, 2.0 * np.pi, 2)
    hills = [0.0, 0.8, 2.0 * np.pi / 60.0, phase_x, 0.6, 2.0 * np.pi / 45.0, phase_y]
    length_m = np.geomspace(4.0, 12.0, _WAVES)
    heading = np.pi * (np.arange(_WAVES) * 0.382 + rng.uniform(0.0, 1.0, _WAVES) / _WAVES)
    wave = 2.0 * np.pi / length_m
    phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    rows = np.column_stack([0.0075 * length_m, wave * np.cos(heading), wave * np.sin(heading), phase])
    return np.concatenate([hills, rows.ravel()])


def _tree(scenery: Scenery, place: NDArray[np.float64], rng: np.random.Generator) -> None:
    """A trunk on its root collar and a crown of two blobs, high up."""
    x, y = place.tolist()
    radius, height = rng.uniform(0.09, 0.32), rng.uniform(6.0, 12.0)
    scenery.cylinder((x, y), radius, (BELOW_M, height))
    scenery.ellipsoid((x, y, 0.0), (1.7 * radius, 1.7 * radius, rng.uniform(0.2, 0.5)))
    size = rng.uniform(1.2, 2.6)
    scenery.ellipsoid((x, y, height), (size, size, rng.uniform(0.8, 1.5) * size))
    dx, dy = rng.normal(0.0, 0.6, 2).tolist()
    scenery.ellipsoid((x + dx, y + dy, height - size), (0.7 * size, 0.8 * size, 0.6 * size))


def _undergrowth(scenery: Scenery, place: NDArray[np.float64], room: float, rng: np.random.Generator) -> None:
    """A shrub, a boulder or a fallen log, no farther out than the free ``room``."""
    x, y = place.tolist()
    kind, size = rng.random(), min(rng.uniform(0.3, 0.9), room)
    if kind < 0.5:
        scenery.ellipsoid((x, y, 0.5 * size), (size, rng.uniform(0.6, 1.0) * size, rng.uniform(0.7, 1.4) * size))
    elif kind < 0.8:
        scenery.ellipsoid((x, y, 0.1), (size, rng.uniform(0.5, 1.0) * size, 0.6 * size))
    else:
        length, thickness = min(rng.uniform(1.5, 5.0), 1.9 * room), rng.uniform(0.2, 0.45)
        scenery.box((x, y), (length, thickness), (-0.3, thickness), rng.uniform(0.0, np.pi))
