"""Interiors: walls with doorways, and furniture put where there is room."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from scanchain.data import Matrix
from scanchain.simulation.solids import Scenery

CEILING_M = 2.8
_WALL_M, _DOOR_M = 0.12, 1.0

_ROUTE_M = 0.5  # distance from the robot's route that is kept free
_DOORWAY_M = 1.0  # distance from a doorway that is kept free
_TRIES = 12
Kind = Literal["shelf", "desk", "bin", "plant"]
_SIZES_M: dict[Kind, tuple[float, float]] = {
    "shelf": (1.2, 0.35),
    "desk": (1.6, 1.5),  # with its chair
    "bin": (0.3, 0.3),
    "plant": (0.4, 0.4),
}


class Wall(NamedTuple):
    """A wall with doorways ``doors`` meters along it; the leaves open to its left (1), right (−1) or are off."""

    x0: float
    y0: float
    x1: float
    y1: float
    doors: tuple[float, ...] = ()
    leaves: int = 0

    def at(self, along_m: float, left_m: float = 0.0) -> tuple[float, float]:
        """The position so far along the wall and to its left."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return float(self.x0 + c * along_m - s * left_m), float(self.y0 + s * along_m + c * left_m)

    @property
    def length_m(self) -> float:
        """From end to end."""
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
        scenery.box(wall.at(0.5 * (first + last)), size, (0.0, CEILING_M), wall.yaw_rad)
    for place in wall.doors:
        scenery.box(wall.at(place), (_DOOR_M, _WALL_M), (2.1, CEILING_M), wall.yaw_rad)
        if wall.leaves:
            turn_rad = np.deg2rad(rng.uniform(90.0, 110.0))  # 0 is shut, hinged at the far jamb
            half = 0.5 * (_DOOR_M - 0.05)
            along_m, left_m = half * np.array([np.cos(turn_rad), np.sin(turn_rad)])
            middle = wall.at(place + 0.53 * _DOOR_M - along_m, wall.leaves * left_m)
            scenery.box(middle, (2.0 * half, 0.04), (0.01, 2.1), wall.yaw_rad - wall.leaves * turn_rad)


class Room(NamedTuple):
    """A rectangle between the middles of its walls, meters."""

    x0: float
    y0: float
    x1: float
    y1: float


class Furnisher:
    """Fills rooms at random; furniture that finds no room after a few tries is left out."""

    def __init__(self, scenery: Scenery, route: Matrix, doors: Matrix, rng: np.random.Generator) -> None:
        self._scenery = scenery
        self._route = route
        self._doors = doors
        self._rng = rng
        self._taken: list[tuple[Matrix, Matrix]] = []  # center and half size

    def furnish(self, room: Room) -> None:
        """Shelves along the walls, a desk for every 5 m², bins and a plant."""
        desks = int((room.x1 - room.x0) * (room.y1 - room.y0) / 5.0)
        wishes: tuple[tuple[Kind, int], ...] = (("shelf", 3), ("desk", desks), ("bin", 2), ("plant", 1))
        for kind, count in wishes:
            for _ in range(count):
                any(self._try(kind, room) for _ in range(_TRIES))

    def _try(self, kind: Kind, room: Room) -> bool:
        """Put one piece of furniture at a random position in the room, unless something overlaps it."""
        upright = int(self._rng.integers(2))
        half = 0.5 * np.array(_SIZES_M[kind])[[upright, 1 - upright]]
        low = np.array([room.x0, room.y0]) + 0.1 + half
        high = np.array([room.x1, room.y1]) - 0.1 - half
        center = self._rng.uniform(low, high)
        if kind == "shelf":  # its back to a wall
            axis = 1 - upright
            center[axis] = (low, high)[int(self._rng.integers(2))][axis]
        if not self._is_free(center, half):
            return False
        self._taken.append((center, half))
        with self._scenery.movable():
            self._put(kind, float(center[0]), float(center[1]), 0.5 * np.pi * upright)
        return True

    def _is_free(self, center: Matrix, half: Matrix) -> bool:
        if any(np.all(np.abs(center - other) < half + other_half + 0.05) for other, other_half in self._taken):
            return False
        free = ((self._route, _ROUTE_M), (self._doors, _DOORWAY_M))
        return all(_distance_m(places, center, half) >= limit for places, limit in free)

    def _put(self, kind: Kind, x: float, y: float, yaw_rad: float) -> None:
        match kind:
            case "shelf":
                self._scenery.box((x, y), _SIZES_M["shelf"], (0.0, self._rng.uniform(0.8, 2.0)), yaw_rad)
            case "desk":
                self._put_desk(x, y, yaw_rad + np.pi * int(self._rng.integers(2)))
            case "bin":
                self._scenery.cylinder((x, y), 0.14, (0.0, 0.35))
            case "plant":
                self._scenery.cylinder((x, y), 0.18, (0.0, 0.4))
                self._scenery.ellipsoid((x, y, 0.9), (0.35, 0.35, 0.5))

    def _put_desk(self, x: float, y: float, yaw_rad: float) -> None:
        """A table on four legs, drawers beneath it, a chair on its foot in front."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)

        def at(u: float, v: float) -> tuple[float, float]:
            return float(x + c * u - s * v), float(y + s * u + c * v)

        self._scenery.box(at(0.0, 0.35), (1.6, 0.8), (0.71, 0.74), yaw_rad)
        for u, v in ((-0.76, 0.0), (0.76, 0.0), (-0.76, 0.7), (0.76, 0.7)):
            self._scenery.box(at(u, v), (0.06, 0.06), (0.0, 0.71), yaw_rad)
        self._scenery.box(at(0.5, 0.4), (0.42, 0.58), (0.05, 0.65), yaw_rad)
        chair = at(self._rng.uniform(-0.35, 0.2), self._rng.uniform(-0.4, -0.1))
        self._scenery.cylinder(chair, 0.05, (0.0, 0.45))
        self._scenery.cylinder(chair, 0.24, (0.45, 0.52))


def _distance_m(places: Matrix, center: Matrix, half: Matrix) -> float:
    """Distance from the nearest of (N, 2) positions to an upright rectangle."""
    outside = np.maximum(np.abs(places - center) - half, 0.0)
    return float(np.linalg.norm(outside, axis=1).min())
