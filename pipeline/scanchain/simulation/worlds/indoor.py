"""Worlds inside of buildings: an office, an identical floor, a corridor, a hall, a garage, a stairwell.

The office has rooms along a corridor that runs in a ring around a core; the identical floor has three corridors of
identical rooms, which are perceptually aliased. The corridor is 80 m long with bare walls between two lobbies: in
its middle the motion along it is unobservable. The hall is large, with few pillars; the garage has two floors and
a ramp; the stairwell has four storys and is walked up and down with a handheld lidar.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from scanchain.data import Matrix
from scanchain.simulation.motion import Vehicle, mount, sampled
from scanchain.simulation.solids import Scenery, Solids


class Room(NamedTuple):
    """A room: inner length along x and width along y, height, and thickness of the walls, meters."""

    length_m: float
    width_m: float
    height_m: float
    wall_m: float


# walls with doorways, and furniture where it fits

_CEILING_M, _WALL_M = 2.8, 0.12  # height of rooms and thickness of their walls, meters
_DOOR_M = 1.0  # width of a doorway, and the distance from it that is kept free for its leaf
_SIZES_M = {  # length and width of its footprint
    "shelf": (1.2, 0.35),
    "desk": (1.6, 1.5),  # with its chair
    "bin": (0.3, 0.3),
    "plant": (0.4, 0.4),
}


class Wall(NamedTuple):
    """A wall with doorways ``doors`` meters along it; leaves open to its left (1), right (−1) or are off (0)."""

    x0: float
    y0: float
    x1: float
    y1: float
    doors: tuple[float, ...] = ()
    leaves: int = 0

    def at(self, along_m: float, left_m: float = 0.0) -> tuple[float, float]:
        """The position ``along_m`` along the wall and ``left_m`` to its left."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return float(self.x0 + c * along_m - s * left_m), float(self.y0 + s * along_m + c * left_m)

    @property
    def length_m(self) -> float:
        """Length from end to end."""
        return float(np.hypot(self.x1 - self.x0, self.y1 - self.y0))

    @property
    def yaw_rad(self) -> float:
        """Direction of the wall."""
        return float(np.arctan2(self.y1 - self.y0, self.x1 - self.x0))


def build_wall(scenery: Scenery, wall: Wall, rng: np.random.Generator) -> None:
    """The segments of a wall between its doorways, lintels, and door leaves, open at 90 to 110 degrees."""
    jambs = (edge for place in wall.doors for edge in (place - 0.5 * _DOOR_M, place + 0.5 * _DOOR_M))
    edges = [0.0, *jambs, wall.length_m]
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        size = (last - first + _WALL_M * (first == 0.0 or last == wall.length_m), _WALL_M)
        scenery.box(wall.at(0.5 * (first + last)), size, (0.0, _CEILING_M), wall.yaw_rad)
    for place in wall.doors:
        scenery.box(wall.at(place), (_DOOR_M, _WALL_M), (2.1, _CEILING_M), wall.yaw_rad)
        if wall.leaves:
            turn_rad = np.deg2rad(rng.uniform(90.0, 110.0))  # 0 is shut, hinged at the far jamb
            half = 0.5 * (_DOOR_M - 0.05)
            along_m, left_m = half * np.array([np.cos(turn_rad), np.sin(turn_rad)])
            middle = wall.at(place + 0.53 * _DOOR_M - along_m, wall.leaves * left_m)
            scenery.box(middle, (2.0 * half, 0.04), (0.01, 2.1), wall.yaw_rad - wall.leaves * turn_rad)


def furnish(scenery: Scenery, rooms: Matrix, route: Matrix, doors: Matrix, rng: np.random.Generator) -> None:
    """Fill rooms at random: shelves along the walls, a desk for every 5 m², bins and a plant.

    A piece that does not fit after a few tries is left out.
    rooms : (R, 4) rectangles between the centerlines of their walls: low x, low y, high x, high y
    route, doors : (N, 2) positions that are kept free
    """
    taken: list[Matrix] = []  # center and half size, (2, 2)
    for room in rooms:
        desks = int(np.prod(room[2:] - room[:2]) / 5.0)
        kinds = [*["shelf"] * 3, *["desk"] * desks, *["bin"] * 2, "plant"]
        for kind in kinds:
            for _ in range(12):
                upright = int(rng.integers(2))
                half = 0.5 * np.array(_SIZES_M[kind])[[upright, 1 - upright]]
                low, high = room[:2] + 0.1 + half, room[2:] - 0.1 - half
                center = rng.uniform(low, high)
                if kind == "shelf":  # its back to a wall
                    axis = 1 - upright
                    center[axis] = (low, high)[int(rng.integers(2))][axis]
                if _is_free(center, half, taken, route, doors):
                    taken.append(np.array([center, half]))
                    x, y = center.tolist()
                    with scenery.movable():
                        _put(scenery, kind, x, y, 0.5 * np.pi * upright, rng)
                    break


