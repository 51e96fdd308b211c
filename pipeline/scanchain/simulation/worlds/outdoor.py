"""Worlds outdoors: a town, a highway, a field with poles far apart, a forest, a yard to turn in.

``rounds`` is the town without parked cars: its streets are driven twice, in the same and the opposite
direction and lane.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.raycast import BOX
from scanchain.simulation.motion import Lap, Pivot, Vehicle, mount, sampled
from scanchain.simulation.solids import Scenery, Solids

BELOW_M = -1.0  # foundations reach this deep, so that nothing floats on a slope


def parked_car(scenery: Scenery, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
    """A body, a cabin and four wheels; sometimes a van."""
    length, width = rng.uniform(3.8, 4.8), rng.uniform(1.7, 1.85)
    c, s = np.cos(yaw), np.sin(yaw)
    with scenery.movable():
        if rng.random() < 0.15:
            scenery.box((x, y), (length + 0.4, width + 0.15), (0.25, rng.uniform(2.0, 2.5)), yaw)
        else:
            back = rng.choice([-1.0, 1.0]) * 0.08 * length
            scenery.box((x, y), (length, width), (0.22, rng.uniform(0.8, 1.0)), yaw)
            cabin = (x + c * back, y + s * back)
            scenery.box(cabin, (0.5 * length, width - 0.2), (0.8, rng.uniform(1.4, 1.6)), yaw)
        for u in (-0.32 * length, 0.32 * length):
            for v in (-0.5 * width + 0.1, 0.5 * width - 0.1):
                scenery.box((x + c * u - s * v, y + s * u + c * v), (0.6, 0.2), (-0.1, 0.3), yaw)


def tree(scenery: Scenery, x: float, y: float, rng: np.random.Generator) -> None:
    """A trunk, a crown of two ellipsoids, sometimes a shrub at its foot."""
    radius, height = rng.uniform(0.12, 0.28), rng.uniform(3.2, 4.6)
    scenery.cylinder((x, y), radius, (BELOW_M, height))
    size = rng.uniform(1.1, 1.9)
    scenery.ellipsoid((x, y, height + 0.5 * size), (size, size, rng.uniform(0.9, 1.3) * size))
    offset = rng.normal(0.0, 0.4, 2)
    scenery.ellipsoid((x + offset[0], y + offset[1], height + 1.4 * size), (0.8 * size, 0.7 * size, 0.8 * size))
    if rng.random() < 0.3:
        scenery.ellipsoid((x, y, 0.3), (rng.uniform(0.4, 0.7), rng.uniform(0.4, 0.7), rng.uniform(0.4, 0.8)))


# the town


class CrossSection(NamedTuple):
    """Distances of parked cars, lamps, trees and fronts of houses from the middle of a street."""

    parked_m: float
    lamp_m: float
    tree_m: float
    front_m: float


_STREET = CrossSection(3.1, 4.7, 5.2, 7.0)

TOWN_CAR = Vehicle(
    speed_m_s=9.0, acceleration_m_s2=2.5, lateral_acceleration_m_s2=4.0, corner_m=7.0, deviation_m=0.4,
    sway_rad=0.006, heave_m=0.015, radius_m=1.0, T_base_lidar=mount(0.8, 1.73),
)  # fmt: skip

# A figure of eight around two blocks; the street between them is driven northwards on both loops.
TOWN_ROUTE = np.array([
    [50.0, 4.0], [50.0, 40.0], [0.0, 40.0], [0.0, 0.0], [50.0, 0.0], [50.0, 40.0], [100.0, 40.0], [100.0, 0.0],
    [50.0, 0.0],
])  # fmt: skip

ROUNDS_CAR = replace(TOWN_CAR, corner_m=4.0)  # tighter bends, so that it keeps its lane

# In the right lane, 2 m from the middle of the street, but finally in the left one.
ROUNDS_ROUTE = np.array([
    [2.0, -2.0], [102.0, -2.0], [102.0, 42.0], [-2.0, 42.0],  # new
    [-2.0, 0.0], [-2.0, -38.0], [-48.0, -38.0], [-48.0, 38.0],  # new
    [0.0, 38.0], [98.0, 38.0], [98.0, 2.0],  # the first block again, in the other direction
    [2.0, 2.0], [2.0, 40.0], [2.0, 78.0], [48.0, 78.0], [48.0, 40.0],  # partly new
    [48.0, -2.0], [102.0, -2.0], [102.0, 38.0], [2.0, 38.0],  # as the first time, finally in the other lane
])  # fmt: skip


def town(rng: np.random.Generator, parked: float = 0.55) -> Solids:
    """The town; streets and blocks are fixed, everything else is sampled from ``rng``.

    parked : share of the parking spaces at the curb that are occupied
    """
    north_m = (-50.0, 0.0, 50.0, 100.0, 150.0)  # x of the streets that run north
    east_m = (-40.0, 0.0, 40.0, 80.0)  # y of those that run east
    phase_x, phase_y = rng.uniform(0.0, 2.0 * np.pi, 2)  # of waves of 0.5 m: slopes of 3 % at most
    scenery = Scenery(np.array([0.0, 0.5, 2.0 * np.pi / 140.0, phase_x, 0.5, 2.0 * np.pi / 110.0, phase_y]))
    for (west, east), (south, north) in product(pairwise(north_m), pairwise(east_m)):
        _block(scenery, west, east, south, north, rng)
    for y, (west, east) in product(east_m, pairwise(north_m)):
        _street(scenery, np.array([west, y]), np.array([east, y]), parked, rng)
    for x, (south, north) in product(north_m, pairwise(east_m)):
        _street(scenery, np.array([x, south]), np.array([x, north]), parked, rng)
    return scenery.finish()


def _block(
    scenery: Scenery, west: float, east: float, south: float, north: float, rng: np.random.Generator
) -> None:
    """Two rows of houses back to back, garden walls and hedges at the open ends, trees in the yard."""
    for front, facing in ((south + _STREET.front_m, 1.0), (north - _STREET.front_m, -1.0)):
        place = west + _STREET.front_m + rng.uniform(0.0, 1.5)
        while place < east - _STREET.front_m - 7.0:
            width = min(rng.uniform(8.0, 13.0), east - _STREET.front_m - place)
            _house(scenery, place + 0.5 * width, front + facing * rng.uniform(0.0, 2.0), width, facing, rng)
            gap = rng.uniform(1.5, 5.0)
            if rng.random() < 0.6:
                hedge = (place + width + 0.5 * gap, front + facing * 0.3)
                scenery.box(hedge, (gap, rng.uniform(0.2, 0.6)), (BELOW_M, rng.uniform(0.8, 1.8)))
            place += width + gap
    for x in (west + _STREET.front_m - 0.5, east - _STREET.front_m + 0.5):
        half = rng.uniform(2.0, 4.0)
        scenery.box((x, 0.5 * (south + north)), (0.25, 2.0 * half), (BELOW_M, rng.uniform(0.7, 1.6)))
    for _ in range(4):
        x = rng.uniform(west + 12.0, east - 12.0)
        tree(scenery, x, 0.5 * (south + north) + rng.uniform(-1.5, 1.5), rng)


def _house(
    scenery: Scenery, x: float, front: float, width: float, facing: float, rng: np.random.Generator
) -> None:
    """A house whose front lies at y = ``front``; ``facing`` +1 if its body lies north of it.

    The body has two parts of different depth, pilasters, perhaps a bay or a porch, and is slightly rotated.
    """
    yaw = rng.normal(0.0, 0.015)
    height = rng.uniform(4.5, 9.0)
    recess = rng.choice([0.0, rng.uniform(0.5, 2.0)])
    split = width * rng.uniform(0.35, 0.65)
    left, right = x - 0.5 * width, x + 0.5 * width
    for start, end, set_back in ((left, left + split, 0.0), (left + split, right, recess)):
        depth = rng.uniform(6.5, 9.0) - set_back
        middle = (0.5 * (start + end), front + facing * (set_back + 0.5 * depth))
        scenery.box(middle, (end - start + 0.1, depth), (BELOW_M, height), yaw)
    for place in np.arange(left + 0.2, left + split, rng.uniform(1.8, 3.5)):
        scenery.box((float(place), front), (0.35, 0.3), (BELOW_M, height), yaw)
    extra = rng.random()
    if extra < 0.35:  # bay
        center = (left + split * rng.uniform(0.4, 0.6), front - facing * 0.4)
        scenery.box(center, (rng.uniform(1.6, 2.6), 0.8), (BELOW_M, rng.uniform(2.8, height)), yaw)
    elif extra < 0.7:  # steps and the posts of a porch
        door = left + split + 0.3 * (width - split)
        scenery.box((door, front + facing * (recess - 0.6)), (1.6, 1.2), (BELOW_M, 0.35), yaw)
        for side in (-0.7, 0.7):
            scenery.cylinder((door + side, front + facing * (recess - 1.1)), 0.07, (BELOW_M, 2.5))
        scenery.box((door, front + facing * (recess - 0.6)), (1.8, 1.4), (2.5, 2.65), yaw)


def _street(
    scenery: Scenery, start: NDArray[np.float64], end: NDArray[np.float64], parked: float, rng: np.random.Generator
) -> None:
    """Both sides of one street between two crossings: parked cars, trees, lamps, signs, bins."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    aside = np.array([-along[1], along[0]])
    yaw = float(np.arctan2(along[1], along[0]))
    for side in (-1.0, 1.0):
        place = 12.0 + rng.uniform(0.0, 3.0)
        while place < length - 12.0:
            if rng.random() < parked:
                x, y = start + place * along + side * (_STREET.parked_m + rng.normal(0.0, 0.08)) * aside
                parked_car(scenery, float(x), float(y), yaw + rng.normal(0.0, 0.02), rng)
            place += rng.uniform(5.2, 7.5)
        for place in np.arange(9.0 + rng.uniform(0.0, 4.0), length - 9.0, rng.uniform(9.0, 14.0)):
            x, y = start + place * along + side * _STREET.tree_m * aside
            if rng.random() < 0.6:
                tree(scenery, float(x), float(y), rng)
        for place, radius, height in ((8.0, 0.09, 6.5), (length - 7.5, 0.03, 2.4), (0.55 * length, 0.09, 6.5)):
            x, y = start + place * along + side * _STREET.lamp_m * aside
            scenery.cylinder((float(x), float(y)), radius, (BELOW_M, height + rng.uniform(-0.3, 0.3)))
        x, y = start + rng.uniform(10.0, length - 10.0) * along + side * 6.2 * aside
        with scenery.movable():
            scenery.box((float(x), float(y)), (0.6, 0.7), (BELOW_M, 1.1), yaw)


