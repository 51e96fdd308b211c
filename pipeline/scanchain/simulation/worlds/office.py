"""An office floor: rooms along a corridor that runs in a ring around a core, with doors and furniture."""

from __future__ import annotations

import numpy as np

from scanchain.simulation.motion import Vehicle
from scanchain.simulation.routes import sampled
from scanchain.simulation.solids import Scenery, Solids
from scanchain.simulation.worlds.interior import CEILING_M, Furnisher, Room, Wall, build_wall

_WIDTH_M, _DEPTH_M = 26.0, 18.0
ROBOT = Vehicle(
    speed_m_s=1.0,
    acceleration_m_s2=0.5,
    lateral_acceleration_m_s2=0.5,
    corner_m=0.6,
    deviation_m=0.05,
    sway_rad=0.0,
    heave_m=0.0,
    radius_m=0.25,
    T_base_lidar=np.array([[1.0, 0, 0, 0.15], [0, 1, 0, 0], [0, 0, 1, 0.25], [0, 0, 0, 1]]),
)

# Round the ring by two rooms; then again, across the core, and by two more rooms.
ROUTE = np.array([
    [5.0, 5.0], [8.0, 5.0], [8.0, 2.0], [13.0, 2.0], [13.0, 5.0], [21.0, 5.0], [21.0, 13.0], [5.0, 13.0],
    [5.0, 5.0], [21.0, 5.0], [21.0, 13.0], [12.7, 13.0], [12.7, 5.0], [21.0, 5.0], [21.0, 13.0], [17.0, 13.0],
    [17.0, 16.0], [9.0, 16.0], [9.0, 13.0], [5.0, 13.0],
])  # fmt: skip


_WALLS = (
    Wall(0, 0, 26, 0), Wall(26, 0, 26, 18), Wall(26, 18, 0, 18), Wall(0, 18, 0, 0),
    Wall(0, 4, 26, 4, (4.5, 8.0, 13.0, 18.2, 21.6), -1), Wall(0, 14, 26, 14, (4.4, 9.0, 17.0, 21.4), 1),
    Wall(4, 4, 4, 14, (2.2, 7.6), 1), Wall(22, 4, 22, 14, (3.0, 6.4), -1),
    Wall(5.6, 0, 5.6, 4), Wall(10.3, 0, 10.3, 4, (2.0,)), Wall(15.9, 0, 15.9, 4), Wall(20.4, 0, 20.4, 4),
    Wall(5.2, 14, 5.2, 18), Wall(12.6, 14, 12.6, 18, (2.0,)), Wall(20.2, 14, 20.2, 18),
    Wall(0, 8.7, 4, 8.7), Wall(22, 9.4, 26, 9.4),
    Wall(6, 6, 20, 6, (6.7, 12.4), 1), Wall(6, 12, 20, 12, (6.7,), -1),
    Wall(6, 6, 6, 12), Wall(20, 6, 20, 12, (1.6,)), Wall(10.5, 6, 10.5, 12), Wall(15.2, 6, 15.2, 12),
)  # fmt: skip

_ROOMS = (
    Room(0, 0, 5.6, 4), Room(5.6, 0, 10.3, 4), Room(10.3, 0, 15.9, 4), Room(15.9, 0, 20.4, 4),
    Room(20.4, 0, 26, 4), Room(0, 14, 5.2, 18), Room(5.2, 14, 12.6, 18), Room(12.6, 14, 20.2, 18),
    Room(20.2, 14, 26, 18), Room(0, 4, 4, 8.7), Room(0, 8.7, 4, 14), Room(22, 4, 26, 9.4), Room(22, 9.4, 26, 14),
    Room(10.5, 6, 15.2, 12), Room(15.2, 6, 20, 12),
)  # fmt: skip


def office(rng: np.random.Generator) -> Solids:
    """The floor; walls and doorways stand where they stand, furniture and door leaves are drawn from ``rng``."""
    scenery = Scenery()
    scenery.box((0.5 * _WIDTH_M, 0.5 * _DEPTH_M), (_WIDTH_M + 1.0, _DEPTH_M + 1.0), (CEILING_M, CEILING_M + 0.2))
    for wall in _WALLS:
        build_wall(scenery, wall, rng)
    scenery.box((8.25, 9.0), (2.4, 5.88), (0.0, CEILING_M))  # lift shaft in the closed part of the core
    _line_corridor(scenery, rng)
    doors = np.array([wall.at(place) for wall in _WALLS for place in wall.doors])
    furnisher = Furnisher(scenery, sampled(ROUTE, 0.05), doors, rng)
    for room in _ROOMS:
        furnisher.furnish(room)
    return scenery.finish()


def _line_corridor(scenery: Scenery, rng: np.random.Generator) -> None:
    """Pillars at the corners of the core, cupboards, a copier and plants along the corridor's walls."""
    for x, y in ((6.0, 6.0), (20.0, 6.0), (6.0, 12.0), (20.0, 12.0)):
        scenery.box((x, y), (0.4, 0.4), (0.0, CEILING_M))
    for x, y, size_x, size_y in (
        (10.6, 4.26, 1.2, 0.4), (16.0, 5.74, 1.6, 0.4), (11.2, 12.26, 0.9, 0.4), (18.9, 12.28, 0.7, 0.45),
        (4.26, 10.2, 0.4, 1.0), (21.74, 9.0, 0.4, 1.6), (7.2, 13.76, 1.5, 0.36), (5.76, 8.4, 0.36, 1.2),
    ):  # fmt: skip
        scenery.box((x, y), (size_x, size_y), (0.0, rng.uniform(0.8, 1.9)))
    for place in ((14.6, 4.28), (4.3, 4.3), (21.7, 13.7), (14.9, 13.72), (5.72, 10.8), (20.26, 7.0)):
        scenery.cylinder(place, rng.uniform(0.12, 0.2), (0.0, 0.9))