def _is_free(center: Matrix, half: Matrix, taken: list[Matrix], route: Matrix, doors: Matrix) -> bool:
    """True if an axis-aligned rectangle overlaps no other one and leaves the route and the doorways free."""
    if any(np.all(np.abs(center - other) < half + other_half + 0.05) for other, other_half in taken):
        return False
    kept_free = ((route, 0.5), (doors, _DOOR_M))
    outside = ((np.maximum(np.abs(places - center) - half, 0.0), limit_m) for places, limit_m in kept_free)
    return all(np.linalg.norm(each, axis=1).min() >= limit_m for each, limit_m in outside)


def _put(scenery: Scenery, kind: str, x: float, y: float, yaw_rad: float, rng: np.random.Generator) -> None:
    match kind:
        case "shelf":
            scenery.box((x, y), _SIZES_M["shelf"], (0.0, rng.uniform(0.8, 2.0)), yaw_rad)
        case "desk":
            _put_desk(scenery, x, y, yaw_rad + np.pi * int(rng.integers(2)), rng)
        case "bin":
            scenery.cylinder((x, y), 0.14, (0.0, 0.35))
        case "plant":
            scenery.cylinder((x, y), 0.18, (0.0, 0.4))
            scenery.ellipsoid((x, y, 0.9), (0.35, 0.35, 0.5))


def _put_desk(scenery: Scenery, x: float, y: float, yaw_rad: float, rng: np.random.Generator) -> None:
    """A table on four legs, drawers beneath it, a chair on its foot in front."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)

    def at(u: float, v: float) -> tuple[float, float]:
        return float(x + c * u - s * v), float(y + s * u + c * v)

    scenery.box(at(0.0, 0.35), (1.6, 0.8), (0.71, 0.74), yaw_rad)
    for u, v in ((-0.76, 0.0), (0.76, 0.0), (-0.76, 0.7), (0.76, 0.7)):
        scenery.box(at(u, v), (0.06, 0.06), (0.0, 0.71), yaw_rad)
    scenery.box(at(0.5, 0.4), (0.42, 0.58), (0.05, 0.65), yaw_rad)
    chair = at(rng.uniform(-0.35, 0.2), rng.uniform(-0.4, -0.1))
    scenery.cylinder(chair, 0.05, (0.0, 0.45))
    scenery.cylinder(chair, 0.24, (0.45, 0.52))


# the office

OFFICE_ROBOT = Vehicle(
    speed_m_s=1.0, acceleration_m_s2=0.5, lateral_acceleration_m_s2=0.5, corner_m=0.6, deviation_m=0.05,
    radius_m=0.25, T_base_lidar=mount(0.15, 0.25),
)  # fmt: skip

# Around the ring through two rooms; then again, across the core, and through two more rooms.
OFFICE_ROUTE = np.array([
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

_ROOMS = np.array([
    [0, 0, 5.6, 4], [5.6, 0, 10.3, 4], [10.3, 0, 15.9, 4], [15.9, 0, 20.4, 4], [20.4, 0, 26, 4], [0, 14, 5.2, 18],
    [5.2, 14, 12.6, 18], [12.6, 14, 20.2, 18], [20.2, 14, 26, 18], [0, 4, 4, 8.7], [0, 8.7, 4, 14],
    [22, 4, 26, 9.4], [22, 9.4, 26, 14], [10.5, 6, 15.2, 12], [15.2, 6, 20, 12],
])  # fmt: skip


def office(rng: np.random.Generator) -> Solids:
    """The floor; walls and doorways are fixed, furniture and door leaves are sampled from ``rng``."""
    scenery = Scenery()
    scenery.box((13.0, 9.0), (27.0, 19.0), (_CEILING_M, _CEILING_M + 0.2))
    for wall in _WALLS:
        build_wall(scenery, wall, rng)
    scenery.box((8.25, 9.0), (2.4, 5.88), (0.0, _CEILING_M))  # lift shaft in the closed part of the core
    _line_corridor(scenery, rng)
    doors = np.array([wall.at(place) for wall in _WALLS for place in wall.doors])
    furnish(scenery, _ROOMS, sampled(OFFICE_ROUTE, 0.05), doors, rng)
    return scenery.finish()


def _line_corridor(scenery: Scenery, rng: np.random.Generator) -> None:
    """Pillars at the corners of the core, cupboards, a copier and plants along the corridor's walls."""
    for x, y in ((6.0, 6.0), (20.0, 6.0), (6.0, 12.0), (20.0, 12.0)):
        scenery.box((x, y), (0.4, 0.4), (0.0, _CEILING_M))
    for x, y, size_x, size_y in (
        (10.6, 4.26, 1.2, 0.4), (16.0, 5.74, 1.6, 0.4), (11.2, 12.26, 0.9, 0.4), (18.9, 12.28, 0.7, 0.45),
        (4.26, 10.2, 0.4, 1.0), (21.74, 9.0, 0.4, 1.6), (7.2, 13.76, 1.5, 0.36), (5.76, 8.4, 0.36, 1.2),
    ):  # fmt: skip
        scenery.box((x, y), (size_x, size_y), (0.0, rng.uniform(0.8, 1.9)))
    for place in ((14.6, 4.28), (4.3, 4.3), (21.7, 13.7), (14.9, 13.72), (5.72, 10.8), (20.26, 7.0)):
        scenery.cylinder(place, rng.uniform(0.12, 0.2), (0.0, 0.9))