def rounds(rng: np.random.Generator) -> Solids:
    """The town with empty curbs, without the boxes, such as hedges, that reach into the lanes."""
    solids = town(rng, parked=0.0)
    lanes = np.vstack([np.linspace(a, b, 100) for a, b in pairwise([*ROUNDS_ROUTE, ROUNDS_ROUTE[0]])])
    is_kept = solids.rows[:, 0] != BOX
    boxes = solids.rows[~is_kept]
    gap = np.abs(lanes[:, None] - boxes[:, 1:3]) - boxes[:, 3:5]
    is_kept[~is_kept] = np.linalg.norm(np.maximum(gap, 0.0), axis=2).min(axis=0) > 1.8  # half a lane
    return solids.part(is_kept)


# the highway


class Highway(NamedTuple):
    """A highway of two straights and two half circles.

    straight_m, bend_m : length of a straight, radius of a bend
    median_m, edge_m, far_edge_m : of the rails, to the left of the lane driven in
    panel_m : length of a rail between two posts
    """

    straight_m: float = 1000.0
    bend_m: float = 300.0
    median_m: float = 6.5
    edge_m: float = -4.5
    far_edge_m: float = 17.5
    panel_m: float = 4.0


_HIGHWAY = Highway()

HIGHWAY_CAR = Vehicle(
    speed_m_s=25.0, acceleration_m_s2=3.0, lateral_acceleration_m_s2=3.0, corner_m=15.0, deviation_m=0.3,
    sway_rad=0.006, heave_m=0.02, radius_m=1.0, T_base_lidar=mount(0.8, 1.73), start_m_s=25.0,
)  # fmt: skip


