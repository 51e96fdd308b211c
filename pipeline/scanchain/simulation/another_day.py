"""A world on another day: movable objects removed, moved within sight of where they stood, or added."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose
from scanchain.kernels.raycast import BOX, ELLIPSOID
from scanchain.simulation.solids import FIXED, Solids

_VANISHED, _MOVED, _APPEARED = 0.12, 0.15, 0.08  # shares of the objects removed, moved, and copied elsewhere
_APART_M = (0.5, 4.0)  # meters, range of the distance of a move: within sight of where the object stood
_TURN_RAD = 0.15  # standard deviation of the turn, in addition to quarter turns
_ROOM_M = 0.05  # least distance from other solids
_SAMPLE_M = 2.0 * _ROOM_M  # spacing of the points of a footprint: nothing is farther than ``_ROOM_M`` from one
_COLUMNS = (
    *("kind", "x_before", "y_before", "z_before", "x_after", "y_after", "z_after"),
    *("length", "width", "height"),
)


@dataclass(frozen=True, slots=True)
class Change:
    """A movable object that is not where it was on the first day.

    before, after : (3,) center of its bounding box, meters; NaN if it did not exist then
    size_m : (3,) extent of its bounding box along x, y and z of the world, in its pose on the first day
    owner : number of the object among the solids of both days
    """

    kind: Literal["vanished", "moved", "appeared"]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    size_m: NDArray[np.float64]
    owner: int

    def seen_from(self, T: Pose) -> Change:
        """The same change, transformed by a pose (4, 4), for example into the frame of a map."""
        return replace(self, before=lie.transform(T, self.before), after=lie.transform(T, self.after))


def another_day(
    solids: Solids, path: Matrix, free_m: float, rng: np.random.Generator
) -> tuple[Solids, tuple[Change, ...]]:
    """The same solids with random changes of the movable objects, and these changes.

    path : (N, 2) positions; moved and added objects are more than ``free_m`` away from them
    """
    changes, objects = list[Change](), int(solids.owner.max(initial=FIXED)) + 1
    for owner in range(objects):
        is_of_it = solids.owner == owner
        thing, solids = solids.part(is_of_it), solids.part(~is_of_it)
        fate, elsewhere = rng.random(), None
        if _VANISHED < fate < _VANISHED + _MOVED + _APPEARED:
            elsewhere = _elsewhere(thing, solids, path, free_m, rng)
        before, gone = _middle(thing), np.full(3, np.nan)
        size_m = np.subtract(*_box(thing)[::-1])
        if fate < _VANISHED:
            changes.append(Change("vanished", before, gone, size_m, owner))
            continue
        if elsewhere is None or fate > _VANISHED + _MOVED:
            solids = solids.with_object(thing.rows, owner)
        if elsewhere is not None and fate <= _VANISHED + _MOVED:
            solids = solids.with_object(elsewhere.rows, owner)
            changes.append(Change("moved", before, _middle(elsewhere), size_m, owner))
        elif elsewhere is not None and _is_free(elsewhere, solids, path, free_m):
            solids = solids.with_object(elsewhere.rows, objects)
            changes.append(Change("appeared", gone, _middle(elsewhere), size_m, objects))
            objects += 1
    return solids, tuple(changes)


def write_changes(path: Path, changes: Sequence[Change]) -> None:
    """Write a CSV row per change: kind, center before and after, size; meters, empty if it does not exist then."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for change in changes:
            numbers = np.concatenate([change.before, change.after, change.size_m])
            writer.writerow([change.kind, *("" if np.isnan(x) else f"{x:.3f}" for x in numbers.tolist())])


