"""Solids of a simulated world, and its construction."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.kernels.raycast import SECTORS, cast_rays

FLAT = np.zeros(7)
FIXED = -1  # owner of solids that belong to no movable object


@dataclass(frozen=True, slots=True)
class Solids:
    """Closed solids above a rolling ground, meters, world frame.

    Attributes
    ----------
    boxes : (B, 8) center x, y, half lengths x, y, bottom, top, cos and sin of the yaw
    cylinders : (C, 5) upright: center x, y, radius, bottom, top
    ellipsoids : (E, 6) center x, y, z, radii x, y, z
    ground : (7 + 4 W,) z = g0 + g1 sin(g2 x + g3) + g4 sin(g5 y + g6) + Σ a sin(b x + c y + d), W rows a, b, c, d
    owner : (B + C + E,) number of the movable object that each solid is a part of, FIXED for none; (0,) where
        nothing is movable
    """

    boxes: Matrix
    cylinders: Matrix
    ellipsoids: Matrix
    ground: NDArray[np.float64]
    owner: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def groups(self) -> tuple[Matrix, Matrix, Matrix]:
        """Boxes, cylinders, ellipsoids."""
        return self.boxes, self.cylinders, self.ellipsoids

    def part(self, chosen: NDArray[np.bool_]) -> Solids:
        """Some of the solids, chosen by (B + C + E,)."""
        of_group = np.split(chosen, np.cumsum([len(rows) for rows in self.groups[:2]]))
        groups = (rows[each] for rows, each in zip(self.groups, of_group, strict=True))
        return Solids(*groups, ground=self.ground, owner=self.owner[chosen])

    def with_object(self, thing: Solids, owner: int) -> Solids:
        """These and those of one object, of that number."""
        groups = [np.vstack(both) for both in zip(self.groups, thing.groups, strict=True)]
        owners = np.split(self.owner, np.cumsum([len(rows) for rows in self.groups[:2]]))
        numbers = (np.full(len(rows), owner) for rows in thing.groups)
        of_both = [each for both in zip(owners, numbers, strict=True) for each in both]
        return Solids(*groups, ground=self.ground, owner=np.concatenate(of_both))

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
        """Range to the first surface along each ray, inf beyond reach; poses (P, 4, 4), directions (N, 3)."""
        ranges_m = np.empty(len(directions))
        origins = np.ascontiguousarray(T_world_sensor[:, :3, 3])
        rotations = np.ascontiguousarray(T_world_sensor[:, :3, :3])
        sectors = self._sectors(origins[:, :2], max_range_m)
        cast_rays(
            origins, rotations, pose_of_ray, directions, *self.groups, self.ground, *sectors, max_range_m, ranges_m
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
        upright = np.tile([1.0, 0.0], (len(self.cylinders) + len(self.ellipsoids), 1))
        x_y = np.concatenate([rows[:, :2] for rows in self.groups])
        size = np.concatenate([self.boxes[:, 2:4], self.cylinders[:, [2, 2]], self.ellipsoids[:, 3:5]])
        turn = np.concatenate([self.boxes[:, 6:8], upright])
        center, half, ahead = (rows @ [1.0, 1.0j] for rows in (x_y - origins.mean(axis=0), size, turn))
        slack = np.linalg.norm(origins - origins.mean(axis=0), axis=1).max()
        beside = center * ahead.conj()
        outside = np.maximum(np.abs([beside.real, beside.imag]) - size.T, 0.0)
        nearest_m = np.maximum(np.hypot(*outside) - slack, 0.0)
        corners = center + ahead * np.array([half, half.conj(), -half, -half.conj()])
        grown = np.arcsin(np.minimum(slack / np.maximum(np.abs(corners), 1e-9), 1.0))
        half_angle = (np.abs(np.angle(corners * center.conj())) + grown).max(axis=0)
        return np.stack([np.angle(center), np.where(nearest_m > 0.0, half_angle, np.pi), nearest_m])

    def clearance_m(self, xy: Matrix, below_m: float) -> NDArray[np.float64]:
        """Distance in the plane from (N, 2) positions to the nearest solid that begins below ``below_m``."""
        nearest = np.full(len(xy), np.inf)
        for cx, cy, half_x, half_y, _, _, c, s in self._low(self.boxes, 4, below_m):
            dx, dy = xy[:, 0] - cx, xy[:, 1] - cy
            outside_x = np.maximum(np.abs(c * dx + s * dy) - half_x, 0.0)
            outside_y = np.maximum(np.abs(-s * dx + c * dy) - half_y, 0.0)
            nearest = np.minimum(nearest, np.hypot(outside_x, outside_y))
        for cx, cy, radius, _, _ in self._low(self.cylinders, 3, below_m):
            nearest = np.minimum(nearest, np.hypot(xy[:, 0] - cx, xy[:, 1] - cy) - radius)
        low = self.ellipsoids[:, 2] - self.ellipsoids[:, 5] - self.ground_height(self.ellipsoids[:, :2]) < below_m
        for cx, cy, _, radius_x, radius_y, _ in self.ellipsoids[low]:
            nearest = np.minimum(nearest, np.hypot(xy[:, 0] - cx, xy[:, 1] - cy) - max(radius_x, radius_y))
        return nearest

    def _low(self, solids: Matrix, bottom_column: int, below_m: float) -> Matrix:
        return solids[solids[:, bottom_column] - self.ground_height(solids[:, :2]) < below_m]


class Scenery:
    """A world under construction: solids are put down one by one and keep off what must stay free."""

    def __init__(self, ground: NDArray[np.float64] = FLAT) -> None:
        self._ground = ground
        self._boxes: list[tuple[float, ...]] = []  # each behind the number of the object that it is a part of
        self._cylinders: list[tuple[float, ...]] = []
        self._ellipsoids: list[tuple[float, ...]] = []
        self._objects = 0
        self._owner = FIXED

    @contextmanager
    def movable(self) -> Iterator[None]:
        """A context: what is put down in it is one object, which may stand elsewhere another day."""
        self._owner = self._objects
        yield
        self._objects += 1
        self._owner = FIXED

    def box(
        self, center: tuple[float, float], size: tuple[float, float], z: tuple[float, float], yaw_rad: float = 0.0
    ) -> None:
        """Put down a box: full lengths along its own axes, heights ``z`` above the ground at its center."""
        base = self._base(center)
        half = (0.5 * size[0], 0.5 * size[1])
        turn = np.cos(yaw_rad), np.sin(yaw_rad)
        self._boxes.append((self._owner, *center, *half, base + z[0], base + z[1], *turn))

    def cylinder(self, center: tuple[float, float], radius: float, z: tuple[float, float]) -> None:
        """Put down an upright cylinder, heights ``z`` above the ground at its center."""
        base = self._base(center)
        self._cylinders.append((self._owner, *center, radius, base + z[0], base + z[1]))

    def ellipsoid(self, center: tuple[float, float, float], radii: tuple[float, float, float]) -> None:
        """Put down an ellipsoid; its center's height counts from the ground there."""
        x, y, z = center
        self._ellipsoids.append((self._owner, x, y, z + self._base((x, y)), *radii))

    def finish(self) -> Solids:
        """The solids put down so far."""
        groups = (self._boxes, 8), (self._cylinders, 5), (self._ellipsoids, 6)
        rows = [np.array(group, dtype=np.float64).reshape(-1, 1 + width) for group, width in groups]
        owner = np.concatenate([each[:, 0] for each in rows]).astype(np.int64)
        return Solids(*(each[:, 1:].copy() for each in rows), ground=self._ground, owner=owner)

    def _base(self, center: tuple[float, float]) -> float:
        return float(_height(self._ground, np.array(center)))


def _height(ground: NDArray[np.float64], xy: Matrix) -> NDArray[np.float64]:
    g = ground
    height = g[0] + g[1] * np.sin(g[2] * xy[..., 0] + g[3]) + g[4] * np.sin(g[5] * xy[..., 1] + g[6])
    for a, b, c, d in g[7:].reshape(-1, 4):
        height = height + a * np.sin(b * xy[..., 0] + c * xy[..., 1] + d)
    return height
