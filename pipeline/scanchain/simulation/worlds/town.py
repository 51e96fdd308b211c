"""A small town: a grid of streets with houses, gardens, trees, lamps and parked cars on rolling ground.

``rounds`` is the town without parked cars: its streets are driven twice, in the same and the opposite
direction and lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.simulation.motion import Vehicle
from scanchain.simulation.solids import Scenery, Solids
from scanchain.simulation.worlds.outdoors import BELOW_M, parked_car, tree

_STREETS_X_M = (-50.0, 0.0, 50.0, 100.0, 150.0)  # middles of the streets that run north
_STREETS_Y_M = (-40.0, 0.0, 40.0, 80.0)  # and east
_KERB_M, _PARKED_M, _LAMP_M, _TREE_M, _FRONT_M = 4.0, 3.1, 4.7, 5.2, 7.0  # from the middle of the street

CAR = Vehicle(
    speed_m_s=9.0,
    acceleration_m_s2=2.5,
    lateral_acceleration_m_s2=4.0,
    corner_m=7.0,
    deviation_m=0.4,
    sway_rad=0.006,
    heave_m=0.015,
    radius_m=1.0,
    T_base_lidar=np.array([[1.0, 0, 0, 0.8], [0, 1, 0, 0], [0, 0, 1, 1.73], [0, 0, 0, 1]]),
)

# A figure of eight round two blocks; the street between them is driven northwards on both loops.
ROUTE = np.array([[50.0, 4.0], [50.0, 40.0], [0.0, 40.0], [0.0, 0.0], [50.0, 0.0], [50.0, 40.0], [100.0, 40.0],
                  [100.0, 0.0], [50.0, 0.0]])  # fmt: skip

ROUNDS_CAR = replace(CAR, corner_m=4.0)  # tighter bends, so that it keeps its lane
_LANE_M = 2.0  # from the middle of the street, to the right
_FREE_M = 1.8  # on either side of the middle of a lane

# Crossings in the order they are passed, and the lane taken from there: 1 is the right one, −1 the left one.
_LEGS = (
    ((0, 0), 1), ((100, 0), 1), ((100, 40), 1), ((0, 40), 1),  # new
    ((0, 0), 1), ((0, -40), 1), ((-50, -40), 1), ((-50, 40), 1),  # new
    ((0, 40), 1), ((100, 40), 1), ((100, 0), 1),  # the first block again, in the other direction
    ((0, 0), 1), ((0, 40), 1), ((0, 80), 1), ((50, 80), 1), ((50, 40), 1),  # partly new
    ((50, 0), 1), ((100, 0), 1), ((100, 40), -1), ((0, 40), -1),  # as the first time, at last in the other lane
)  # fmt: skip


def town(
    rng: np.random.Generator,
    parked: float = 0.55,
    *,
    streets_x_m: Sequence[float] = _STREETS_X_M,
    streets_y_m: Sequence[float] = _STREETS_Y_M,
) -> Solids:
    """The town; streets and blocks stand where they stand, everything else is drawn from ``rng``.

    parked : share of the places at the kerb that have a car on them
    streets_x_m, streets_y_m : middles of the streets that run north, and east
    """
    scenery = Scenery(_relief(rng))
    for west, east in pairwise(streets_x_m):
        for south, north in pairwise(streets_y_m):
            _block(scenery, west, east, south, north, rng)
    for y in streets_y_m:
        for west, east in pairwise(streets_x_m):
            _street(scenery, np.array([west, y]), np.array([east, y]), parked, rng)
    for x in streets_x_m:
        for south, north in pairwise(streets_y_m):
            _street(scenery, np.array([x, south]), np.array([x, north]), parked, rng)
    return scenery.finish()


def _relief(rng: np.random.Generator) -> NDArray[np.float64]:
    """Gentle waves of 0.5 m: slopes of 3 % at most."""
    wave_x, wave_y = 2.0 * np.pi / 140.0, 2.0 * np.pi / 110.0
    phase_x, phase_y = rng.uniform(0.0, 2.0 * np.pi, 2)
    return np.array([0.0, 0.5, wave_x, phase_x, 0.5, wave_y, phase_y])


def _block(
    scenery: Scenery, west: float, east: float, south: float, north: float, rng: np.random.Generator
) -> None:
    """Two rows of houses back to back, garden walls and hedges at the open ends, trees in the yard."""
    for front, facing in ((south + _FRONT_M, 1.0), (north - _FRONT_M, -1.0)):
        place = west + _FRONT_M + rng.uniform(0.0, 1.5)
        while place < east - _FRONT_M - 7.0:
            width = min(rng.uniform(8.0, 13.0), east - _FRONT_M - place)
            _house(scenery, place + 0.5 * width, front + facing * rng.uniform(0.0, 2.0), width, facing, rng)
            gap = rng.uniform(1.5, 5.0)
            if rng.random() < 0.6:
                hedge = (place + width + 0.5 * gap, front + facing * 0.3)
                scenery.box(hedge, (gap, rng.uniform(0.2, 0.6)), (BELOW_M, rng.uniform(0.8, 1.8)))
            place += width + gap
    for x in (west + _FRONT_M - 0.5, east - _FRONT_M + 0.5):
        half = rng.uniform(2.0, 4.0)
        scenery.box((x, 0.5 * (south + north)), (0.25, 2.0 * half), (BELOW_M, rng.uniform(0.7, 1.6)))
    for _ in range(4):
        x = rng.uniform(west + 12.0, east - 12.0)
        tree(scenery, x, 0.5 * (south + north) + rng.uniform(-1.5, 1.5), rng)


def _house(
    scenery: Scenery, x: float, front: float, width: float, facing: float, rng: np.random.Generator
) -> None:
    """A house whose front lies at y = ``front``; ``facing`` +1 if its body lies north of it.

    The body has two parts of different depth, pilasters, perhaps a bay or a porch, and stands a little askew.
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
    scenery: Scenery,
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    parked: float,
    rng: np.random.Generator,
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
                x, y = start + place * along + side * (_PARKED_M + rng.normal(0.0, 0.08)) * aside
                parked_car(scenery, float(x), float(y), yaw + rng.normal(0.0, 0.02), rng)
            place += rng.uniform(5.2, 7.5)
        for place in np.arange(9.0 + rng.uniform(0.0, 4.0), length - 9.0, rng.uniform(9.0, 14.0)):
            x, y = start + place * along + side * _TREE_M * aside
            if rng.random() < 0.6:
                tree(scenery, float(x), float(y), rng)
        for place, radius, height in ((8.0, 0.09, 6.5), (length - 7.5, 0.03, 2.4), (0.55 * length, 0.09, 6.5)):
            x, y = start + place * along + side * _LAMP_M * aside
            scenery.cylinder((float(x), float(y)), radius, (BELOW_M, height + rng.uniform(-0.3, 0.3)))
        x, y = start + rng.uniform(10.0, length - 10.0) * along + side * 6.2 * aside
        with scenery.movable():
            scenery.box((float(x), float(y)), (0.6, 0.7), (BELOW_M, 1.1), yaw)