def _elsewhere(
    thing: Solids, solids: Solids, path: Matrix, free_m: float, rng: np.random.Generator
) -> Solids | None:
    """The object at a free pose nearby with nothing fixed in between; None if no such pose was found."""
    here, fixed = _middle(thing), solids.part(solids.owner == FIXED)
    for _ in range(20):  # it stays as it is if no pose is free
        away_m, direction = rng.uniform(*_APART_M), rng.uniform(0.0, 2.0 * np.pi)
        xy = away_m * np.array([np.cos(direction), np.sin(direction)])
        turn_rad = 0.5 * np.pi * rng.integers(4) + rng.normal(0.0, _TURN_RAD)
        rise = np.diff(fixed.ground_height(np.array([here[:2], here[:2] + xy])))
        moved = _moved(thing, np.append(xy, rise), turn_rad)
        line = here[:2] + np.linspace(0.0, 1.0, int(away_m / _SAMPLE_M) + 2)[:, None] * xy
        if _is_free(moved, solids, path, free_m) and _clearance_m(fixed, line) > _ROOM_M:
            return moved
    return None


def _is_free(thing: Solids, solids: Solids, path: Matrix, free_m: float) -> bool:
    """True if the object stands neither in another solid nor within ``free_m`` of the path (N, 2)."""
    footprint, (low, high) = _footprint(thing), _box(thing)
    near = path[((path > low[:2] - free_m) & (path < high[:2] + free_m)).all(axis=1)]
    off_m = np.linalg.norm(footprint[:, None] - near, axis=2).min(initial=np.inf)
    return bool(off_m > free_m) and _clearance_m(solids, footprint) > _ROOM_M


def _clearance_m(solids: Solids, xy: Matrix) -> float:
    """Least distance of positions (N, 2) from solids, inf if it is over ``_ROOM_M`` from all of them."""
    middle = xy.mean(axis=0)
    reach_m = np.linalg.norm(xy - middle, axis=1).max() + np.linalg.norm(solids.rows[:, 3:5], axis=1) + _ROOM_M
    near = np.linalg.norm(solids.rows[:, 1:3] - middle, axis=1) < reach_m
    return float(solids.part(near).clearance_m(xy, 2.0).min())  # lintels are higher


def _box(thing: Solids) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (3,) of the bounding box of an object along x, y and z."""
    xy, (half_x, half_y), (c, s) = thing.rows[:, 1:3], thing.rows[:, 3:5].T, np.abs(thing.rows[:, 5:7].T)
    half, heights = np.column_stack([c * half_x + s * half_y, s * half_x + c * half_y]), thing.heights
    low, high = np.column_stack([xy - half, heights[:, 0]]), np.column_stack([xy + half, heights[:, 1]])
    return low.min(axis=0), high.max(axis=0)


def _middle(thing: Solids) -> NDArray[np.float64]:
    """Center (3,) of its bounding box."""
    low, high = _box(thing)
    return 0.5 * (low + high)


def _footprint(thing: Solids) -> Matrix:
    """Points (N, 2) on its footprint: all over boxes, on the rims and at the centers of ellipses."""
    parts = []
    for kind, x, y, half_x, half_y, c, s, _, _ in thing.rows:
        if kind == BOX:
            u, v = (np.linspace(-half, half, int(2.0 * half / _SAMPLE_M) + 2) for half in (half_x, half_y))
            grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
            parts.append(grid @ np.array([[c, s], [-s, c]]) + [x, y])
        else:
            angle = np.linspace(0.0, 2.0 * np.pi, int(2.0 * np.pi * max(half_x, half_y) / _SAMPLE_M) + 6)
            rim = np.column_stack([x + half_x * np.cos(angle), y + half_y * np.sin(angle)])
            parts += [[[x, y]], rim]
    return np.vstack(parts)


def _moved(thing: Solids, shift: NDArray[np.float64], turn_rad: float) -> Solids:
    """The object, turned about its center, then shifted by (3,); ellipsoids keep their axes."""
    middle = _middle(thing)[:2]
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[c, -s], [s, c]])
    rows = thing.rows.copy()
    is_box, has_top = rows[:, 0] == BOX, rows[:, 0] != ELLIPSOID
    rows[:, 1:3] = (rows[:, 1:3] - middle) @ turn.T + middle + shift[:2]
    rows[is_box, 5:7] = rows[is_box, 5:7] @ turn.T
    rows[:, 7] += shift[2]
    rows[has_top, 8] += shift[2]
    return replace(thing, rows=rows)
