"""The true normals of the surfaces that rays hit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.simulation.solids import Solids


def surface_normals(places: Matrix, solid_of_place: NDArray[np.int32], solids: Solids) -> Matrix:
    """Outward unit normals (N, 3), world frame, at places (N, 3) on the solids they lie on.

    solid_of_place : (N,) as from ``Solids.strike``: counted through boxes, cylinders, ellipsoids, the ground last
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
