"""A stairwell of four storys, walked up and down with the lidar in the hand."""

from __future__ import annotations

import numpy as np

from scanchain.data import Matrix
from scanchain.simulation.motion import Vehicle, mount
from scanchain.simulation.solids import Scenery, Solids

_FLIGHTS, _STEPS = 8, 10
_TREAD_M, _RISE_M = 0.29, 0.17
_RUN_M, _FLIGHT_M = _STEPS * _TREAD_M, _STEPS * _RISE_M
_LANE_M, _HALF_M, _LANDING_M = 0.8, 1.6, 1.7  # middle of a flight from the axis, half width, depth of a landing
_TOP_M = _FLIGHTS * _FLIGHT_M
_ROOF_M = _TOP_M + 2.8

WALKER = Vehicle(
    speed_m_s=0.8,
    acceleration_m_s2=0.8,
    lateral_acceleration_m_s2=0.5,
    corner_m=0.3,
    deviation_m=0.05,
    sway_rad=0.05,
    heave_m=0.03,
    radius_m=0.3,
    T_base_lidar=mount(0.3, 1.4),
    swing_rad=0.08,
    swing_m=0.03,
)


def _route() -> Matrix:
    """Up all flights, round on the top landing, down again, and round on the ground; heights of the feet."""
    up = []
    for flight in range(_FLIGHTS):
        y = -_LANE_M if flight % 2 == 0 else _LANE_M
        first, last = (0.0, _RUN_M) if flight % 2 == 0 else (_RUN_M, 0.0)
        outside = 0.75 if flight % 2 == 0 else -0.75
        low, high = flight * _FLIGHT_M, (flight + 1) * _FLIGHT_M
        up += [[first, y, low], [last, y, high], [last + outside, y, high], [last + outside, -y, high]]
    up = up[:-2]  # the last landing is turned round on
    top = [[-0.8, 0.7, _TOP_M], [-0.9, -0.5, _TOP_M], [-0.4, -0.5, _TOP_M], [-0.3, 0.2, _TOP_M]]
    ground = [[-0.8, -0.7, 0.0], [-0.9, 0.5, 0.0], [-0.4, 0.5, 0.0], [-0.3, -0.2, 0.0]]
    return np.array([*ground[1:], *up, *top, *up[::-1], ground[0]])


ROUTE = _route()


def staircase(rng: np.random.Generator) -> Solids:
    """The stairwell: flights along x, landings at either end; doors, radiators and pipes drawn from ``rng``."""
    scenery = Scenery()
    _shaft(scenery)
    for flight in range(_FLIGHTS):
        _flight(scenery, flight)
        _landing(scenery, flight, rng)
    _furnish(scenery, 0.0, -_LANDING_M, -1.0, rng)
    for y in (-_HALF_M + 0.1, _HALF_M - 0.1):
        scenery.cylinder((-_LANDING_M + 0.1, y), rng.uniform(0.03, 0.08), (0.0, _ROOF_M))
    return scenery.finish()


def _shaft(scenery: Scenery) -> None:
    """Four walls and a roof."""
    middle, length = 0.5 * _RUN_M, _RUN_M + 2.0 * _LANDING_M
    scenery.box((middle, 0.0), (length + 1.0, 2.0 * _HALF_M + 1.0), (_ROOF_M, _ROOF_M + 0.2))
    for side in (-1.0, 1.0):
        scenery.box((middle, side * (_HALF_M + 0.1)), (length + 0.4, 0.2), (0.0, _ROOF_M))
        scenery.box((middle + side * (0.5 * length + 0.1), 0.0), (0.2, 2.0 * _HALF_M), (0.0, _ROOF_M))


def _flight(scenery: Scenery, flight: int) -> None:
    """Steps as slabs one above the other, a railing along the well in the middle."""
    side = -1.0 if flight % 2 == 0 else 1.0
    low, width = flight * _FLIGHT_M, _HALF_M - 0.1
    for step in range(_STEPS):
        along = (step + 0.5) * _TREAD_M
        x, top = (along if side < 0.0 else _RUN_M - along), low + (step + 1) * _RISE_M
        scenery.box((x, side * (0.1 + 0.5 * width)), (_TREAD_M, width), (top - _RISE_M - 0.12, top))
        scenery.cylinder((x, side * 0.13), 0.015, (top, top + 0.85))
        scenery.box((x, side * 0.13), (_TREAD_M, 0.05), (top + 0.85, top + 0.9))


def _landing(scenery: Scenery, flight: int, rng: np.random.Generator) -> None:
    """The slab at the upper end of a flight and what stands at its wall."""
    far, outwards = (_RUN_M, 1.0) if flight % 2 == 0 else (0.0, -1.0)
    level = (flight + 1) * _FLIGHT_M
    scenery.box((far + outwards * 0.5 * _LANDING_M, 0.0), (_LANDING_M, 2.0 * _HALF_M), (level - 0.2, level))
    _furnish(scenery, level, far + outwards * _LANDING_M, outwards, rng)


def _furnish(scenery: Scenery, level: float, wall: float, outwards: float, rng: np.random.Generator) -> None:
    """A door's frame on a floor, a radiator and a window sill half way; sometimes an extinguisher."""
    y = rng.uniform(-0.5, 0.5)
    if outwards < 0.0:
        for side in (-0.5, 0.5):
            scenery.box((wall - outwards * 0.04, y + side), (0.08, 0.1), (level, level + 2.1))
        scenery.box((wall - outwards * 0.04, y), (0.08, 1.1), (level + 2.1, level + 2.2))
    else:
        scenery.box((wall - outwards * 0.06, y), (0.12, rng.uniform(0.6, 1.2)), (level + 0.12, level + 0.7))
        scenery.box((wall - outwards * 0.1, y), (0.2, 1.4), (level + 0.95, level + 1.0))
    if rng.random() < 0.6:
        corner = (wall - outwards * 0.12, float(rng.choice([-1.0, 1.0])) * (_HALF_M - 0.3))
        scenery.cylinder(corner, 0.09, (level + 0.5, level + 1.0))