# Two straights and two half circles, a point every 2° of a bend; the first bend begins after 350 m.
_TURN = np.deg2rad(np.arange(-90.0, 91.0, 2.0))
_ARC = _HIGHWAY.bend_m * np.column_stack([np.cos(_TURN), 1.0 + np.sin(_TURN)])
_BEGIN, _END = np.array([350.0, 0.0]), np.array([350.0 - _HIGHWAY.straight_m, 2.0 * _HIGHWAY.bend_m])
HIGHWAY_ROUTE = np.vstack([np.zeros((1, 2)), _BEGIN + _ARC, _END - _ARC])


def highway(rng: np.random.Generator) -> Solids:
    """The highway; the median rail has no gaps, everything else is sampled from ``rng``."""
    phase_x, phase_y = rng.uniform(0.0, 2.0 * np.pi, 2)
    scenery = Scenery(np.array([0.0, 0.8, 2.0 * np.pi / 420.0, phase_x, 0.8, 2.0 * np.pi / 330.0, phase_y]))
    road = Lap(HIGHWAY_ROUTE)
    _rail(scenery, road, _HIGHWAY.median_m, 0.0, road.length_m)
    for left in (_HIGHWAY.edge_m, _HIGHWAY.far_edge_m):
        begin = 0.0
        while begin < road.length_m:
            end = begin + rng.uniform(150.0, 400.0)
            _rail(scenery, road, left, begin, min(end, road.length_m))
            begin = end + rng.uniform(40.0, 120.0)
    _signs(scenery, road, rng)
    _landscape(scenery, road, rng)
    return scenery.finish()


