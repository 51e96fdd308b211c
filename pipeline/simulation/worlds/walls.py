"""Indoor walls with doorways."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scanchain.simulation.solids import Scenery

CEILING_M = 2.8
_WALL_M, _DOOR_M = 0.12, 1.0


class Wall(NamedTuple):
    """A wall with doorways ``doors`` meters along it; the leaves open to its left (1), right (−1) or are off."""

    x0: float
    y0: float
    x1: float
    y1: float
    doors: tuple[float, ...] = ()
    leaves: int = 0

    def at(self, along_m: float, left_m: float = 0.0) -> tuple[float, float]:
        """The place so far along the wall and to its left."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return float(self.x0 + c * along_m - s * left_m), float(self.y0 + s * along_m + c * left_m)

    @property
    def length_m(self) -> float:
        """From end to end."""
        return float(np.hypot(self.x1 - self.x0, self.y1 - self.y0))

    @property
    def yaw_rad(self) -> float:
        """Which way it runs."""
        return float(np.arctan2(self.y1 - self.y0, self.x1 - self.x0))


def build_wall(scenery: Scenery, wall: Wall, rng: np.random.Generator) -> None:
    """The pieces of a wall between its doorways, a lintel over each, and the leaves, open at 90 to 110 degrees."""
    edges = [
        0.0,
        *(e for place in wall.doors for e in (place - 0.5 * _DOOR_M, place + 0.5 * _DOOR_M)),
        wall.length_m,
    ]
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        size = (last - first + _WALL_M * (first == 0.0 or last == wall.length_m), _WALL_M)
        scenery.box(wall.at(0.5 * (first + last)), size, (0.0, CEILING_M), wall.yaw_rad)
    for place in wall.doors:
        scenery.box(wall.at(place), (_DOOR_M, _WALL_M), (2.1, CEILING_M), wall.yaw_rad)
        if wall.leaves:
            turn_rad = np.deg2rad(rng.uniform(90.0, 110.0))  # 0 is shut, hinged at the far jamb
            half = 0.5 * (_DOOR_M - 0.05)
            middle = wall.at(
                place + 0.53 * _DOOR_M - half * np.cos(turn_rad), wall.leaves * half * np.sin(turn_rad)
            )
            scenery.box(middle, (2.0 * half, 0.04), (0.01, 2.1), wall.yaw_rad - wall.leaves * turn_rad)
