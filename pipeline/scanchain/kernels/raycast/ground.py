"""Intersection of a ray with rolling ground."""

import math

import numpy as np

from scanchain.kernels.compiling import njit


@njit()
def hit_ground(ox, oy, oz, dx, dy, dz, ground, max_range_m):
    """Distance at which a ray from above first meets the ground, inf if it does not.

    Rough ground lies below its two long waves lifted by the sum of the short ones, so the ray meets those first.
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
    """Distance of the first root of the gap f(t) = z − h at or beyond ``start_m``, before which there is none.

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
        if left < 1e-9:  # meters that the step may have left to go
            return t
    return np.inf


@njit()
def _steepest(dx, dy, dz, ground):
    """Bounds of the speed at which a ray and the ground approach each other, and of its derivative."""
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
