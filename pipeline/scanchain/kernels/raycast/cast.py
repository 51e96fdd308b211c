"""The nearest surface along each ray of a moving sensor, among boxes, cylinders, ellipsoids and rolling ground."""

import math

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.raycast.extents import extents_of
from scanchain.kernels.raycast.ground import hit_ground
from scanchain.kernels.raycast.solids import hit_solid

SECTORS = 720  # sectors of azimuth; a ray tests only the solids that overlap its own


@njit(nogil=True)
def cast_rays(
    origins, rotations, pose_of_ray, directions, boxes, cylinders, ellipsoids, ground, max_range_m,
    ranges_m, solid_of_ray,
):  # fmt: skip
    """Range to the first hit of every ray and the solid it hit; inf and −1 where nothing is within reach.

    Solids are seen from the outside only: a ray that starts inside one passes through it. Each ray tests the
    solids of its azimuth sector from near to far, passes over those it goes above or below, and stops where the
    next cannot begin before its best hit.

    origins, rotations : (P, 3) meters and (P, 3, 3), sensor poses in the world, near to each other
    pose_of_ray : (N,) int32, the pose that ray n is fired from
    directions : (N, 3) unit, sensor frame
    boxes : (B, 8) center x, y, half lengths x, y, bottom, top, cos and sin of the yaw
    cylinders : (C, 5) center x, y, radius, bottom, top
    ellipsoids : (E, 6) center x, y, z, radii x, y, z
    ground : (7 + 4 W,) z = g0 + g1 sin(g2 x + g3) + g4 sin(g5 y + g6) + Σ a sin(b x + c y + d), W rows a, b, c, d
    max_range_m : reach
    ranges_m : (N,) out
    solid_of_ray : (N,) int32 out, counted through boxes, cylinders, ellipsoids; the ground comes last
    """
    ground_solid = len(boxes) + len(cylinders) + len(ellipsoids)
    extents = extents_of(origins, boxes, cylinders, ellipsoids)
    starts, members = _sectors(extents, max_range_m)
    for n in range(len(directions)):
        p = pose_of_ray[n]
        ox, oy, oz = origins[p, 0], origins[p, 1], origins[p, 2]
        x, y, z = directions[n, 0], directions[n, 1], directions[n, 2]
        dx = rotations[p, 0, 0] * x + rotations[p, 0, 1] * y + rotations[p, 0, 2] * z
        dy = rotations[p, 1, 0] * x + rotations[p, 1, 1] * y + rotations[p, 1, 2] * z
        dz = rotations[p, 2, 0] * x + rotations[p, 2, 1] * y + rotations[p, 2, 2] * z
        steep = dz < -0.1  # hits the ground soon; a shallow ray is mostly stopped by a solid before
        best, hit = max_range_m, -1
        if steep:
            best, hit = _nearer(best, hit, hit_ground(ox, oy, oz, dx, dy, dz, ground, best), ground_solid)
        horizontal = math.sqrt(dx * dx + dy * dy)
        sector = _sector(math.atan2(dy, dx)) % SECTORS
        for k in range(starts[sector], starts[sector + 1]):
            solid = members[k]
            if extents[solid, 2] > best * horizontal:
                break
            if dz < extents[solid, 3] * horizontal - 1e-9 or dz > extents[solid, 4] * horizontal + 1e-9:
                continue
            t = hit_solid(ox, oy, oz, dx, dy, dz, solid, boxes, cylinders, ellipsoids)
            best, hit = _nearer(best, hit, t, solid)
        if not steep:
            best, hit = _nearer(best, hit, hit_ground(ox, oy, oz, dx, dy, dz, ground, best), ground_solid)
        ranges_m[n] = best if hit >= 0 else np.inf
        solid_of_ray[n] = hit


@njit()
def _nearer(best, hit, t, solid):
    return (t, solid) if t < best else (best, hit)


@njit()
def _sector(azimuth_rad):
    return math.floor((azimuth_rad + math.pi) * (SECTORS / (2.0 * math.pi)))


@njit()
def _sectors(extents, max_range_m):
    """The solids that overlap each sector, near to far: ``members[starts[s] : starts[s + 1]]``."""
    order = np.argsort(extents[:, 2], kind="mergesort")
    starts = np.zeros(SECTORS + 1, dtype=np.int64)
    for solid in order:
        first, count = _span(extents[solid], max_range_m)
        for i in range(count):
            starts[(first + i) % SECTORS + 1] += 1
    starts = np.cumsum(starts)
    filled = starts.copy()
    members = np.empty(starts[-1], dtype=np.int64)
    for solid in order:
        first, count = _span(extents[solid], max_range_m)
        for i in range(count):
            sector = (first + i) % SECTORS
            members[filled[sector]] = solid
            filled[sector] += 1
    return starts, members


@njit()
def _span(extent, max_range_m):
    """First sector and number of sectors that an extent overlaps; none beyond the sensor's reach."""
    if extent[2] > max_range_m:
        return 0, 0
    first = _sector(extent[0] - extent[1] - 1e-9)
    return first, min(_sector(extent[0] + extent[1] + 1e-9) - first + 1, SECTORS)