def rounds(rng: np.random.Generator) -> Solids:
    """The town, its kerbs empty and its hedges cut where they reach into the lanes."""
    solids = town(rng, parked=0.0)
    lanes = np.vstack([np.linspace(a, b, 100) for a, b in pairwise([*ROUNDS_ROUTE, ROUNDS_ROUTE[0]])])
    gap = np.abs(lanes[:, None] - solids.boxes[:, :2]) - solids.boxes[:, 2:4]
    distance_m = np.linalg.norm(np.maximum(gap, 0.0), axis=2).min(axis=0)
    kept = distance_m > _FREE_M
    owner = np.concatenate([solids.owner[: len(kept)][kept], solids.owner[len(kept) :]])
    return replace(solids, boxes=solids.boxes[kept], owner=owner)


def _lanes() -> Matrix:
    """The route (W, 2): the lane of each street, and its intersection with that of the next one."""
    legs = [*_LEGS, _LEGS[0]]
    lines = []
    for (start, lane), (end, _) in pairwise(legs):
        along = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
        lines.append((np.array(start) + lane * _LANE_M * np.array([along[1], -along[0]]), along))
    return np.array([_meeting(*lines[k - 1], *lines[k]) for k in range(len(lines))])


def _meeting(p: Matrix, u: Matrix, q: Matrix, v: Matrix) -> Matrix:
    """Intersection of the lines p + s u and q + t v, or q where they are parallel."""
    cross = u[0] * v[1] - u[1] * v[0]
    if abs(cross) < 1e-9:
        return q
    d = q - p
    return p + (d[0] * v[1] - d[1] * v[0]) / cross * u


ROUNDS_ROUTE = _lanes()
