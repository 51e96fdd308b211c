"""The nearest surface along each ray of a moving sensor, among boxes, cylinders, ellipsoids and rolling ground."""

import math

import numpy as np

from scanchain.kernels.compiling import njit

BOX, CYLINDER, ELLIPSOID = 0.0, 1.0, 2.0
SECTORS = 720  # sectors of azimuth; a ray tests only the solids that overlap its own


@njit(nogil=True)
def cast_rays(
    origins, rotations, pose_of_ray, directions, solids, ground, starts, members, nearest_m, max_range_m, ranges_m
):
    """Range to the first hit of every ray; inf where nothing is within reach.

    Solids are seen from the outside only: a ray that starts inside one passes through it. Each ray tests the
    solids of its azimuth sector from near to far, and stops where the next begins beyond its nearest hit so far.

    origins, rotations : (P, 3) meters and (P, 3, 3), sensor poses in the world, near to each other
    pose_of_ray : (N,) int32, the pose that ray n is fired from
    directions : (N, 3) unit, sensor frame
    solids : (S, 9) kind; center x, y; half lengths, or radii, x, y; cos and sin of the yaw; bottom and top, or of
        ellipsoids center z and radius z
    ground : (7 + 4 W,) z = g0 + g1 sin(g2 x + g3) + g4 sin(g5 y + g6) + Σ a sin(b x + c y + d), W rows a, b, c, d
    starts, members : solids of sector s are ``members[starts[s] : starts[s + 1]]``, near to far
    nearest_m : (S,) horizontal distance within which no ray hits that solid
    max_range_m : reach
    ranges_m : (N,) out
    """
    for n in range(len(directions)):
        p = pose_of_ray[n]
        ox, oy, oz = origins[p, 0], origins[p, 1], origins[p, 2]
        x, y, z = directions[n, 0], directions[n, 1], directions[n, 2]
        dx = rotations[p, 0, 0] * x + rotations[p, 0, 1] * y + rotations[p, 0, 2] * z
        dy = rotations[p, 1, 0] * x + rotations[p, 1, 1] * y + rotations[p, 1, 2] * z
        dz = rotations[p, 2, 0] * x + rotations[p, 2, 1] * y + rotations[p, 2, 2] * z
        steep = dz < -0.1  # soon hits the ground; a shallow ray mostly hits a solid first
        best = max_range_m
        if steep:
            best = min(best, hit_ground(ox, oy, oz, dx, dy, dz, ground, best))
        horizontal = math.sqrt(dx * dx + dy * dy)
        sector = math.floor((math.atan2(dy, dx) + math.pi) * (SECTORS / (2.0 * math.pi))) % SECTORS
        for k in range(starts[sector], starts[sector + 1]):
            if nearest_m[members[k]] > best * horizontal:
                break
            best = min(best, hit_solid(ox, oy, oz, dx, dy, dz, solids[members[k]]))
        if not steep:
            best = min(best, hit_ground(ox, oy, oz, dx, dy, dz, ground, best))
        ranges_m[n] = best if best < max_range_m else np.inf


@njit(inline="always")
def hit_solid(ox, oy, oz, dx, dy, dz, solid):
    """Distance at which a ray enters a solid (9,), inf if it does not."""
    if solid[0] == BOX:
        return _hit_box(ox, oy, oz, dx, dy, dz, solid)
    if solid[0] == CYLINDER:
        return _hit_cylinder(ox, oy, oz, dx, dy, dz, solid)
    return _hit_ellipsoid(ox, oy, oz, dx, dy, dz, solid)


@njit(inline="always")
def _slab(o, d, low, high):
    """Interval of t in which o + t d lies between two planes (Kay & Kajiya 1986)."""
    if abs(d) < 1e-12:
        return (-np.inf, np.inf) if low <= o <= high else (np.inf, -np.inf)
    a, b = (low - o) / d, (high - o) / d
    return min(a, b), max(a, b)


@njit(inline="always")
def _hit_box(ox, oy, oz, dx, dy, dz, box):
    x, y, c, s = ox - box[1], oy - box[2], box[5], box[6]
    enter_x, leave_x = _slab(c * x + s * y, c * dx + s * dy, -box[3], box[3])
    enter_y, leave_y = _slab(-s * x + c * y, -s * dx + c * dy, -box[4], box[4])
    enter_z, leave_z = _slab(oz, dz, box[7], box[8])
    enter, leave = max(enter_x, enter_y, enter_z), min(leave_x, leave_y, leave_z)
    return enter if 0.0 < enter <= leave else np.inf


