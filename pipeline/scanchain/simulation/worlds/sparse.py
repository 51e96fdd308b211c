"""Worlds with few surfaces: a field with poles far apart, a large hall with few pillars, a yard to turn in."""

from __future__ import annotations

import numpy as np

from scanchain.simulation.motion import Vehicle, mount
from scanchain.simulation.routes import Pivot
from scanchain.simulation.solids import Scenery, Solids
from scanchain.simulation.worlds.outdoors import BELOW_M, parked_car, tree

FIELD_SIGHT_M = 60.0  # range limit by haze
_LONG_M, _SHORT_M = 440.0, 160.0
_GROUPS = ((30.0, 0.0), (260.0, 0.0), (425.0, 0.0), (300.0, _SHORT_M), (70.0, _SHORT_M))

TRACTOR = Vehicle(
    speed_m_s=10.0,
    acceleration_m_s2=2.0,
    lateral_acceleration_m_s2=3.0,
    corner_m=12.0,
    deviation_m=0.4,
    sway_rad=0.008,
    heave_m=0.02,
    radius_m=1.2,
    T_base_lidar=mount(0.8, 1.9),
)

FIELD_ROUTE = np.array([[0.0, 0.0], [_LONG_M, 0.0], [_LONG_M, _SHORT_M], [0.0, _SHORT_M]])

_LENGTH_M, _WIDTH_M, _HEIGHT_M, _WALL_M = 60.0, 40.0, 9.0, 0.4
_PILLARS = ((15.0, 20.0), (30.0, 20.0), (45.0, 20.0))

TRUCK = Vehicle(
    speed_m_s=5.0,
    acceleration_m_s2=5.0,
    lateral_acceleration_m_s2=4.0,
    corner_m=6.5,
    deviation_m=0.3,
    sway_rad=0.0,
    heave_m=0.0,
    radius_m=0.7,
    T_base_lidar=mount(0.4, 1.3),
    standstill_s=2.0,
)

HALL_ROUTE = np.array([[12.0, 9.0], [51.0, 9.0], [51.0, 31.0], [9.0, 31.0], [9.0, 9.0]])

_HALF_X_M, _HALF_Y_M = 19.0, 15.0

YARD_ROBOT = Vehicle(
    speed_m_s=1.5,
    acceleration_m_s2=1.5,
    lateral_acceleration_m_s2=1.0,
    corner_m=0.0,
    deviation_m=0.0,
    sway_rad=0.006,
    heave_m=0.004,
    radius_m=0.4,
    T_base_lidar=mount(0.15, 0.9),
)

# A triangle, a square in the other direction, there and back, once round on the spot and once back; it closes.
YARD_STEPS = (
    *[Pivot(120.0, 3.0)] * 3,
    *[Pivot(-90.0, 2.0)] * 4,
    *[Pivot(180.0, 3.5)] * 2,
    Pivot(360.0, 0.0), Pivot(-45.0, 0.0), Pivot(90.0, 0.0), Pivot(-405.0, 0.0),
)  # fmt: skip


def field(rng: np.random.Generator) -> Solids:
    """Groups of three poles beside the route, about 230 m apart, and the ground."""
    scenery = Scenery()
    for x, y in _GROUPS:
        for along, side in ((-7.0, 1.0), (0.0, -1.0), (7.0, 1.0)):
            place = (x + along + rng.uniform(-2.0, 2.0), y + side * rng.uniform(6.0, 11.0))
            scenery.cylinder(place, rng.uniform(0.12, 0.22), (0.0, rng.uniform(4.0, 7.0)))
    return scenery.finish()


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


def yard(rng: np.random.Generator) -> Solids:
    """The yard; walls stand where they stand, everything along them is drawn from ``rng``."""
    phase_x, phase_y = rng.uniform(0.0, 2.0 * np.pi, 2)
    scenery = Scenery(np.array([0.0, 0.1, 2.0 * np.pi / 30.0, phase_x, 0.1, 2.0 * np.pi / 24.0, phase_y]))
    for side in (-1.0, 1.0):
        scenery.box((0.0, side * _HALF_Y_M), (2.0 * _HALF_X_M, 0.3), (BELOW_M, rng.uniform(1.8, 3.0)))
        scenery.box((side * _HALF_X_M, 0.0), (0.3, 2.0 * _HALF_Y_M), (BELOW_M, rng.uniform(1.8, 3.0)))
        for x in np.arange(-15.0, 15.1, 6.0):
            _lean_on(scenery, float(x) + rng.uniform(-1.0, 1.0), side * (_HALF_Y_M - 2.2), rng)
        for y in (-7.0, 0.0, 7.0):
            parked_car(scenery, side * (_HALF_X_M - 3.0), y + rng.uniform(-1.5, 1.5), rng.normal(0.0, 0.1), rng)
        tree(scenery, side * rng.uniform(10.5, 12.0), rng.uniform(-6.0, 6.0), rng)
    for bearing in np.deg2rad(np.arange(0.0, 360.0, 60.0)) + rng.uniform(-0.4, 0.4, 6):
        post = rng.uniform(7.0, 9.5) * np.array([np.cos(bearing), np.sin(bearing)])
        scenery.cylinder(
            (float(post[0]), float(post[1])), rng.uniform(0.05, 0.2), (BELOW_M, rng.uniform(0.8, 3.5))
        )
    return scenery.finish()


def _lean_on(scenery: Scenery, x: float, y: float, rng: np.random.Generator) -> None:
    """Something along a wall: a shed, a container or a pile of crates."""
    kind, yaw = rng.random(), rng.normal(0.0, 0.06)
    if kind < 0.35:
        scenery.box((x, y), (rng.uniform(2.5, 4.0), rng.uniform(2.0, 2.8)), (BELOW_M, rng.uniform(2.2, 3.2)), yaw)
    elif kind < 0.6:
        scenery.box((x, y), (5.0, 2.4), (BELOW_M, 2.6), yaw)
    else:
        for _ in range(4):
            place = (x + rng.uniform(-1.5, 1.5), y + rng.uniform(-0.6, 0.6))
            size = (rng.uniform(0.6, 1.3), rng.uniform(0.6, 1.2))
            scenery.box(place, size, (BELOW_M, rng.uniform(0.4, 1.6)), yaw + rng.uniform(0.0, 1.5))
