"""Downsampling to one point a voxel, and deskewing."""

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.geometry.twist import perturb
from scanchain.kernels.voxels.hashing import EMPTY, find, first_slot, pack

_BLOCK = 2048  # points whose keys are computed at once, which the compiler makes vector instructions of


@njit(nogil=True)
def first_per_voxel(points, voxel_m: float, min_range_m: float, max_range_m: float, table, chosen):
    """Fill ``chosen`` with the indices of the first point in each voxel, near and far points left out.

    points : (N, d) meters from the lidar; chosen : (N,) int32. Returns how many were chosen.
    table : a power of two of slots, at least 2 N, whatever they hold
    Neighbors on a ring mostly share a voxel, so the last key is tried before the table.
    """
    n, slots = points.shape[0], table.size
    table.fill(EMPTY)
    keys, held, rows = np.empty(_BLOCK, np.int64), np.empty(_BLOCK, np.int64), np.empty(_BLOCK, np.int32)
    count = 0
    last = EMPTY
    for start in range(0, n, _BLOCK):
        part = points[start : start + _BLOCK]
        _keys(part, 1.0 / voxel_m, min_range_m * min_range_m, max_range_m * max_range_m, keys)
        tried = 0
        for i in range(part.shape[0]):
            key = keys[i]
            keys[tried], rows[tried] = key, start + i
            tried += (key != last) & (key != EMPTY)
            last = key
        for k in range(tried):  # without a branch on what was read: the processor waits for many slots at once
            held[k] = table[first_slot(slots, keys[k])]
        for k in range(tried):
            if held[k] == keys[k]:
                continue
            slot = find(table, keys[k])
            if slot < 0:
                table[~slot] = keys[k]
                chosen[count] = rows[k]
                count += 1
    return count


@njit(nogil=True)
def _keys(points, scale: float, low: float, high: float, keys):
    """Write the key of each point's voxel, EMPTY for squared ranges below low or above high."""
    planar = points.shape[1] == 2
    for i in range(points.shape[0]):
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        z = 0.0 if planar else np.float64(points[i, 2])
        square = x * x + y * y + z * z
        ix, iy, iz = np.int32(np.floor(x * scale)), np.int32(np.floor(y * scale)), np.int32(np.floor(z * scale))
        key = pack(int(ix), int(iy), int(iz))
        keys[i] = key if (low <= square) & (square <= high) else EMPTY


@njit(nogil=True)
def gather(points, chosen, out):
    """Copy the chosen rows of points (N, d) to ``out`` (M, d)."""
    for k in range(out.shape[0]):
        for axis in range(out.shape[1]):
            out[k, axis] = points[chosen[k], axis]


@njit(nogil=True)
def deskew(points, shares, twist):
    """Move each point, in place, to its position as seen by the lidar at one instant, usually the scan's middle.

    points : (N, d) meters, each in the lidar frame of its own instant
    shares : (N,) time from that instant to the point's own, in units of the time in which the lidar moves by twist
    twist : (k,) constant velocity; the pose at share τ is T exp(τ ξ), so that p ← exp(τ ξ) p
    """
    d = points.shape[1]
    origin = np.zeros(3)
    start, moved = np.eye(d + 1), np.eye(d + 1)
    part = np.empty(twist.shape[0])
    last = np.nan
    for i in range(points.shape[0]):
        if shares[i] != last:
            last = shares[i]
            for k in range(twist.shape[0]):
                part[k] = twist[k] * last
            perturb(part, start, origin, moved)
        x, y = points[i, 0], points[i, 1]
        z = points[i, 2] if d == 3 else 0.0
        for axis in range(d):
            value = moved[axis, 0] * x + moved[axis, 1] * y + moved[axis, d]
            if d == 3:
                value += moved[axis, 2] * z
            points[i, axis] = value
