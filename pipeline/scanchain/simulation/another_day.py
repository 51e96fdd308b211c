"""A world on another day: movable objects taken away, moved within sight of where they stood, or added."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
_ROOM_M, _SPARE_M = (
    0.05,
    0.25,
)  # distance kept from other solids, and from the path besides half the vehicle's width
_SAMPLE_M = 0.1  # spacing of the points of a footprint
_NEAR_M = 8.0  # solids so far from an object can be in its way
_BELOW_M = 2.0  # solids that begin higher are in nobody's way
_COLUMNS = (
    "kind",
    "x_before",
    "y_before",
    "z_before",
    "x_after",
    "y_after",
    "z_after",
    "length",
    "width",
    "height",
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


class _Object:
    """The solids of one movable object; rows as in ``Solids``."""

    def __init__(self, boxes: Matrix, cylinders: Matrix, ellipsoids: Matrix) -> None:
        self.boxes, self.cylinders, self.ellipsoids = boxes, cylinders, ellipsoids

    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Corners (3,) of its bounding box along x, y and z."""
        c, s = np.abs(self.boxes[:, 6]), np.abs(self.boxes[:, 7])
        half = np.column_stack(
            [c * self.boxes[:, 2] + s * self.boxes[:, 3], s * self.boxes[:, 2] + c * self.boxes[:, 3]]
        )
        round_half = np.repeat(self.cylinders[:, 2:3], 2, axis=1)
        low = [
            np.column_stack([self.boxes[:, :2] - half, self.boxes[:, 4]]),
            np.column_stack([self.cylinders[:, :2] - round_half, self.cylinders[:, 3]]),
            self.ellipsoids[:, :3] - self.ellipsoids[:, 3:],
        ]
        high = [
            np.column_stack([self.boxes[:, :2] + half, self.boxes[:, 5]]),
            np.column_stack([self.cylinders[:, :2] + round_half, self.cylinders[:, 4]]),
            self.ellipsoids[:, :3] + self.ellipsoids[:, 3:],
        ]
        return np.vstack(low).min(axis=0), np.vstack(high).max(axis=0)

    def middle(self) -> NDArray[np.float64]:
        """(3,) of its bounding box."""
        low, high = self.box()
        return 0.5 * (low + high)

    def footprint(self) -> Matrix:
        """Points (N, 2) all over what it covers of the ground."""
        points = [_rectangle(row) for row in self.boxes]
        points += [_disk(row[:2], row[2:3].repeat(2)) for row in self.cylinders]
        points += [_disk(row[:2], row[3:5]) for row in self.ellipsoids]
        return np.vstack(points)

    def moved(self, shift: NDArray[np.float64], turn_rad: float) -> _Object:
        """Turned about its middle, then shifted by (3,); ellipsoids keep their axes."""
        middle = self.middle()[:2]
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        turn = np.array([[c, -s], [s, c]])
        boxes, cylinders, ellipsoids = self.boxes.copy(), self.cylinders.copy(), self.ellipsoids.copy()
        for rows in (boxes, cylinders, ellipsoids):
            rows[:, :2] = (rows[:, :2] - middle) @ turn.T + middle + shift[:2]
        boxes[:, 6:8] = boxes[:, 6:8] @ turn.T
        boxes[:, 4:6] += shift[2]
        cylinders[:, 3:5] += shift[2]
        ellipsoids[:, 2] += shift[2]
        return _Object(boxes, cylinders, ellipsoids)


