"""A large hall with a flat floor and few pillars."""

from __future__ import annotations

import numpy as np

from scanchain.simulation.motion import Vehicle, mount
from scanchain.simulation.solids import Scenery, Solids

_LENGTH_M, _WIDTH_M, _HEIGHT_M, _WALL_M = 60.0, 40.0, 9.0, 0.4
_PILLARS = ((15.0, 20.0), (30.0, 20.0), (45.0, 20.0))

TRUCK = Vehicle(
    speed_m_s=5.0,
    acceleration_m_s2=5.0,
    lateral_acceleration_m_s2=4.0,
    corner_m=6.5,
    wander_m=0.3,
    sway_rad=0.0,
    heave_m=0.0,
    radius_m=0.7,
    T_base_lidar=mount(0.4, 1.3),
    standstill_s=2.0,
)

ROUTE = np.array([[12.0, 9.0], [51.0, 9.0], [51.0, 31.0], [9.0, 31.0], [9.0, 9.0]])


def hall(rng: np.random.Generator) -> Solids:
    """Walls, ceiling, three pillars in a row and four stacks of pallets drawn from ``rng``."""
    scenery = Scenery()
    middle = (0.5 * _LENGTH_M, 0.5 * _WIDTH_M)
    scenery.box(middle, (_LENGTH_M + 2.0, _WIDTH_M + 2.0), (_HEIGHT_M, _HEIGHT_M + 0.3))
    for side in (0.0, 1.0):
        outside = (2.0 * side - 1.0) * 0.5 * _WALL_M
        scenery.box((middle[0], side * _WIDTH_M + outside), (_LENGTH_M + 2.0 * _WALL_M, _WALL_M), (0.0, _HEIGHT_M))
        scenery.box((side * _LENGTH_M + outside, middle[1]), (_WALL_M, _WIDTH_M), (0.0, _HEIGHT_M))
    for x, y in _PILLARS:
        scenery.box((x, y), (0.6, 0.6), (0.0, _HEIGHT_M))
    for x in rng.uniform([3.0, 22.0, 36.0, 54.0], [6.0, 27.0, 40.0, 57.0]):
        y = float(rng.choice([1.0, _WIDTH_M - 1.0]))
        scenery.box((float(x), y), (rng.uniform(1.2, 3.6), 1.2), (0.0, rng.uniform(0.6, 2.2)))
    return scenery.finish()