def _rail(scenery: Scenery, road: Lap, left_m: float, begin_m: float, end_m: float) -> None:
    for along in np.arange(begin_m, end_m - _HIGHWAY.panel_m, _HIGHWAY.panel_m):
        middle = along + 0.5 * _HIGHWAY.panel_m
        size = (_HIGHWAY.panel_m * (1.0 + abs(left_m) / _HIGHWAY.bend_m), 0.08)  # no gaps on the outside of a bend
        scenery.box(road.beside(middle, left_m), size, (0.45, 0.76), road.yaw_rad(middle))
        scenery.cylinder(road.beside(along, left_m), 0.06, (BELOW_M, 0.7))


def _signs(scenery: Scenery, road: Lap, rng: np.random.Generator) -> None:
    """Marker posts every 50 m, signs every 100 to 220 m, gantries every 500 to 800 m."""
    for along in np.arange(10.0, road.length_m, 50.0):
        scenery.box(road.beside(along, -4.0), (0.1, 0.12), (BELOW_M, 1.0), road.yaw_rad(along))
    along = rng.uniform(0.0, 100.0)
    while along < road.length_m:
        width, low, left = rng.uniform(0.6, 3.5), rng.uniform(1.6, 2.4), rng.uniform(-8.0, -6.0)
        scenery.box(
            road.beside(along, left), (0.05, width), (low, low + rng.uniform(0.6, 2.4)), road.yaw_rad(along)
        )
        for side in (-0.35, 0.35):
            scenery.cylinder(road.beside(along + 0.1, left + side * width), 0.05, (BELOW_M, low + 0.5))
        along += rng.uniform(100.0, 220.0)
    along = rng.uniform(100.0, 500.0)
    while along < road.length_m:
        scenery.box(road.beside(along, 0.8), (0.5, 13.0), (5.6, 6.3), road.yaw_rad(along))
        scenery.box(road.beside(along - 0.3, rng.uniform(-1.0, 2.0)), (0.1, 4.0), (5.3, 7.5), road.yaw_rad(along))
        for left in (-5.3, 7.0):
            scenery.cylinder(road.beside(along, left), 0.18, (BELOW_M, 6.0))
        along += rng.uniform(500.0, 800.0)


def _landscape(scenery: Scenery, road: Lap, rng: np.random.Generator) -> None:
    """A tree every 35 m on either side, a building every 250 m, 50 m away or more."""
    for nearest, farthest in ((-60.0, -10.0), (24.0, 75.0)):
        for _ in range(int(road.length_m / 35.0)):
            x, y = road.beside(rng.uniform(0.0, road.length_m), rng.uniform(nearest, farthest))
            tree(scenery, x, y, rng)
        for along in np.arange(0.0, road.length_m, 250.0) + rng.uniform(0.0, 200.0):
            left = nearest - rng.uniform(0.0, 25.0) if nearest < 0.0 else farthest + rng.uniform(-10.0, 15.0)
            size = (rng.uniform(12.0, 35.0), rng.uniform(9.0, 16.0))
            scenery.box(road.beside(along, left), size, (BELOW_M, rng.uniform(4.0, 11.0)), rng.uniform(0.0, np.pi))