# the identical floor

_ROOMS_A_SIDE = 8  # number of rooms on each side of a corridor
_ROOM = Room(5.0, 6.0, _CEILING_M, _WALL_M)
_FLOOR_M = _ROOMS_A_SIDE * _ROOM.length_m
_AISLE_HALF_M = 1.0  # half the width of a corridor
_CORRIDORS_Y_M = np.arange(3) * 2.0 * (_AISLE_HALF_M + _ROOM.width_m)  # middles; rooms lie back to back in between
_WEST_M, _EAST_M = -_AISLE_HALF_M, _FLOOR_M + _AISLE_HALF_M  # middles of the two corridors that join them

# Along each corridor and through rooms of each, back through the first one, and through two rooms to the start.
IDENTICAL_ROUTE = np.array([
    [7.5, 0.0], [27.5, 0.0], [27.5, -4.0], [32.5, -4.0], [32.5, 0.0], [_EAST_M, 0.0], [_EAST_M, 14.0],
    [22.5, 14.0], [22.5, 10.0], [17.5, 10.0], [17.5, 14.0], [_WEST_M, 14.0], [_WEST_M, 28.0], [7.5, 28.0],
    [7.5, 32.0], [12.5, 32.0], [12.5, 28.0], [_EAST_M, 28.0], [_EAST_M, 0.0], [32.5, 0.0], [32.5, -4.0],
    [27.5, -4.0], [27.5, 0.0], [12.5, 0.0], [12.5, 4.0], [7.5, 4.0],
])  # fmt: skip

# In every room: center of a piece of furniture relative to the room's, its length, width and height.
_FURNITURE_M = np.array([
    [1.7, 2.4, 1.4, 0.8, 0.74], [1.5, 1.6, 0.45, 0.45, 0.9], [-1.75, 2.65, 1.2, 0.4, 1.9],
    [-2.15, -1.8, 0.4, 1.2, 1.2], [2.15, -2.0, 0.5, 0.6, 2.0],
])  # fmt: skip


