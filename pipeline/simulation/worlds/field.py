"""A flat field with a few poles far apart; between them nothing tells where one is nor where one heads."""

from __future__ import annotations

import numpy as np

from scanchain.simulation.motion import Vehicle, mount
from scanchain.simulation.solids import Scenery, Solids

SIGHT_M = 60.0  # haze
_LONG_M, _SHORT_M = 440.0, 160.0
_GROUPS = ((30.0, 0.0), (260.0, 0.0), (425.0, 0.0), (300.0, _SHORT_M), (70.0, _SHORT_M))

TRACTOR = Vehicle(
    speed_m_s=10.0,
    acceleration_m_s2=2.0,
    lateral_acceleration_m_s2=3.0,
    corner_m=12.0,
    wander_m=0.4,
    sway_rad=0.008,
    heave_m=0.02,
    radius_m=1.2,
    T_base_lidar=mount(0.8, 1.9),
)

ROUTE = np.array([[0.0, 0.0], [_LONG_M, 0.0], [_LONG_M, _SHORT_M], [0.0, _SHORT_M]])


def field(rng: np.random.Generator) -> Solids:
    """Groups of three poles beside the route, about 230 m apart, and the ground."""
    scenery = Scenery()
    for x, y in _GROUPS:
        for along, side in ((-7.0, 1.0), (0.0, -1.0), (7.0, 1.0)):
            place = (x + along + rng.uniform(-2.0, 2.0), y + side * rng.uniform(6.0, 11.0))
            scenery.cylinder(place, rng.uniform(0.12, 0.22), (0.0, rng.uniform(4.0, 7.0)))
    return scenery.finish()