# the field

TRACTOR = Vehicle(
    speed_m_s=10.0, acceleration_m_s2=2.0, lateral_acceleration_m_s2=3.0, corner_m=12.0, deviation_m=0.4,
    sway_rad=0.008, heave_m=0.02, radius_m=1.2, T_base_lidar=mount(0.8, 1.9),
)  # fmt: skip

FIELD_ROUTE = np.array([[0.0, 0.0], [440.0, 0.0], [440.0, 160.0], [0.0, 160.0]])


def field(rng: np.random.Generator) -> Solids:
    """Groups of three poles along the route, about 230 m apart, and the ground."""
    scenery = Scenery()
    for x, y in ((30.0, 0.0), (260.0, 0.0), (425.0, 0.0), (300.0, 160.0), (70.0, 160.0)):
        for along, side in ((-7.0, 1.0), (0.0, -1.0), (7.0, 1.0)):
            place = (x + along + rng.uniform(-2.0, 2.0), y + side * rng.uniform(6.0, 11.0))
            scenery.cylinder(place, rng.uniform(0.12, 0.22), (0.0, rng.uniform(4.0, 7.0)))
    return scenery.finish()


# the forest

_SPACING_M, _BEYOND_M = 4.6, 45.0  # between trunks; how far the forest extends beyond the route
_PATH_FREE_M = 1.6  # kept free on either side of the route

MULE = Vehicle(
    speed_m_s=2.5, acceleration_m_s2=1.0, lateral_acceleration_m_s2=1.2, corner_m=2.5, deviation_m=0.25,
    sway_rad=0.025, heave_m=0.03, radius_m=0.6, T_base_lidar=mount(0.3, 1.1), swing_rad=0.02,
)  # fmt: skip

FOREST_ROUTE = np.array([
    [0.0, 0.0], [16.0, 3.0], [26.0, -6.0], [40.0, 0.0], [44.0, 14.0], [32.0, 22.0], [34.0, 34.0], [16.0, 36.0],
    [10.0, 22.0], [-6.0, 20.0], [-10.0, 6.0],
])  # fmt: skip


def forest(rng: np.random.Generator) -> Solids:
    """The forest: a tree somewhere in every square of 4.6 m that is free of the route."""
    scenery = Scenery(_hills(rng))
    low, high = FOREST_ROUTE.min(axis=0) - _BEYOND_M, FOREST_ROUTE.max(axis=0) + _BEYOND_M
    route = sampled(FOREST_ROUTE, 0.2)
    for x in np.arange(low[0], high[0], _SPACING_M):
        for y in np.arange(low[1], high[1], _SPACING_M):
            place = np.array([x, y]) + rng.uniform(0.0, _SPACING_M, 2)
            off_route = float(np.linalg.norm(route - place, axis=1).min()) - _PATH_FREE_M
            if off_route > 0.4:
                _old_tree(scenery, place, rng)
            undergrowth = place + rng.uniform(-2.0, 2.0, 2)
            room = float(np.linalg.norm(route - undergrowth, axis=1).min()) - _PATH_FREE_M
            if room > 0.6 and rng.random() < 0.35:
                _undergrowth(scenery, undergrowth, room, rng)
    return scenery.finish()


def _hills(rng: np.random.Generator) -> NDArray[np.float64]:
    """Hills of 0.8 m with four superimposed waves 4 to 12 m long, at most 9 cm high each."""
    phase_x, phase_y = rng.uniform(0.0, 2.0 * np.pi, 2)
    hills = [0.0, 0.8, 2.0 * np.pi / 60.0, phase_x, 0.6, 2.0 * np.pi / 45.0, phase_y]
    length_m = np.geomspace(4.0, 12.0, 4)
    count = len(length_m)
    heading = np.pi * (np.arange(count) * 0.382 + rng.uniform(0.0, 1.0, count) / count)
    wave = 2.0 * np.pi / length_m
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    rows = np.column_stack([0.0075 * length_m, wave * np.cos(heading), wave * np.sin(heading), phase])
    return np.concatenate([hills, rows.ravel()])