def identical(rng: np.random.Generator) -> Solids:
    """The floor; what is sampled from ``rng`` is the same in all rooms."""
    furniture = _FURNITURE_M + rng.uniform(-0.1, 0.1, _FURNITURE_M.shape)
    scenery = Scenery()
    middle = (0.5 * _FLOOR_M, _CORRIDORS_Y_M[1])
    scenery.box(middle, (_FLOOR_M + 6.0, 46.0), (_CEILING_M, _CEILING_M + 0.2))
    doors = tuple((room + 0.5) * _ROOM.length_m for room in range(_ROOMS_A_SIDE))
    for y, side in product(_CORRIDORS_Y_M, (-1.0, 1.0)):
        near, far = y + side * _AISLE_HALF_M, y + side * (_AISLE_HALF_M + _ROOM.width_m)
        walls = [Wall(0.0, near, _FLOOR_M, near, doors), Wall(0.0, far, _FLOOR_M, far)]
        for room in range(_ROOMS_A_SIDE + 1):
            x, is_between = room * _ROOM.length_m, 0 < room < _ROOMS_A_SIDE
            walls.append(Wall(x, near, x, far, (0.5 * _ROOM.width_m,) if is_between else ()))
        for wall in walls:
            build_wall(scenery, wall, rng)
        for door in doors:  # rooms on the two sides of a corridor are turned by 180°
            for u, v, length, width, height in furniture:
                with scenery.movable():
                    center = (door + side * u, y + side * (_AISLE_HALF_M + 0.5 * _ROOM.width_m) + side * v)
                    scenery.box(center, (length, width), (0.0, height), 0.0 if side > 0.0 else np.pi)
    south, north = _CORRIDORS_Y_M[0] - _AISLE_HALF_M, _CORRIDORS_Y_M[-1] + _AISLE_HALF_M
    for inner, outer in ((0.0, 2.0 * _WEST_M), (_FLOOR_M, _FLOOR_M + 2.0 * _AISLE_HALF_M)):
        ends = [Wall(min(inner, outer), y, max(inner, outer), y) for y in (south, north)]
        for wall in (Wall(outer, south, outer, north), *ends):
            build_wall(scenery, wall, rng)
    return scenery.finish()


# the corridor

CORRIDOR, _LOBBY = Room(80.0, 3.0, 2.7, 0.3), Room(9.0, 9.0, 2.7, 0.3)
CORRIDOR_STRUCTURE_M = 5.0  # length at either end of the corridor where its walls are not bare

CORRIDOR_ROBOT = Vehicle(
    speed_m_s=2.5, acceleration_m_s2=0.8, lateral_acceleration_m_s2=0.8, corner_m=0.7, deviation_m=0.08,
    sway_rad=0.004, heave_m=0.004, radius_m=0.35, T_base_lidar=mount(0.1, 0.9),
)  # fmt: skip

# To the other lobby, keeping right, around in it, and back.
CORRIDOR_ROUTE = np.array([
    [-3.0, -0.4], [83.0, -0.4], [84.5, -2.2], [86.5, -2.0], [86.5, 2.0], [84.5, 2.2], [83.0, 0.4],
    [-3.0, 0.4], [-4.5, 2.2], [-6.5, 2.0], [-6.5, -2.0], [-4.5, -2.2],
])  # fmt: skip


def corridor(rng: np.random.Generator) -> Solids:
    """The corridor along x from 0 to 80 m; what stands in the lobbies and at the ends is sampled from ``rng``."""
    scenery = Scenery()
    length, width, height, wall = CORRIDOR
    middle, span = 0.5 * length, length + 2.0 * _LOBBY.length_m + 2.0
    scenery.box((middle, 0.0), (span, _LOBBY.width_m + 2.0), (height, height + 0.3))
    for side in (-1.0, 1.0):
        scenery.box((middle, side * 0.5 * (width + wall)), (length, wall), (0.0, height))
    for end, outwards in ((0.0, -1.0), (length, 1.0)):
        _lobby(scenery, end, outwards, rng)
        for place in rng.uniform([0.5, 2.0, 3.5], [1.5, 3.0, CORRIDOR_STRUCTURE_M - 0.2]):
            size = (rng.uniform(0.1, 0.3), rng.uniform(0.05, 0.2))
            for side in (-1.0, 1.0):
                center = (float(end - outwards * place), side * 0.5 * (width - size[1]))
                scenery.box(center, size, (0.0, height))
    return scenery.finish()


