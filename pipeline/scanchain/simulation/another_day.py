"""A world on another day: movable objects taken away, moved within sight of where they stood, or added."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.simulation.solids import FIXED, Solids

_REMOVED, _MOVED, _ADDED = 0.12, 0.15, 0.08  # shares of the objects that go, move, and get a copy elsewhere
_APART_M = (0.5, 4.0)  # distance of the move
_TURN_RAD = 0.15  # standard deviation of the turn, beside quarter turns
_TRIES = 20
_ROOM_M = 0.05  # distance kept from other solids
_SPARE_M = 0.25  # distance kept from the path, besides half the vehicle's width
_SAMPLE_M = 0.1  # spacing of the points of a footprint
_NEAR_M = 8.0  # solids so far from an object can be in its way
_BELOW_M = 2.0  # solids that begin higher are in nobody's way
_COLUMNS = (
    *("kind", "x_before", "y_before", "z_before", "x_after", "y_after", "z_after"),
    *("length", "width", "height"),
)


@dataclass(frozen=True, slots=True)
class Change:
    """A movable object that is not where it was on the first day.

    Attributes
    ----------
    before, after : (3,) middle of its bounding box, meters; NaN where it was or is not there
    size_m : (3,) length, width and height of its upright bounding box when it was at yaw 0
    owner : number of the object among the solids of both days
    """

    kind: Literal["removed", "moved", "added"]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    size_m: NDArray[np.float64]
    owner: int


def another_day(
    solids: Solids, path: Matrix, free_m: float, rng: np.random.Generator
) -> tuple[Solids, tuple[Change, ...]]:
    """The same place with changes, drawn from ``rng``, of its movable objects.

    path : (N, 2) positions from which objects keep ``free_m`` and a little more
    """
    world, changes = _World(solids, path, free_m + _SPARE_M), []
    objects = int(solids.owner.max(initial=FIXED)) + 1
    for owner in range(objects):
        thing, fate = world.take(owner), rng.random()
        elsewhere = world.place_for(thing, rng) if _REMOVED < fate < _REMOVED + _MOVED + _ADDED else None
        before, gone = _middle(thing), np.full(3, np.nan)
        size_m = np.subtract(*_box(thing)[::-1])
        if fate < _REMOVED:
            changes.append(Change("removed", before, gone, size_m, owner))
            continue
        if elsewhere is None or fate > _REMOVED + _MOVED:
            world.put(thing, owner)
        if elsewhere is not None and fate <= _REMOVED + _MOVED:
            world.put(elsewhere, owner)
            changes.append(Change("moved", before, _middle(elsewhere), size_m, owner))
        elif elsewhere is not None and world.is_free(elsewhere):
            world.put(elsewhere, objects)
            changes.append(Change("added", gone, _middle(elsewhere), size_m, objects))
            objects += 1
    return world.solids, tuple(changes)


def write_changes(path: Path, changes: Sequence[Change]) -> None:
    """Write a line for each change: kind, middle before and after, size; meters, empty where it is not there."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for change in changes:
            numbers = np.concatenate([change.before, change.after, change.size_m])
            writer.writerow([change.kind, *("" if np.isnan(x) else f"{x:.3f}" for x in numbers.tolist())])


class _World:
    """``solids``, of which objects are taken out and put down again, and a ``path`` (N, 2) that is kept free."""

    def __init__(self, solids: Solids, path: Matrix, free_m: float) -> None:
        self.solids = solids
        self._path = path
        self._free_m = free_m

    def take(self, owner: int) -> Solids:
        """Take an object out."""
        is_of_it = self.solids.owner == owner
        thing, self.solids = self.solids.part(is_of_it), self.solids.part(~is_of_it)
        return thing

    def put(self, thing: Solids, owner: int) -> None:
        """Put down an object of that number."""
        self.solids = self.solids.with_object(thing, owner)

    def place_for(self, thing: Solids, rng: np.random.Generator) -> Solids | None:
        """The object somewhere near, where it is free and nothing fixed stands between; None if none was found."""
        here, fixed = _middle(thing), self.solids.part(self.solids.owner == FIXED)
        for _ in range(_TRIES):
            away_m, direction = rng.uniform(*_APART_M), rng.uniform(0.0, 2.0 * np.pi)
            xy = away_m * np.array([np.cos(direction), np.sin(direction)])
            turn_rad = 0.5 * np.pi * rng.integers(4) + rng.normal(0.0, _TURN_RAD)
            rise = np.diff(fixed.ground_height(np.array([here[:2], here[:2] + xy])))
            moved = _moved(thing, np.append(xy, rise), turn_rad)
            line = here[:2] + np.linspace(0.0, 1.0, int(away_m / _SAMPLE_M) + 2)[:, None] * xy
            if self.is_free(moved) and _clearance_m(fixed, line) > _ROOM_M:
                return moved
        return None

    def is_free(self, thing: Solids) -> bool:
        """True if it stands neither in another solid nor in the path."""
        footprint, (low, high) = _footprint(thing), _box(thing)
        near = self._path[
            ((self._path > low[:2] - self._free_m) & (self._path < high[:2] + self._free_m)).all(axis=1)
        ]
        off_m = np.linalg.norm(footprint[:, None] - near, axis=2).min(initial=np.inf)
        return bool(off_m > self._free_m) and _clearance_m(self.solids, footprint) > _ROOM_M


