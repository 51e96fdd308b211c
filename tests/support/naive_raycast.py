"""The ray caster again, slowly: every ray against every solid, from the definition of each surface."""

import numpy as np
from scipy.optimize import brentq

from scanchain.kernels.raycast import BOX, CYLINDER, ELLIPSOID


def _groups(solids):
    """Boxes, cylinders and ellipsoids: place, size, then heights and turn; of ellipsoids center and radii."""
    columns = {BOX: [1, 2, 3, 4, 7, 8, 5, 6], CYLINDER: [1, 2, 3, 7, 8], ELLIPSOID: [1, 2, 7, 3, 4, 8]}
    return [solids.rows[solids.rows[:, 0] == kind][:, chosen] for kind, chosen in columns.items()]


def cast(origin, direction, solids, max_range):
    """Range to the first surface of one ray in the world frame, inf beyond reach."""
    boxes, cylinders, ellipsoids = _groups(solids)
    hits = [np.inf]
    hits += [_box(origin, direction, box) for box in boxes]
    hits += [_cylinder(origin, direction, cylinder) for cylinder in cylinders]
    hits += [_ellipsoid(origin, direction, ellipsoid) for ellipsoid in ellipsoids]
    hits += [_ground(origin, direction, solids, max_range)]
    return min(hits) if min(hits) < max_range else np.inf


def distance_to_surface(points, solids):
    """(N,) distance of each point to the nearest surface; of an ellipsoid and of the ground to first order."""
    boxes, cylinders, ellipsoids = _groups(solids)
    gradient = solids.ground_slope(points[:, :2])
    gap = np.abs(points[:, 2] - solids.ground_height(points[:, :2]))
    nearest = gap / np.sqrt(1.0 + np.sum(gradient**2, axis=1))
    for cx, cy, half_x, half_y, bottom, top, c, s in boxes:
        x, y = points[:, 0] - cx, points[:, 1] - cy
        q = np.stack([abs(c * x + s * y) - half_x, abs(-s * x + c * y) - half_y, _outside(points, bottom, top)])
        nearest = np.minimum(nearest, _to_surface(q))
    for cx, cy, radius, bottom, top in cylinders:
        q = np.stack([np.hypot(points[:, 0] - cx, points[:, 1] - cy) - radius, _outside(points, bottom, top)])
        nearest = np.minimum(nearest, _to_surface(q))
    for ellipsoid in ellipsoids:
        scaled = (points - ellipsoid[:3]) / ellipsoid[3:]
        value = np.sum(scaled**2, axis=1) - 1.0
        slope = np.linalg.norm(2.0 * scaled / ellipsoid[3:], axis=1)
        nearest = np.minimum(nearest, np.abs(value) / np.maximum(slope, 1e-9))
    return nearest


def _outside(points, bottom, top):
    return abs(points[:, 2] - 0.5 * (bottom + top)) - 0.5 * (top - bottom)


def _to_surface(q):
    """Distance to the surface of {q ≤ 0} where each row of q is a distance beyond one pair of faces."""
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=0)
    return np.where(q.max(axis=0) > 0.0, outside, -q.max(axis=0))


def _box(origin, direction, box):
    c, s = box[6], box[7]
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    o = turn @ (origin - [box[0], box[1], 0.5 * (box[4] + box[5])])
    d = turn @ direction
    half = np.array([box[2], box[3], 0.5 * (box[5] - box[4])])
    if np.all(np.abs(o) < half):
        return np.inf
    hits = [np.inf]
    for axis in range(3):
        for face in (-half[axis], half[axis]):
            if d[axis] != 0.0 and (face - o[axis]) / d[axis] > 0.0:
                t = (face - o[axis]) / d[axis]
                others = [other for other in range(3) if other != axis]
                if np.all(np.abs((o + t * d)[others]) <= half[others]):
                    hits.append(t)
    return min(hits)


def _cylinder(origin, direction, cylinder):
    cx, cy, radius, bottom, top = cylinder
    x, y = origin[:2] - [cx, cy]
    if np.hypot(x, y) < radius and bottom < origin[2] < top:
        return np.inf
    hits = [np.inf]
    a, b, c = np.sum(direction[:2] ** 2), 2.0 * np.dot([x, y], direction[:2]), x * x + y * y - radius**2
    for t in _real_roots(a, b, c):
        if t > 0.0 and bottom <= origin[2] + t * direction[2] <= top:
            hits.append(t)
    for level in (bottom, top):
        if direction[2] != 0.0:
            t = (level - origin[2]) / direction[2]
            if t > 0.0 and np.hypot(x + t * direction[0], y + t * direction[1]) <= radius:
                hits.append(t)
    return min(hits)


def _ellipsoid(origin, direction, ellipsoid):
    o, d = (origin - ellipsoid[:3]) / ellipsoid[3:], direction / ellipsoid[3:]
    if o @ o < 1.0:
        return np.inf
    return min([np.inf] + [t for t in _real_roots(d @ d, 2.0 * o @ d, o @ o - 1.0) if t > 0.0])


def _real_roots(a, b, c):
    if a == 0.0:
        return []
    roots = np.roots([a, b, c])
    return [float(root.real) for root in roots if abs(root.imag) < 1e-12]


def _ground(origin, direction, solids, max_range):
    def gap(t):
        place = origin + t * direction
        return place[2] - float(solids.ground_height(place[:2]))

    ts = np.linspace(0.0, max_range, 4001)
    places = origin + ts[:, None] * direction
    below = np.flatnonzero(places[:, 2] < solids.ground_height(places[:, :2]))
    if len(below) == 0:
        return np.inf
    return brentq(gap, ts[below[0] - 1], ts[below[0]], xtol=1e-12)