def _lobby(scenery: Scenery, end: float, outwards: float, rng: np.random.Generator) -> None:
    """A lobby: walls, cupboards and benches along them, a plant in two corners.

    The corridor opens in the middle of the wall at x = ``end``.
    """
    length, width, height, wall = _LOBBY
    scenery.box((end + outwards * (length + 0.5 * wall), 0.0), (wall, width + 2.0 * wall), (0.0, height))
    for side in (-1.0, 1.0):
        scenery.box((end + outwards * 0.5 * length, side * 0.5 * (width + wall)), (length, wall), (0.0, height))
        beside = 0.5 * (width - CORRIDOR.width_m)
        center = (end - outwards * 0.5 * wall, side * 0.5 * (CORRIDOR.width_m + beside))
        scenery.box(center, (wall, beside), (0.0, height))
    for depth in (1.2, 3.5, 5.8):
        for side in (-1.0, 1.0):
            size = (rng.uniform(0.6, 1.8), rng.uniform(0.3, 0.7))
            x = end + outwards * (depth + rng.uniform(-0.2, 0.2))
            scenery.box((x, side * 0.5 * (width - size[1])), size, (0.0, rng.uniform(0.45, 2.1)))
    for y in (-2.5, rng.uniform(-0.5, 0.5), 2.5):
        size = (rng.uniform(0.3, 0.8), rng.uniform(0.5, 1.6))
        x = end + outwards * (length - 0.5 * size[0])
        scenery.box((x, y + rng.uniform(-0.3, 0.3)), size, (0.0, rng.uniform(0.5, 2.2)))
    for side in (-1.0, 1.0):
        corner = (end + outwards * (length - 0.4), side * (0.5 * width - 0.4))
        scenery.cylinder(corner, rng.uniform(0.15, 0.25), (0.0, rng.uniform(0.4, 1.8)))


# the hall

_HALL = Room(60.0, 40.0, 9.0, 0.4)

TRUCK = Vehicle(
    speed_m_s=5.0, acceleration_m_s2=5.0, lateral_acceleration_m_s2=4.0, corner_m=6.5, deviation_m=0.3,
    radius_m=0.7, T_base_lidar=mount(0.4, 1.3), standstill_s=2.0,
)  # fmt: skip

HALL_ROUTE = np.array([[12.0, 9.0], [51.0, 9.0], [51.0, 31.0], [9.0, 31.0], [9.0, 9.0]])


def hall(rng: np.random.Generator) -> Solids:
    """Walls, ceiling, three pillars in a row and four stacks of pallets sampled from ``rng``."""
    scenery = Scenery()
    length, width, height, wall = _HALL
    middle = (0.5 * length, 0.5 * width)
    scenery.box(middle, (length + 2.0, width + 2.0), (height, height + 0.3))
    for side in (0.0, 1.0):
        outside = (2.0 * side - 1.0) * 0.5 * wall
        scenery.box((middle[0], side * width + outside), (length + 2.0 * wall, wall), (0.0, height))
        scenery.box((side * length + outside, middle[1]), (wall, width), (0.0, height))
    for x in (15.0, 30.0, 45.0):
        scenery.box((x, middle[1]), (0.6, 0.6), (0.0, height))
    for x in rng.uniform([3.0, 22.0, 36.0, 54.0], [6.0, 27.0, 40.0, 57.0]):
        y = float(rng.choice([1.0, width - 1.0]))
        scenery.box((float(x), y), (rng.uniform(1.2, 3.6), 1.2), (0.0, rng.uniform(0.6, 2.2)))
    return scenery.finish()


# the garage

_DECK = Room(60.0, 40.0, 3.0, 0.3)  # a story and the slab above it
_RAMP_M, _SLAB_M = (10.0, 46.0, 6.0), 0.4  # foot, head and width of the ramp, depth of the slabs it is made of

GARAGE_CAR = Vehicle(
    speed_m_s=5.0, acceleration_m_s2=2.0, lateral_acceleration_m_s2=3.0, corner_m=3.0, deviation_m=0.2,
    sway_rad=0.004, heave_m=0.01, radius_m=0.9, T_base_lidar=mount(0.8, 1.73), pitches=True,
)  # fmt: skip