def another_day(
    solids: Solids, path: Matrix, free_m: float, rng: np.random.Generator
) -> tuple[Solids, tuple[Change, ...]]:
    """The same place with changes, drawn from ``rng``, of its movable objects.

    path : (N, 2) positions from which objects keep ``free_m`` and a little more
    """
    world = _World(solids, path, free_m + _SPARE_M)
    changes = []
    for owner in range(int(solids.owner.max(initial=FIXED)) + 1):
        thing, fate = world.taken(owner), rng.random()
        elsewhere = world.place_for(thing, rng) if _REMOVED < fate < _REMOVED + _MOVED + _ADDED else None
        before, gone = thing.middle(), np.full(3, np.nan)
        low, high = thing.box()
        if fate < _REMOVED:
            changes.append(Change("removed", before, gone, high - low, owner))
            continue
        if elsewhere is None or fate > _REMOVED + _MOVED:
            world.put(thing, owner)
        if elsewhere is not None and fate <= _REMOVED + _MOVED:
            world.put(elsewhere, owner)
            changes.append(Change("moved", before, elsewhere.middle(), high - low, owner))
        elif elsewhere is not None and world.is_free(elsewhere):
            number = world.put(elsewhere)
            changes.append(Change("added", gone, elsewhere.middle(), high - low, number))
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
    """Solids whose movable objects are taken out and put down again."""

    def __init__(self, solids: Solids, path: Matrix, free_m: float) -> None:
        self.solids = solids
        self._path = path
        self._free_m = free_m
        self._objects = int(solids.owner.max(initial=FIXED)) + 1

    def taken(self, owner: int) -> _Object:
        """Take an object out."""
        parts = [self._split(rows, self._owner_of(k) == owner) for k, rows in enumerate(self._rows())]
        keep = self.solids.owner != owner
        rest = [rest for _, rest in parts]
        self.solids = replace(
            self.solids, boxes=rest[0], cylinders=rest[1], ellipsoids=rest[2], owner=self.solids.owner[keep]
        )
        return _Object(*(taken for taken, _ in parts))

    def put(self, thing: _Object, owner: int | None = None) -> int:
        """Put an object down, as one that was there or, without a number, as a new one; returns its number."""
        if owner is None:
            owner, self._objects = self._objects, self._objects + 1
        added = (thing.boxes, thing.cylinders, thing.ellipsoids)
        owners = [np.append(self._owner_of(k), np.full(len(rows), owner)) for k, rows in enumerate(added)]
        boxes, cylinders, ellipsoids = (
            np.vstack([rows, more]) for rows, more in zip(self._rows(), added, strict=True)
        )
        self.solids = replace(
            self.solids, boxes=boxes, cylinders=cylinders, ellipsoids=ellipsoids, owner=np.concatenate(owners)
        )
        return owner

    def place_for(self, thing: _Object, rng: np.random.Generator) -> _Object | None:
        """The object somewhere near, where it is free and nothing fixed stands between; None if none was found."""
        here = thing.middle()
        for _ in range(_TRIES):
            away_m, direction = rng.uniform(*_APART_M), rng.uniform(0.0, 2.0 * np.pi)
            xy = away_m * np.array([np.cos(direction), np.sin(direction)])
            turn_rad = 0.5 * np.pi * rng.integers(4) + rng.normal(0.0, _TURN_RAD)
            rise = np.diff(self.solids.ground_height(np.array([here[:2], here[:2] + xy])))
            moved = thing.moved(np.append(xy, rise), turn_rad)
            line = here[:2] + np.linspace(0.0, 1.0, int(away_m / _SAMPLE_M) + 2)[:, None] * xy
            if self.is_free(moved) and self._clearance_m(line, only_fixed=True) > _ROOM_M:
                return moved
        return None

    def is_free(self, thing: _Object) -> bool:
        """True if it stands neither in another solid nor in the path."""
        footprint = thing.footprint()
        low, high = thing.box()
        near = self._path[
            ((self._path > low[:2] - self._free_m) & (self._path < high[:2] + self._free_m)).all(axis=1)
        ]
        off_m = np.linalg.norm(footprint[:, None] - near, axis=2).min(initial=np.inf)
        return bool(off_m > self._free_m) and self._clearance_m(footprint) > _ROOM_M

    def _clearance_m(self, xy: Matrix, *, only_fixed: bool = False) -> float:
        """Least distance of positions (N, 2) from the solids around, inf where none is near."""
        chosen = []
        for k, rows in enumerate(self._rows()):
            reach_m = rows[:, 2:4].max(axis=1) if k == 0 else rows[:, 2] if k == 1 else rows[:, 3:5].max(axis=1)
            near = np.linalg.norm(rows[:, :2] - xy.mean(axis=0), axis=1) < _NEAR_M + 1.5 * reach_m
            chosen.append(rows[near & (self._owner_of(k) == FIXED) if only_fixed else near])
        around = Solids(*chosen, ground=self.solids.ground)
        return float(around.clearance_m(xy, _BELOW_M).min())

    def _rows(self) -> tuple[Matrix, Matrix, Matrix]:
        return self.solids.boxes, self.solids.cylinders, self.solids.ellipsoids

    def _owner_of(self, kind: int) -> NDArray[np.int64]:
        """Owners of the boxes (0), cylinders (1) or ellipsoids (2)."""
        ends = np.cumsum([0, *(len(rows) for rows in self._rows())])
        return self.solids.owner[ends[kind] : ends[kind + 1]]

    @staticmethod
    def _split(rows: Matrix, chosen: NDArray[np.bool_]) -> tuple[Matrix, Matrix]:
        return rows[chosen], rows[~chosen]


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