@njit(inline="always")
def _hit_cylinder(ox, oy, oz, dx, dy, dz, cylinder):
    x, y = ox - cylinder[1], oy - cylinder[2]
    a, b = dx * dx + dy * dy, x * dx + y * dy
    c = x * x + y * y - cylinder[3] * cylinder[3]
    enter, leave = _slab(oz, dz, cylinder[7], cylinder[8])
    if a > 1e-24:
        discriminant = b * b - a * c
        if discriminant < 0.0:
            return np.inf
        root = math.sqrt(discriminant)
        enter, leave = max(enter, (-b - root) / a), min(leave, (-b + root) / a)
    elif c > 0.0:
        return np.inf
    return enter if 0.0 < enter <= leave else np.inf


@njit(inline="always")
def _hit_ellipsoid(ox, oy, oz, dx, dy, dz, e):
    x, y, z = (ox - e[1]) / e[3], (oy - e[2]) / e[4], (oz - e[7]) / e[8]
    u, v, w = dx / e[3], dy / e[4], dz / e[8]
    a, b, c = u * u + v * v + w * w, x * u + y * v + z * w, x * x + y * y + z * z - 1.0
    discriminant = b * b - a * c
    if discriminant < 0.0:
        return np.inf
    enter = (-b - math.sqrt(discriminant)) / a
    return enter if enter > 0.0 else np.inf


@njit()
def hit_ground(ox, oy, oz, dx, dy, dz, ground, max_range_m):
    """Distance at which a ray from above first meets the ground, inf if it does not.

    Rough ground lies below its two long waves raised by the amplitudes of the short ones, which the ray
    meets first.
    """
    if len(ground) == 7:
        return _descend(ox, oy, oz, dx, dy, dz, ground, 0.0, max_range_m)
    smooth, lift = ground[:7], 0.0
    for k in range(7, len(ground), 4):
        lift += abs(ground[k])
    start, clear = 0.0, oz - lift
    if _gap(ox, oy, clear, dx, dy, dz, smooth)[0] > 0.0:
        start = _descend(ox, oy, clear, dx, dy, dz, smooth, 0.0, max_range_m)
    return _descend(ox, oy, oz, dx, dy, dz, ground, start, max_range_m)


@njit()
def _descend(ox, oy, oz, dx, dy, dz, ground, start_m, max_range_m):
    """Distance of the first root of the gap f(t) = z − h at or beyond ``start_m``, which has none before it.

    |f'| is at most ``closing`` and |f''| at most ``curvature``, so a step of f / closing never jumps over a crest,
    nor does (f' + √(f'² + 2 curvature f)) / curvature, which is tried too where the ground is rough. Where
    curvature · |f| < f'² / 2 the first root is the only one ahead and Newton finds it.
    """
    closing, curvature = _steepest(dx, dy, dz, ground)
    rough, t = len(ground) > 7, start_m
    if closing <= 0.0 or t > max_range_m:
        return np.inf
    for _ in range(200):
        gap, slope = _gap(ox + t * dx, oy + t * dy, oz + t * dz, dx, dy, dz, ground)
        newton = slope < 0.0 and curvature * abs(gap) < 0.5 * slope * slope
        if newton:
            step, left = gap / -slope, curvature * gap * gap / abs(2.0 * slope * slope * slope)
        else:
            step, left = gap / closing, abs(gap / closing)
            if rough:
                step = max(step, (slope + math.sqrt(max(slope * slope + 2.0 * curvature * gap, 0.0))) / curvature)
        t += step
        if t > max_range_m or t < 0.0:
            return np.inf
        if left < 1e-9:  # bound of the remaining error, meters
            return t
    return np.inf


@njit(inline="always")
def _steepest(dx, dy, dz, ground):
    """Upper bounds of the speed at which a ray and the ground approach each other, and of its derivative."""
    slope_x, slope_y = ground[1] * ground[2], ground[4] * ground[5]
    closing = abs(slope_x * dx) + abs(slope_y * dy) - dz
    curvature = abs(slope_x * ground[2]) + abs(slope_y * ground[5])
    for k in range(7, len(ground), 4):
        a, b, c = ground[k], ground[k + 1], ground[k + 2]
        closing += abs(a * (b * dx + c * dy))
        curvature += abs(a) * (b * b + c * c)
    return closing, curvature


@njit()
def _gap(x, y, z, dx, dy, dz, ground):
    """Height of a position above the ground and its change along the ray."""
    phase_x, phase_y = ground[2] * x + ground[3], ground[5] * y + ground[6]
    gap = z - ground[0] - ground[1] * math.sin(phase_x) - ground[4] * math.sin(phase_y)
    slope = dz - ground[1] * ground[2] * math.cos(phase_x) * dx - ground[4] * ground[5] * math.cos(phase_y) * dy
    for k in range(7, len(ground), 4):
        a, b, c = ground[k], ground[k + 1], ground[k + 2]
        phase = b * x + c * y + ground[k + 3]
        gap -= a * math.sin(phase)
        slope -= a * math.cos(phase) * (b * dx + c * dy)
    return gap, slope
