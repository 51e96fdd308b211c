"""Three identical corridors of identical rooms: scans do not tell them apart."""

from __future__ import annotations

import numpy as np

from scanchain.data import Matrix
from scanchain.simulation.solids import Scenery, Solids
from scanchain.simulation.worlds.interior import CEILING_M, Wall, build_wall

_ROOMS, _ROOM_M, _DEPTH_M = 8, 5.0, 6.0  # on each side of a corridor, along it and across it
_LENGTH_M = _ROOMS * _ROOM_M
_HALF_M = 1.0  # of a corridor's width
_CORRIDORS_Y_M = (0.0, 14.0, 28.0)  # their middles; rooms lie back to back between them
_WEST_M, _EAST_M = -_HALF_M, _LENGTH_M + _HALF_M  # middles of the two corridors that join them

# Along each corridor and through rooms of each, back through the first one, and round by two rooms to the start.
ROUTE = np.array([
    [7.5, 0.0], [27.5, 0.0], [27.5, -4.0], [32.5, -4.0], [32.5, 0.0], [_EAST_M, 0.0], [_EAST_M, 14.0],
    [22.5, 14.0], [22.5, 10.0], [17.5, 10.0], [17.5, 14.0], [_WEST_M, 14.0], [_WEST_M, 28.0], [7.5, 28.0],
    [7.5, 32.0], [12.5, 32.0], [12.5, 28.0], [_EAST_M, 28.0], [_EAST_M, 0.0], [32.5, 0.0], [32.5, -4.0],
    [27.5, -4.0], [27.5, 0.0], [12.5, 0.0], [12.5, 4.0], [7.5, 4.0],
])  # fmt: skip

# In every room: middle of a piece of furniture, from the room's, and how long, wide and high it is.
_FURNITURE_M = np.array([
    [1.7, 2.4, 1.4, 0.8, 0.74], [1.5, 1.6, 0.45, 0.45, 0.9], [-1.75, 2.65, 1.2, 0.4, 1.9],
    [-2.15, -1.8, 0.4, 1.2, 1.2], [2.15, -2.0, 0.5, 0.6, 2.0],
])  # fmt: skip


def identical(rng: np.random.Generator) -> Solids:
    """The floor; what ``rng`` draws is the same in all rooms."""
    furniture = _FURNITURE_M + rng.uniform(-0.1, 0.1, _FURNITURE_M.shape)
    scenery = Scenery()
    middle = (0.5 * _LENGTH_M, _CORRIDORS_Y_M[1])
    scenery.box(middle, (_LENGTH_M + 6.0, 46.0), (CEILING_M, CEILING_M + 0.2))
    for wall in _walls():
        build_wall(scenery, wall, rng)
    for y in _CORRIDORS_Y_M:
        for side in (-1.0, 1.0):
            for room in range(_ROOMS):
                _furnish(scenery, (room + 0.5) * _ROOM_M, y + side * (_HALF_M + 0.5 * _DEPTH_M), side, furniture)
    return scenery.finish()


def _walls() -> list[Wall]:
    """Every corridor's two sides, the walls between its rooms and behind them, and the two ends of the floor."""
    doors = tuple((room + 0.5) * _ROOM_M for room in range(_ROOMS))
    walls: list[Wall] = []
    for y in _CORRIDORS_Y_M:
        for side in (-1.0, 1.0):
            near, far = y + side * _HALF_M, y + side * (_HALF_M + _DEPTH_M)
            walls.append(Wall(0.0, near, _LENGTH_M, near, doors))
            walls.append(Wall(0.0, far, _LENGTH_M, far))
            for room in range(_ROOMS + 1):
                x = room * _ROOM_M
                walls.append(Wall(x, near, x, far, (0.5 * _DEPTH_M,) if 0 < room < _ROOMS else ()))
    south, north = _CORRIDORS_Y_M[0] - _HALF_M, _CORRIDORS_Y_M[-1] + _HALF_M
    for inner, outer in ((0.0, 2.0 * _WEST_M), (_LENGTH_M, _LENGTH_M + 2.0 * _HALF_M)):
        walls.append(Wall(outer, south, outer, north))
        walls += [Wall(min(inner, outer), y, max(inner, outer), y) for y in (south, north)]
    return walls


def _furnish(scenery: Scenery, x: float, y: float, side: float, furniture: Matrix) -> None:
    """The same furniture in the room around (x, y); rooms on the two sides of a corridor are turned by 180°."""
    yaw_rad = 0.0 if side > 0.0 else np.pi
    for u, v, length, width, height in furniture:
        with scenery.movable():
            scenery.box((x + side * u, y + side * v), (length, width), (0.0, height), yaw_rad)