# Around the ground floor, up the ramp along its south side, around the upper floor, and down again.
GARAGE_ROUTE = np.array([
    [4.0, 6.0, 0.0], [54.0, 6.0, 0.0], [54.0, 34.0, 0.0], [4.0, 34.0, 0.0], [4.0, -3.0, 0.0], [10.0, -3.0, 0.0],
    [46.0, -3.0, 3.3], [54.0, -3.0, 3.3], [54.0, 34.0, 3.3], [6.0, 34.0, 3.3], [6.0, 6.0, 3.3], [54.0, 6.0, 3.3],
    [54.0, -3.0, 3.3], [46.0, -3.0, 3.3], [10.0, -3.0, 0.0], [4.0, -3.0, 0.0],
])  # fmt: skip


def garage(rng: np.random.Generator) -> Solids:
    """Two floors of pillars and cars, sampled from ``rng``, and a ramp of slabs between them, all behind walls."""
    scenery, (length, width, height, slab), (foot, head, depth) = Scenery(), _DECK, _RAMP_M
    story, middle, ramp = height + slab, 0.5 * length, 0.5 * (foot + head)
    for x, y, along, across, low, top in (
        (middle, 0.5 * width, length, width, height, story),
        (middle, 17.0, length, 46.0, story + height, 2 * story),
        (0.5 * (head + length), -0.5 * depth, length - head, depth, height, story),
        (0.0, 17.0, slab, 46.0, 0.0, 2 * story), (length, 17.0, slab, 46.0, 0.0, 2 * story),
        (middle, -depth, length, slab, 0.0, 2 * story), (middle, width, length, slab, 0.0, 2 * story),
        (ramp, 0.0, head - foot, slab, 0.0, 2 * story),
    ):  # fmt: skip
        scenery.box((x, y), (along, across), (low, top))
    for x in np.arange(foot + 0.5 * _SLAB_M, head, _SLAB_M):
        top = story * (x - foot) / (head - foot)
        scenery.box((x, -0.5 * depth), (_SLAB_M, depth), (top - slab, top))
    for x, y, low in product(np.arange(12.0, 48.0, 9.0), (14.0, 26.0), (0.0, story)):
        x += rng.uniform(-3.0, 3.0)  # else the floors would be perceptually aliased
        scenery.box((x, y), (0.5, 0.5), (low, low + height))
        car = rng.uniform([2.5, -3.0, 1.4], [3.5, 3.0, 2.0])
        scenery.box((x + car[0], y + car[1]), (1.8, 4.5), (low + 0.3, low + car[2]))
    return scenery.finish()


# the stairwell


class Stairs(NamedTuple):
    """Stairs whose flights turn back at each landing.

    flights, steps : numbers of flights, and of steps of each
    tread_m, rise_m : depth and height of a step
    half_m : half the inner width of the stairwell, in which a flight takes one half
    landing_m : depth of a landing along the flights
    """

    flights: int = 8
    steps: int = 10
    tread_m: float = 0.29
    rise_m: float = 0.17
    half_m: float = 1.6
    landing_m: float = 1.7


_STAIRS = Stairs()
_RUN_M, _FLIGHT_M = _STAIRS.steps * _STAIRS.tread_m, _STAIRS.steps * _STAIRS.rise_m
_LANE_M = 0.5 * _STAIRS.half_m  # offset of the middle of a flight
_TOP_M = _STAIRS.flights * _FLIGHT_M
_ROOF_M = _TOP_M + _CEILING_M

WALKER = Vehicle(
    speed_m_s=0.8, acceleration_m_s2=0.8, lateral_acceleration_m_s2=0.5, corner_m=0.3, deviation_m=0.05,
    sway_rad=0.05, heave_m=0.03, radius_m=0.3, T_base_lidar=mount(0.3, 1.4), swing_rad=0.08, swing_m=0.03,
)  # fmt: skip


def _staircase_route() -> Matrix:
    """Up all flights, around on the top landing, down again, and around on the ground; heights of the feet."""
    up = []
    for flight in range(_STAIRS.flights):
        y = -_LANE_M if flight % 2 == 0 else _LANE_M
        first, last = (0.0, _RUN_M) if flight % 2 == 0 else (_RUN_M, 0.0)
        outside = 0.75 if flight % 2 == 0 else -0.75
        low, high = flight * _FLIGHT_M, (flight + 1) * _FLIGHT_M
        up += [[first, y, low], [last, y, high], [last + outside, y, high], [last + outside, -y, high]]
    up = up[:-2]  # on the last landing, ``top`` turns around
    top = [[-0.8, 0.7, _TOP_M], [-0.9, -0.5, _TOP_M], [-0.4, -0.5, _TOP_M], [-0.3, 0.2, _TOP_M]]
    ground = [[-0.8, -0.7, 0.0], [-0.9, 0.5, 0.0], [-0.4, 0.5, 0.0], [-0.3, -0.2, 0.0]]
    return np.array([*ground[1:], *up, *top, *up[::-1], ground[0]])


