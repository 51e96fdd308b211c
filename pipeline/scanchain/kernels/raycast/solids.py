"""Intersection of a ray with a box, a cylinder or an ellipsoid."""

import math

import numpy as np

from scanchain.kernels.compiling import njit


@njit()
def hit_solid(ox, oy, oz, dx, dy, dz, solid, boxes, cylinders, ellipsoids):
    """Distance at which a ray enters the solid of that number, inf if it does not."""
    if solid < len(boxes):
        return _hit_box(ox, oy, oz, dx, dy, dz, boxes[solid])
    solid -= len(boxes)
    if solid < len(cylinders):
        return _hit_cylinder(ox, oy, oz, dx, dy, dz, cylinders[solid])
    return _hit_ellipsoid(ox, oy, oz, dx, dy, dz, ellipsoids[solid - len(cylinders)])


@njit()
def _slab(o, d, low, high):
    """Interval of t in which o + t d lies between two planes (Kay & Kajiya 1986)."""
    if abs(d) < 1e-12:
        return (-np.inf, np.inf) if low <= o <= high else (np.inf, -np.inf)
    a, b = (low - o) / d, (high - o) / d
    return min(a, b), max(a, b)


@njit()
def _hit_box(ox, oy, oz, dx, dy, dz, box):
    x, y, c, s = ox - box[0], oy - box[1], box[6], box[7]
    enter_x, leave_x = _slab(c * x + s * y, c * dx + s * dy, -box[2], box[2])
    enter_y, leave_y = _slab(-s * x + c * y, -s * dx + c * dy, -box[3], box[3])
    enter_z, leave_z = _slab(oz, dz, box[4], box[5])
    enter, leave = max(enter_x, enter_y, enter_z), min(leave_x, leave_y, leave_z)
    return enter if 0.0 < enter <= leave else np.inf


@njit()
def _hit_cylinder(ox, oy, oz, dx, dy, dz, cylinder):
    x, y = ox - cylinder[0], oy - cylinder[1]
    a, b = dx * dx + dy * dy, x * dx + y * dy
    c = x * x + y * y - cylinder[2] * cylinder[2]
    enter, leave = _slab(oz, dz, cylinder[3], cylinder[4])
    if a > 1e-24:
        discriminant = b * b - a * c
        if discriminant < 0.0:
            return np.inf
        root = math.sqrt(discriminant)
        enter, leave = max(enter, (-b - root) / a), min(leave, (-b + root) / a)
    elif c > 0.0:
        return np.inf
    return enter if 0.0 < enter <= leave else np.inf


@njit()
def _hit_ellipsoid(ox, oy, oz, dx, dy, dz, ellipsoid):
    x, y, z = (
        (ox - ellipsoid[0]) / ellipsoid[3],
        (oy - ellipsoid[1]) / ellipsoid[4],
        (oz - ellipsoid[2]) / ellipsoid[5],
    )
    u, v, w = dx / ellipsoid[3], dy / ellipsoid[4], dz / ellipsoid[5]
    a, b, c = u * u + v * v + w * w, x * u + y * v + z * w, x * x + y * y + z * z - 1.0
    discriminant = b * b - a * c
    if discriminant < 0.0:
        return np.inf
    enter = (-b - math.sqrt(discriminant)) / a
    return enter if enter > 0.0 else np.inf