def _old_tree(scenery: Scenery, place: NDArray[np.float64], rng: np.random.Generator) -> None:
    """A trunk on its root collar and a crown of two ellipsoids, high up."""
    x, y = place.tolist()
    radius, height = rng.uniform(0.09, 0.32), rng.uniform(6.0, 12.0)
    scenery.cylinder((x, y), radius, (BELOW_M, height))
    scenery.ellipsoid((x, y, 0.0), (1.7 * radius, 1.7 * radius, rng.uniform(0.2, 0.5)))
    size = rng.uniform(1.2, 2.6)
    scenery.ellipsoid((x, y, height), (size, size, rng.uniform(0.8, 1.5) * size))
    dx, dy = rng.normal(0.0, 0.6, 2).tolist()
    scenery.ellipsoid((x + dx, y + dy, height - size), (0.7 * size, 0.8 * size, 0.6 * size))


def _undergrowth(scenery: Scenery, place: NDArray[np.float64], room: float, rng: np.random.Generator) -> None:
    """A shrub, a boulder or a fallen log, within the free ``room``."""
    x, y = place.tolist()
    kind, size = rng.random(), min(rng.uniform(0.3, 0.9), room)
    if kind < 0.5:
        scenery.ellipsoid((x, y, 0.5 * size), (size, rng.uniform(0.6, 1.0) * size, rng.uniform(0.7, 1.4) * size))
    elif kind < 0.8:
        scenery.ellipsoid((x, y, 0.1), (size, rng.uniform(0.5, 1.0) * size, 0.6 * size))
    else:
        length, thickness = min(rng.uniform(1.5, 5.0), 1.9 * room), rng.uniform(0.2, 0.45)
        scenery.box((x, y), (length, thickness), (-0.3, thickness), rng.uniform(0.0, np.pi))


# the yard

_YARD_M = (19.0, 15.0)  # half the length and half the width between its walls

YARD_ROBOT = Vehicle(
    speed_m_s=1.5, acceleration_m_s2=1.5, lateral_acceleration_m_s2=1.0, sway_rad=0.006, heave_m=0.004,
    radius_m=0.4, T_base_lidar=mount(0.15, 0.9),
)  # fmt: skip

# A triangle, a square in the other direction, out and back, full turns on the spot in both directions; it closes.
YARD_STEPS = (
    *[Pivot(120.0, 3.0)] * 3,
    *[Pivot(-90.0, 2.0)] * 4,
    *[Pivot(180.0, 3.5)] * 2,
    Pivot(360.0, 0.0), Pivot(-45.0, 0.0), Pivot(90.0, 0.0), Pivot(-405.0, 0.0),
)  # fmt: skip


def yard(rng: np.random.Generator) -> Solids:
    """The yard; the walls are in fixed places, everything else is sampled from ``rng``."""
    phase_x, phase_y = rng.uniform(0.0, 2.0 * np.pi, 2)
    scenery = Scenery(np.array([0.0, 0.1, 2.0 * np.pi / 30.0, phase_x, 0.1, 2.0 * np.pi / 24.0, phase_y]))
    for side in (-1.0, 1.0):
        scenery.box((0.0, side * _YARD_M[1]), (2.0 * _YARD_M[0], 0.3), (BELOW_M, rng.uniform(1.8, 3.0)))
        scenery.box((side * _YARD_M[0], 0.0), (0.3, 2.0 * _YARD_M[1]), (BELOW_M, rng.uniform(1.8, 3.0)))
        for x in np.arange(-15.0, 15.1, 6.0):
            _lean_on(scenery, float(x) + rng.uniform(-1.0, 1.0), side * (_YARD_M[1] - 2.2), rng)
        for y in (-7.0, 0.0, 7.0):
            parked_car(scenery, side * (_YARD_M[0] - 3.0), y + rng.uniform(-1.5, 1.5), rng.normal(0.0, 0.1), rng)
        tree(scenery, side * rng.uniform(10.5, 12.0), rng.uniform(-6.0, 6.0), rng)
    for bearing in np.deg2rad(np.arange(0.0, 360.0, 60.0)) + rng.uniform(-0.4, 0.4, 6):
        x, y = rng.uniform(7.0, 9.5) * np.array([np.cos(bearing), np.sin(bearing)])
        scenery.cylinder((x, y), rng.uniform(0.05, 0.2), (BELOW_M, rng.uniform(0.8, 3.5)))
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
