"""Visible extent of each solid: angles and least distance, for all rays of a sensor that moves a little."""

import math

import numpy as np

from scanchain.kernels.compiling import njit


@njit()
def _middle(origins):
    """Middle of the origins in the plane and the largest distance of one from it."""
    x, y, slack = 0.0, 0.0, 0.0
    for i in range(len(origins)):
        x += origins[i, 0] / len(origins)
        y += origins[i, 1] / len(origins)
    for i in range(len(origins)):
        slack = max(slack, math.hypot(origins[i, 0] - x, origins[i, 1] - y))
    return x, y, slack


@njit()
def extents_of(origins, boxes, cylinders, ellipsoids):
    """(S, 5) extent of each solid: bearing, half angle, nearest distance in the plane, slopes between.

    A ray from anywhere within ``slack`` of the middle of the origins that hits the solid has an azimuth in that
    interval, because the parallel ray from the middle hits the footprint grown by ``slack``. Its slope, dz over
    horizontal, lies between those to the solid's bottom and top.
    """
    x, y, slack = _middle(origins)
    low, high = np.min(origins[:, 2]), np.max(origins[:, 2])
    result = np.empty((len(boxes) + len(cylinders) + len(ellipsoids), 5))
    for i in range(len(boxes)):
        far = _box_extent(x, y, slack, boxes[i], result[i])
        _slopes(far, boxes[i, 4] - high, boxes[i, 5] - low, result[i])
    for i in range(len(cylinders)):
        c, out = cylinders[i], result[len(boxes) + i]
        far = _disc_extent(c[0] - x, c[1] - y, c[2] + slack, out)
        _slopes(far, c[3] - high, c[4] - low, out)
    for i in range(len(ellipsoids)):
        e, out = ellipsoids[i], result[len(boxes) + len(cylinders) + i]
        far = _disc_extent(e[0] - x, e[1] - y, max(e[3], e[4]) + slack, out)
        _slopes(far, e[2] - e[5] - high, e[2] + e[5] - low, out)
    return result


@njit()
def _slopes(far, bottom, top, out):
    """Least and greatest slope of a ray to a solid that begins ``out[2]`` away and ends ``far`` away."""
    near = out[2]
    if bottom >= 0.0:
        out[3] = bottom / far
    else:
        out[3] = bottom / near if near > 0.0 else -np.inf
    if top <= 0.0:
        out[4] = top / far
    else:
        out[4] = top / near if near > 0.0 else np.inf


@njit()
def _disc_extent(dx, dy, radius, out):
    """Bearing, half angle and nearest distance of a disc, into ``out``; returns its farthest distance."""
    distance = math.hypot(dx, dy)
    if distance <= radius:
        out[0], out[1], out[2] = 0.0, math.pi, 0.0
    else:
        out[0], out[1], out[2] = math.atan2(dy, dx), math.asin(radius / distance), distance - radius
    return distance + radius


@njit()
def _box_extent(x, y, slack, box, out):
    """Bearing, half angle and nearest distance of a box, into ``out``; returns its farthest distance."""
    dx, dy, c, s = box[0] - x, box[1] - y, box[6], box[7]
    far = math.hypot(dx, dy) + math.hypot(box[2], box[3]) + slack
    outside_x = max(abs(c * dx + s * dy) - box[2], 0.0)
    outside_y = max(abs(-s * dx + c * dy) - box[3], 0.0)
    near = math.hypot(outside_x, outside_y) - slack
    if near <= 0.0:
        out[0], out[1], out[2] = 0.0, math.pi, 0.0
        return far
    bearing, half_angle = math.atan2(dy, dx), 0.0
    for i in range(4):
        u = box[2] if i % 2 else -box[2]
        v = box[3] if i // 2 else -box[3]
        corner_x, corner_y = dx + c * u - s * v, dy + s * u + c * v
        turn = math.atan2(corner_y, corner_x) - bearing
        turn = abs(turn - 2.0 * math.pi * round(turn / (2.0 * math.pi)))
        half_angle = max(half_angle, turn + math.asin(min(slack / math.hypot(corner_x, corner_y), 1.0)))
    out[0], out[1], out[2] = bearing, half_angle, near
    return far
