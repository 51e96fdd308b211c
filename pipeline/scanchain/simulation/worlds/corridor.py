"""A corridor of 80 m with bare walls between two lobbies: in its middle the motion along it is unobservable."""

from __future__ import annotations

import numpy as np

from scanchain.simulation.motion import Vehicle, mount
from scanchain.simulation.solids import Scenery, Solids

LENGTH_M = 80.0
SIGHT_M = 20.0  # range limit by dust in the air: neither end can be seen from the middle
STRUCTURE_M = 5.0  # of the corridor at either end that is not bare
_HALF_M, _HEIGHT_M, _WALL_M = 1.5, 2.7, 0.3
_LOBBY_M, _LOBBY_HALF_M = 9.0, 4.5

ROBOT = Vehicle(
    speed_m_s=2.5,
    acceleration_m_s2=0.8,
    lateral_acceleration_m_s2=0.8,
    corner_m=0.7,
    deviation_m=0.08,
    sway_rad=0.004,
    heave_m=0.004,
    radius_m=0.35,
    T_base_lidar=mount(0.1, 0.9),
)

# To the other lobby on the right, round in it, and back.
ROUTE = np.array([
    [-3.0, -0.4], [83.0, -0.4], [84.5, -2.2], [86.5, -2.0], [86.5, 2.0], [84.5, 2.2], [83.0, 0.4],
    [-3.0, 0.4], [-4.5, 2.2], [-6.5, 2.0], [-6.5, -2.0], [-4.5, -2.2],
])  # fmt: skip


def corridor(rng: np.random.Generator) -> Solids:
    """The corridor along x from 0 to 80 m; what stands in the lobbies and at the ends is drawn from ``rng``."""
    scenery = Scenery()
    middle, span = 0.5 * LENGTH_M, LENGTH_M + 2.0 * _LOBBY_M + 2.0
    scenery.box((middle, 0.0), (span, 2.0 * _LOBBY_HALF_M + 2.0), (_HEIGHT_M, _HEIGHT_M + 0.3))
    for side in (-1.0, 1.0):
        y = side * (_HALF_M + 0.5 * _WALL_M)
        scenery.box((middle, y), (LENGTH_M, _WALL_M), (0.0, _HEIGHT_M))
    for end, outwards in ((0.0, -1.0), (LENGTH_M, 1.0)):
        _lobby(scenery, end, outwards)
        _furnish(scenery, end, outwards, rng)
        for place in rng.uniform([0.5, 2.0, 3.5], [1.5, 3.0, STRUCTURE_M - 0.2]):
            size = (rng.uniform(0.1, 0.3), rng.uniform(0.05, 0.2))
            for side in (-1.0, 1.0):
                center = (float(end - outwards * place), side * (_HALF_M - 0.5 * size[1]))
                scenery.box(center, size, (0.0, _HEIGHT_M))
    return scenery.finish()


def _lobby(scenery: Scenery, end: float, outwards: float) -> None:
    """The walls of a lobby; the corridor opens in the middle of the one at x = ``end``."""
    far = end + outwards * (_LOBBY_M + 0.5 * _WALL_M)
    scenery.box((far, 0.0), (_WALL_M, 2.0 * _LOBBY_HALF_M + 2.0 * _WALL_M), (0.0, _HEIGHT_M))
    for side in (-1.0, 1.0):
        y = side * (_LOBBY_HALF_M + 0.5 * _WALL_M)
        scenery.box((end + outwards * 0.5 * _LOBBY_M, y), (_LOBBY_M, _WALL_M), (0.0, _HEIGHT_M))
        width = _LOBBY_HALF_M - _HALF_M
        center = (end - outwards * 0.5 * _WALL_M, side * (_HALF_M + 0.5 * width))
        scenery.box(center, (_WALL_M, width), (0.0, _HEIGHT_M))


def _furnish(scenery: Scenery, end: float, outwards: float, rng: np.random.Generator) -> None:
    """Cupboards and benches along the lobby's walls, a plant in two corners."""
    for depth in (1.2, 3.5, 5.8):
        for side in (-1.0, 1.0):
            size = (rng.uniform(0.6, 1.8), rng.uniform(0.3, 0.7))
            x = end + outwards * (depth + rng.uniform(-0.2, 0.2))
            scenery.box((x, side * (_LOBBY_HALF_M - 0.5 * size[1])), size, (0.0, rng.uniform(0.45, 2.1)))
    for y in (-2.5, rng.uniform(-0.5, 0.5), 2.5):
        size = (rng.uniform(0.3, 0.8), rng.uniform(0.5, 1.6))
        x = end + outwards * (_LOBBY_M - 0.5 * size[0])
        scenery.box((x, y + rng.uniform(-0.3, 0.3)), size, (0.0, rng.uniform(0.5, 2.2)))
    for side in (-1.0, 1.0):
        corner = (end + outwards * (_LOBBY_M - 0.4), side * (_LOBBY_HALF_M - 0.4))
        scenery.cylinder(corner, rng.uniform(0.15, 0.25), (0.0, rng.uniform(0.4, 1.8)))