def _clearance_m(solids: Solids, xy: Matrix) -> float:
    """Least distance of positions (N, 2) from the solids around, inf where none is near."""
    boxes, cylinders, ellipsoids = solids.groups
    reach_m = np.concatenate([boxes[:, 2:4].max(axis=1), cylinders[:, 2], ellipsoids[:, 3:5].max(axis=1)])
    places = np.concatenate([rows[:, :2] for rows in solids.groups])
    near = np.linalg.norm(places - xy.mean(axis=0), axis=1) < _NEAR_M + 1.5 * reach_m
    return float(solids.part(near).clearance_m(xy, _BELOW_M).min())


def _box(thing: Solids) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (3,) of the bounding box of an object along x, y and z."""
    boxes, cylinders, ellipsoids = thing.groups
    c, s = np.abs(boxes[:, 6]), np.abs(boxes[:, 7])
    half = np.column_stack([c * boxes[:, 2] + s * boxes[:, 3], s * boxes[:, 2] + c * boxes[:, 3]])
    parts = (
        (boxes[:, :2], half, boxes[:, 4:6]),
        (cylinders[:, :2], cylinders[:, [2, 2]], cylinders[:, 3:5]),
        (ellipsoids[:, :2], ellipsoids[:, 3:5], ellipsoids[:, 2:3] + ellipsoids[:, 5:6] * [-1.0, 1.0]),
    )
    low = [np.column_stack([xy - half, z[:, 0]]) for xy, half, z in parts]
    high = [np.column_stack([xy + half, z[:, 1]]) for xy, half, z in parts]
    return np.vstack(low).min(axis=0), np.vstack(high).max(axis=0)


def _middle(thing: Solids) -> NDArray[np.float64]:
    """(3,) of its bounding box."""
    low, high = _box(thing)
    return 0.5 * (low + high)


def _footprint(thing: Solids) -> Matrix:
    """Points (N, 2) all over what it covers of the ground."""
    points = [_rectangle(row) for row in thing.boxes]
    points += [_disk(row[:2], row[2:3].repeat(2)) for row in thing.cylinders]
    points += [_disk(row[:2], row[3:5]) for row in thing.ellipsoids]
    return np.vstack(points)


def _moved(thing: Solids, shift: NDArray[np.float64], turn_rad: float) -> Solids:
    """Turned about its middle, then shifted by (3,); ellipsoids keep their axes."""
    middle = _middle(thing)[:2]
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[c, -s], [s, c]])
    boxes, cylinders, ellipsoids = groups = [rows.copy() for rows in thing.groups]
    for rows in groups:
        rows[:, :2] = (rows[:, :2] - middle) @ turn.T + middle + shift[:2]
    boxes[:, 6:8] = boxes[:, 6:8] @ turn.T
    boxes[:, 4:6] += shift[2]
    cylinders[:, 3:5] += shift[2]
    ellipsoids[:, 2] += shift[2]
    return Solids(boxes, cylinders, ellipsoids, thing.ground, thing.owner)


def _rectangle(box: NDArray[np.float64]) -> Matrix:
    """Points (N, 2) on a box seen from above."""
    u, v = (np.linspace(-half, half, int(2.0 * half / _SAMPLE_M) + 2) for half in box[2:4])
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    c, s = box[6:8]
    return grid @ np.array([[c, s], [-s, c]]) + box[:2]


def _disk(center: NDArray[np.float64], radii: NDArray[np.float64]) -> Matrix:
    """Points (N, 2) on the rim of an ellipse and its center."""
    angle = np.linspace(0.0, 2.0 * np.pi, int(2.0 * np.pi * radii.max() / _SAMPLE_M) + 6)
    return np.vstack([center, center + radii * np.column_stack([np.cos(angle), np.sin(angle)])])
