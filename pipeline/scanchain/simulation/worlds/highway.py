"""A highway: guard rails and their posts, signs, gantries, few trees, and buildings far away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.simulation.motion import Vehicle, mount
from scanchain.simulation.solids import Scenery, Solids
from scanchain.simulation.worlds.outdoors import BELOW_M, tree

_STRAIGHT_M, _RADIUS_M = 1000.0, 300.0
_MEDIAN_M, _EDGE_M, _FAR_EDGE_M = 6.5, -4.5, 17.5  # rails, to the left of the lane that is driven in
_PANEL_M = 4.0  # of a rail, between two posts

CAR = Vehicle(
    speed_m_s=25.0,
    acceleration_m_s2=3.0,
    lateral_acceleration_m_s2=3.0,
    corner_m=15.0,
    deviation_m=0.3,
    sway_rad=0.006,
    heave_m=0.02,
    radius_m=1.0,
    T_base_lidar=mount(0.8, 1.73),
    start_m_s=25.0,
)


def _stadium() -> Matrix:
    """Two straights and two half circles, a point every 2° of a bend; the first bend begins after 350 m."""
    turn = np.deg2rad(np.arange(-90.0, 91.0, 2.0))
    arc = _RADIUS_M * np.column_stack([np.cos(turn), 1.0 + np.sin(turn)])
    begin, end = np.array([350.0, 0.0]), np.array([350.0 - _STRAIGHT_M, 2.0 * _RADIUS_M])
    return np.vstack([np.zeros((1, 2)), begin + arc, end - arc])


ROUTE = _stadium()


class _Road:
    """Positions beside the route, by the distance along it and to its left."""

    def __init__(self, route: Matrix) -> None:
        lap = np.vstack([route, route[:1]])
        self._along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lap, axis=0), axis=1))])
        self._lap = lap
        self.length_m = float(self._along_m[-1])

    def yaw_rad(self, along_m: float) -> float:
        ahead = self._middle(along_m + 0.5) - self._middle(along_m - 0.5)
        return float(np.arctan2(ahead[1], ahead[0]))

    def at(self, along_m: float, left_m: float) -> tuple[float, float]:
        yaw_rad = self.yaw_rad(along_m)
        x, y = self._middle(along_m) + left_m * np.array([-np.sin(yaw_rad), np.cos(yaw_rad)])
        return float(x), float(y)

    def _middle(self, along_m: float) -> NDArray[np.float64]:
        place = along_m % self.length_m
        return np.array([np.interp(place, self._along_m, column) for column in self._lap.T])


def highway(rng: np.random.Generator) -> Solids:
    """The highway; the rail in the middle is whole, everything else is drawn from ``rng``."""
    phase_x, phase_y = rng.uniform(0.0, 2.0 * np.pi, 2)
    scenery = Scenery(np.array([0.0, 0.8, 2.0 * np.pi / 420.0, phase_x, 0.8, 2.0 * np.pi / 330.0, phase_y]))
    road = _Road(ROUTE)
    _rail(scenery, road, _MEDIAN_M, 0.0, road.length_m)
    for left in (_EDGE_M, _FAR_EDGE_M):
        begin = 0.0
        while begin < road.length_m:
            end = begin + rng.uniform(150.0, 400.0)
            _rail(scenery, road, left, begin, min(end, road.length_m))
            begin = end + rng.uniform(40.0, 120.0)
    _signs(scenery, road, rng)
    _landscape(scenery, road, rng)
    return scenery.finish()


def _rail(scenery: Scenery, road: _Road, left_m: float, begin_m: float, end_m: float) -> None:
    """A guard rail and its posts."""
    for along in np.arange(begin_m, end_m - _PANEL_M, _PANEL_M):
        middle = along + 0.5 * _PANEL_M
        size = (_PANEL_M * (1.0 + abs(left_m) / _RADIUS_M), 0.08)  # no gaps on the outside of a bend
        scenery.box(road.at(middle, left_m), size, (0.45, 0.76), road.yaw_rad(middle))
        scenery.cylinder(road.at(along, left_m), 0.06, (BELOW_M, 0.7))


def _signs(scenery: Scenery, road: _Road, rng: np.random.Generator) -> None:
    """Marker posts every 50 m, signs every 100 to 220 m, gantries every 500 to 800 m."""
    for along in np.arange(10.0, road.length_m, 50.0):
        scenery.box(road.at(along, -4.0), (0.1, 0.12), (BELOW_M, 1.0), road.yaw_rad(along))
    along = rng.uniform(0.0, 100.0)
    while along < road.length_m:
        width, low, left = rng.uniform(0.6, 3.5), rng.uniform(1.6, 2.4), rng.uniform(-8.0, -6.0)
        scenery.box(road.at(along, left), (0.05, width), (low, low + rng.uniform(0.6, 2.4)), road.yaw_rad(along))
        for side in (-0.35, 0.35):
            scenery.cylinder(road.at(along + 0.1, left + side * width), 0.05, (BELOW_M, low + 0.5))
        along += rng.uniform(100.0, 220.0)
    along = rng.uniform(100.0, 500.0)
    while along < road.length_m:
        scenery.box(road.at(along, 0.8), (0.5, 13.0), (5.6, 6.3), road.yaw_rad(along))
        scenery.box(road.at(along - 0.3, rng.uniform(-1.0, 2.0)), (0.1, 4.0), (5.3, 7.5), road.yaw_rad(along))
        for left in (-5.3, 7.0):
            scenery.cylinder(road.at(along, left), 0.18, (BELOW_M, 6.0))
        along += rng.uniform(500.0, 800.0)


def _landscape(scenery: Scenery, road: _Road, rng: np.random.Generator) -> None:
    """A tree every 35 m on either side, a building every 250 m, 50 m away or more."""
    for nearest, farthest in ((-60.0, -10.0), (24.0, 75.0)):
        for _ in range(int(road.length_m / 35.0)):
            x, y = road.at(rng.uniform(0.0, road.length_m), rng.uniform(nearest, farthest))
            tree(scenery, x, y, rng)
        for along in np.arange(0.0, road.length_m, 250.0) + rng.uniform(0.0, 200.0):
            left = nearest - rng.uniform(0.0, 25.0) if nearest < 0.0 else farthest + rng.uniform(-10.0, 15.0)
            size = (rng.uniform(12.0, 35.0), rng.uniform(9.0, 16.0))
            scenery.box(road.at(along, left), size, (BELOW_M, rng.uniform(4.0, 11.0)), rng.uniform(0.0, np.pi))
