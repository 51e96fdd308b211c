"""Information of an ideal scan about the motion, from the true normals of the surfaces that its rays hit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose
from scanchain.simulation.sensors import Sensor
from scanchain.simulation.solids import Solids


def information(solids: Solids, T_world_lidar: Pose, sensor: Sensor, *, index: int = 0) -> Matrix:
    """Point-to-plane information H (6, 6) = Σ JᵀJ of an ideal scan number ``index`` taken standing at a pose.

    A right twist ξ = (ρ, φ), T ← T exp(ξ), moves a return p with true normal n, both in the lidar's frame, by
        r = nᵀ(ρ + φ × p)        J = ∂r/∂ξ = [nᵀ, (p × n)ᵀ]
    There is neither noise nor loss. H / σ² is the information where ranges are good to σ along the normals.
    """
    rays = sensor.rays(index)
    standing, solid_of_ray = np.zeros((2, len(rays.directions)), dtype=np.int32)
    T = T_world_lidar[None]
    ranges_m = solids.cast(T, standing, rays.directions, sensor.max_range_m, solid_of_ray)
    hit = np.isfinite(ranges_m) & (ranges_m >= sensor.min_range_m)
    points = rays.directions[hit] * ranges_m[hit, None]
    R, t = T_world_lidar[:3, :3], T_world_lidar[:3, 3]
    normals = surface_normals(points @ R.T + t, solid_of_ray[hit], solids) @ R
    J = np.hstack([normals, np.cross(points, normals)])
    return J.T @ J


def spectrum(information: Matrix) -> tuple[NDArray[np.float64], Matrix]:
    """Shares (k,) of the returns that constrain each direction, least first, and the directions (k, k) as rows.

    Rotations are measured by what they do to the returns: H is scaled by L = √(Σ|p × n|² / N), N = Σ|n|², so that
    the twist of every row, in meters and radians, moves the returns by about a meter. Shares do not depend on the
    number of returns nor on units; a share of 1e-4 means that H constrains the direction as well as if one
    return in ten thousand faced it squarely.
    """
    k, d = len(information), (len(information) + 1) // 2
    count, levers = np.trace(information[:d, :d]), np.trace(information[d:, d:])
    if count <= 0.0:
        return np.zeros(k), np.eye(k)
    scale = lie.by_component(k, 1.0, float(np.sqrt(count / max(levers, 1e-12 * count))))
    shares, columns = np.linalg.eigh(scale[:, None] * information * scale / count)
    return np.maximum(shares, 0.0), (scale[:, None] * columns).T


def undetermined(information: Matrix, *, share: float = 1e-6) -> Matrix:
    """Twists (K, 6) in the lidar's frame that less than that ``share`` of the returns constrains."""
    shares, twists = spectrum(information)
    return twists[shares < share]


def surface_normals(places: Matrix, solid_of_place: NDArray[np.int32], solids: Solids) -> Matrix:
    """Outward unit normals (N, 3), world frame, at points (N, 3) on the solids they lie on.

    solid_of_place : (N,) as from ``Solids.cast``: counted through boxes, cylinders, ellipsoids, the ground last
    """
    normals = np.empty(places.shape)
    begin = 0
    for group, normal in (
        (solids.boxes, _of_boxes), (solids.cylinders, _of_cylinders), (solids.ellipsoids, _of_ellipsoids)
    ):  # fmt: skip
        here = (begin <= solid_of_place) & (solid_of_place < begin + len(group))
        normals[here] = normal(places[here], group[solid_of_place[here] - begin])
        begin += len(group)
    here = solid_of_place == begin
    slope = solids.ground_slope(places[here, :2])
    normals[here] = np.column_stack([-slope, np.ones(len(slope))])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _of_boxes(places: Matrix, boxes: Matrix) -> Matrix:
    """The face whose plane is nearest."""
    cx, cy, half_x, half_y, bottom, top, c, s = boxes.T
    x, y = places[:, 0] - cx, places[:, 1] - cy
    offset = np.stack([c * x + s * y, -s * x + c * y, places[:, 2] - 0.5 * (bottom + top)], axis=1)
    inside = np.stack([half_x, half_y, 0.5 * (top - bottom)], axis=1) - np.abs(offset)
    face = np.argmin(inside, axis=1)
    local = np.where(np.arange(3) == face[:, None], np.sign(offset), 0.0)
    return np.stack([c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1], local[:, 2]], axis=1)


def _of_cylinders(places: Matrix, cylinders: Matrix) -> Matrix:
    """The side or an end, whichever is nearer."""
    cx, cy, radius, bottom, top = cylinders.T
    outwards = places[:, :2] - np.stack([cx, cy], axis=1)
    up = places[:, 2] - 0.5 * (bottom + top)
    at_side = np.abs(np.hypot(*outwards.T) - radius) < np.abs(0.5 * (top - bottom) - np.abs(up))
    side = np.column_stack([outwards, np.zeros(len(places))])
    end = np.column_stack([np.zeros((len(places), 2)), np.sign(up)])
    return np.where(at_side[:, None], side, end)


def _of_ellipsoids(places: Matrix, ellipsoids: Matrix) -> Matrix:
    """The gradient of Σ ((x − c) / r)²."""
    return (places - ellipsoids[:, :3]) / ellipsoids[:, 3:] ** 2