STAIRCASE_ROUTE = _staircase_route()


def staircase(rng: np.random.Generator) -> Solids:
    """The stairwell: flights along x, landings at either end; doors, radiators and pipes sampled from ``rng``."""
    scenery, middle, length = Scenery(), 0.5 * _RUN_M, _RUN_M + 2.0 * _STAIRS.landing_m
    scenery.box((middle, 0.0), (length + 1.0, 2.0 * _STAIRS.half_m + 1.0), (_ROOF_M, _ROOF_M + 0.2))
    for side in (-1.0, 1.0):
        scenery.box((middle, side * (_STAIRS.half_m + 0.1)), (length + 0.4, 0.2), (0.0, _ROOF_M))
        scenery.box((middle + side * (0.5 * length + 0.1), 0.0), (0.2, 2.0 * _STAIRS.half_m), (0.0, _ROOF_M))
    for flight in range(_STAIRS.flights):
        _flight(scenery, flight)
        far, outwards = (_RUN_M, 1.0) if flight % 2 == 0 else (0.0, -1.0)
        level, center = (flight + 1) * _FLIGHT_M, (far + outwards * 0.5 * _STAIRS.landing_m, 0.0)
        scenery.box(center, (_STAIRS.landing_m, 2.0 * _STAIRS.half_m), (level - 0.2, level))
        _furnish_landing(scenery, level, far + outwards * _STAIRS.landing_m, outwards, rng)
    _furnish_landing(scenery, 0.0, -_STAIRS.landing_m, -1.0, rng)
    for y in (-_STAIRS.half_m + 0.1, _STAIRS.half_m - 0.1):
        scenery.cylinder((-_STAIRS.landing_m + 0.1, y), rng.uniform(0.03, 0.08), (0.0, _ROOF_M))
    return scenery.finish()


def _flight(scenery: Scenery, flight: int) -> None:
    """Steps as slabs one above the other, a railing along the well in the middle."""
    side = -1.0 if flight % 2 == 0 else 1.0
    low, width = flight * _FLIGHT_M, _STAIRS.half_m - 0.1
    for step in range(_STAIRS.steps):
        along = (step + 0.5) * _STAIRS.tread_m
        x, top = (along if side < 0.0 else _RUN_M - along), low + (step + 1) * _STAIRS.rise_m
        scenery.box((x, side * (0.1 + 0.5 * width)), (_STAIRS.tread_m, width), (top - _STAIRS.rise_m - 0.12, top))
        scenery.cylinder((x, side * 0.13), 0.015, (top, top + 0.85))
        scenery.box((x, side * 0.13), (_STAIRS.tread_m, 0.05), (top + 0.85, top + 0.9))


def _furnish_landing(
    scenery: Scenery, level: float, wall: float, outwards: float, rng: np.random.Generator
) -> None:
    """A door frame on a floor, a radiator and a window sill half way up; sometimes an extinguisher."""
    y = rng.uniform(-0.5, 0.5)
    if outwards < 0.0:
        for side in (-0.5, 0.5):
            scenery.box((wall - outwards * 0.04, y + side), (0.08, 0.1), (level, level + 2.1))
        scenery.box((wall - outwards * 0.04, y), (0.08, 1.1), (level + 2.1, level + 2.2))
    else:
        scenery.box((wall - outwards * 0.06, y), (0.12, rng.uniform(0.6, 1.2)), (level + 0.12, level + 0.7))
        scenery.box((wall - outwards * 0.1, y), (0.2, 1.4), (level + 0.95, level + 1.0))
    if rng.random() < 0.6:
        corner = (wall - outwards * 0.12, float(rng.choice([-1.0, 1.0])) * (_STAIRS.half_m - 0.3))
        scenery.cylinder(corner, 0.09, (level + 0.5, level + 1.0))
