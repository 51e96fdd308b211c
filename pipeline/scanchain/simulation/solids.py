"""Solids of a simulated world, and its construction."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.kernels.raycast import BOX, CYLINDER, ELLIPSOID, SECTORS, cast_rays

Pair = tuple[float, float]
FLAT = np.zeros(7)
FIXED = -1  # the owner of solids that belong to no movable object


@dataclass(frozen=True, slots=True)
class Solids:
    """Closed solids above a rolling ground, meters, world frame.

    rows : (S, 9) as ``cast_rays`` takes them
    owner : (S,) number of the movable object that each solid is a part of, FIXED for none
    ground : (7 + 4 W,) z = g0 + g1 sin(g2 x + g3) + g4 sin(g5 y + g6) + Σ a sin(b x + c y + d), W rows a, b, c, d
    """

    rows: Matrix
    owner: NDArray[np.int64]
    ground: NDArray[np.float64]

    @property
    def heights(self) -> Matrix:
        """Bottom and top of each, (S, 2)."""
        middle, radius = self.rows[:, 7:8], self.rows[:, 8:]
        return np.where(self.rows[:, :1] == ELLIPSOID, middle + radius * [-1.0, 1.0], self.rows[:, 7:])

    def part(self, chosen: NDArray[np.bool_]) -> Solids:
        """Some of the solids, selected by a mask (S,)."""
        return replace(self, rows=self.rows[chosen], owner=self.owner[chosen])

    def with_object(self, rows: Matrix, owner: int) -> Solids:
        """These solids and those (N, 9) of one object with number ``owner``."""
        owners = np.append(self.owner, np.full(len(rows), owner))
        return replace(self, rows=np.vstack([self.rows, rows]), owner=owners)

    def ground_height(self, xy: Matrix) -> NDArray[np.float64]:
        """Height of the ground at (..., 2) positions."""
        return _height(self.ground, xy)

    def ground_slope(self, xy: Matrix) -> Matrix:
        """Gradient of the ground at (..., 2) positions."""
        g = self.ground
        along_x = g[1] * g[2] * np.cos(g[2] * xy[..., 0] + g[3])
        along_y = g[4] * g[5] * np.cos(g[5] * xy[..., 1] + g[6])
        for a, b, c, d in g[7:].reshape(-1, 4):
            steepness = a * np.cos(b * xy[..., 0] + c * xy[..., 1] + d)
            along_x, along_y = along_x + b * steepness, along_y + c * steepness
        return np.stack([along_x, along_y], axis=-1)

    def cast(
        self, T_world_sensor: Matrix, pose_of_ray: NDArray[np.int32], directions: Matrix, max_range_m: float
    ) -> NDArray[np.float64]:
        """Range to the first surface along each ray, inf beyond the limit; poses (P, 4, 4), directions (N, 3)."""
        ranges_m = np.empty(len(directions))
        origins = np.ascontiguousarray(T_world_sensor[:, :3, 3])
        rotations = np.ascontiguousarray(T_world_sensor[:, :3, :3])
        sectors = self._sectors(origins[:, :2], max_range_m)
        cast_rays(
            origins, rotations, pose_of_ray, directions, self.rows, self.ground, *sectors, max_range_m, ranges_m
        )
        return ranges_m

    def _sectors(
        self, origins: Matrix, reach_m: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """``starts``, ``members`` and ``nearest_m`` of ``cast_rays`` for rays from origins (P, 2)."""
        bearing, half, nearest_m = self._extents(origins)
        first, last = (
            np.floor((bearing + side * (half + 1e-9) + np.pi) * (SECTORS / (2.0 * np.pi))).astype(np.int64)
            for side in (-1.0, 1.0)
        )
        near = np.argsort(nearest_m)[: np.count_nonzero(nearest_m <= reach_m)]
        count = np.minimum(last - first + 1, SECTORS)[near]
        place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        sector = (np.repeat(first[near], count) + place) % SECTORS
        order = np.argsort(sector.astype(np.int16), kind="stable")  # sorted by radix
        starts = np.searchsorted(sector[order], np.arange(SECTORS + 1))
        return starts, np.repeat(near, count)[order], nearest_m

    def _extents(self, origins: Matrix) -> NDArray[np.float64]:
        """Bearing, half angle and nearest distance (3, S) of each solid, seen from the middle of the origins.

        A ray from anywhere within ``slack`` of the middle that hits the solid has an azimuth in that interval,
        because the parallel ray from the middle hits the footprint, a box, grown by ``slack``. Complex numbers are
        positions x + iy.
        """
        x_y, size, turn = self.rows[:, 1:3], self.rows[:, 3:5], self.rows[:, 5:7]
        center, half, ahead = (rows @ [1.0, 1.0j] for rows in (x_y - origins.mean(axis=0), size, turn))
        slack = np.linalg.norm(origins - origins.mean(axis=0), axis=1).max()
        local = center * ahead.conj()  # in the solid's axes
        outside = np.maximum(np.abs([local.real, local.imag]) - size.T, 0.0)
        nearest_m = np.maximum(np.hypot(*outside) - slack, 0.0)
        corners = center + ahead * np.array([half, half.conj(), -half, -half.conj()])
        grown = np.arcsin(np.minimum(slack / np.maximum(np.abs(corners), 1e-9), 1.0))
        half_angle = (np.abs(np.angle(corners * center.conj())) + grown).max(axis=0)
        return np.stack([np.angle(center), np.where(nearest_m > 0.0, half_angle, np.pi), nearest_m])

    def clearance_m(self, xy: Matrix, below_m: float) -> NDArray[np.float64]:
        """Distance in the plane from (N, 2) positions to the nearest solid that begins below ``below_m``."""
        nearest = np.full(len(xy), np.inf)
        low = self.heights[:, 0] - self.ground_height(self.rows[:, 1:3]) < below_m
        for kind, cx, cy, half_x, half_y, c, s, _, _ in self.rows[low]:
            dx, dy = xy[:, 0] - cx, xy[:, 1] - cy
            off_m = np.hypot(dx, dy) - max(half_x, half_y)
            if kind == BOX:
                outside = np.abs([c * dx + s * dy, -s * dx + c * dy]) - [[half_x], [half_y]]
                off_m = np.hypot(*np.maximum(outside, 0.0))
            nearest = np.minimum(nearest, off_m)
        return nearest


class Scenery:
    """A world under construction: solids are added one by one."""

    def __init__(self, ground: NDArray[np.float64] = FLAT) -> None:
        self._ground = ground
        self._rows: list[tuple[float, ...]] = []
        self._owners: list[int] = []
        self._objects = 0
        self._owner = FIXED

    @contextmanager
    def movable(self) -> Iterator[None]:
        """A context: the solids added in it are one object, which may be elsewhere on another day."""
        self._owner = self._objects
        yield
        self._objects += 1
        self._owner = FIXED

    def box(self, center: Pair, size: Pair, z: Pair, yaw_rad: float = 0.0) -> None:
        """Add a box: full lengths along its own axes, heights ``z`` above the ground at its center."""
        half, turn = (0.5 * size[0], 0.5 * size[1]), (np.cos(yaw_rad), np.sin(yaw_rad))
        self._put(BOX, center, half, turn, z)

    def cylinder(self, center: Pair, radius: float, z: Pair) -> None:
        """Add an upright cylinder, heights ``z`` above the ground at its center."""
        self._put(CYLINDER, center, (radius, radius), (1.0, 0.0), z)

    def ellipsoid(self, center: tuple[float, float, float], radii: tuple[float, float, float]) -> None:
        """Add an ellipsoid; its center's height is relative to the ground there."""
        self._put(ELLIPSOID, center[:2], radii[:2], (1.0, 0.0), (center[2], radii[2]))

    def finish(self) -> Solids:
        """The solids added so far."""
        return Solids(np.array(self._rows), np.array(self._owners), self._ground)

    def _put(self, kind: float, place: Pair, half: Pair, turn: Pair, z: Pair) -> None:
        base = float(_height(self._ground, np.array(place)))
        second = z[1] if kind == ELLIPSOID else base + z[1]  # its radius, else the top
        self._rows.append((kind, *place, *half, *turn, base + z[0], second))
        self._owners.append(self._owner)


def _height(ground: NDArray[np.float64], xy: Matrix) -> NDArray[np.float64]:
    g = ground
    height = g[0] + g[1] * np.sin(g[2] * xy[..., 0] + g[3]) + g[4] * np.sin(g[5] * xy[..., 1] + g[6])
    for a, b, c, d in g[7:].reshape(-1, 4):
        height = height + a * np.sin(b * xy[..., 0] + c * xy[..., 1] + d)
    return height
