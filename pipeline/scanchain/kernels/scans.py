"""Preprocessing of a scan: valid points, one per voxel, deskewed."""

import math

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.geometry import between, inverse, perturb
from scanchain.kernels.voxels import EMPTY, find, first_slot, pack

_TERMS = 9  # of the power series in the squared angle, up to 1 rad
_INVERSE_FACTORIALS = tuple(1.0 / math.factorial(n) for n in range(2 * _TERMS + 3))
_BLOCK = 2048  # points whose keys are computed together, in a loop that the compiler vectorizes


@njit(nogil=True)
def first_per_voxel(points, voxel_m: float, min_range_m: float, max_range_m: float, table, chosen):
    """Fill ``chosen`` with the indices of the first point in each voxel, without near and far points.

    points : (N, d) meters from the lidar
    table : int64, a power of two of slots, with any contents; chosen : int32, half as many
    Returns the number chosen, −1 where there was not enough room; 2 N slots always suffice.
    Neighbors on a ring mostly share a voxel, so the last key is compared before the table is probed.
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
        for k in range(tried):  # without branches on values read, so that the cache misses overlap
            held[k] = table[first_slot(slots, keys[k])]
        for k in range(tried):
            if held[k] == keys[k]:
                continue
            slot = find(table, keys[k])
            if slot < 0:
                if count == chosen.size:
                    return -1
                table[~slot] = keys[k]
                chosen[count] = rows[k]
                count += 1
    return count


@njit(inline="always")
def _keys(points, scale: float, low: float, high: float, keys):
    """Write the key of each point's voxel, EMPTY for squared ranges below low or above high.

    Reads at a fixed stride are vectorized; the compiler does not know the row length of ``points``.
    """
    flat = points.reshape(-1)
    if points.shape[1] == 2:
        for i in range(points.shape[0]):
            keys[i] = _key_in_range(flat[2 * i], flat[2 * i + 1], 0.0, scale, low, high)
    else:
        for i in range(points.shape[0]):
            keys[i] = _key_in_range(flat[3 * i], flat[3 * i + 1], flat[3 * i + 2], scale, low, high)


@njit(inline="always")
def _key_in_range(x, y, z, scale: float, low: float, high: float):
    x, y, z = np.float64(x), np.float64(y), np.float64(z)
    square = x * x + y * y + z * z
    ix, iy, iz = np.int32(np.floor(x * scale)), np.int32(np.floor(y * scale)), np.int32(np.floor(z * scale))
    key = pack(int(ix), int(iy), int(iz))
    return key if (low <= square) & (square <= high) else EMPTY


@njit(nogil=True)
def deskew_in_plane(points, shares, twist):
    """Move each point, in place, to its position as seen by the lidar at one instant, usually the scan's middle.

    points : (N, 2) meters, each in the lidar frame of its own instant
    shares : (N,) time from that instant to the point's own, in units of the time in which the lidar moves by twist
    twist : (3,) constant velocity; the pose at share τ is T exp(τ ξ), so that p ← exp(τ ξ) p
    """
    origin, start, moved = np.zeros(3), np.eye(3), np.eye(3)
    part = np.empty(3)
    last = np.nan
    for i in range(points.shape[0]):
        if shares[i] != last:
            last = shares[i]
            for k in range(3):
                part[k] = twist[k] * last
            perturb(part, start, origin, moved)
        x, y = points[i, 0], points[i, 1]
        for axis in range(2):
            points[i, axis] = moved[axis, 0] * x + moved[axis, 1] * y + moved[axis, 2]


@njit(nogil=True)
def deskew_in_space(points, shares, twist):
    """``deskew_in_plane`` for points (N, 3) and a twist (6,): Rodrigues' formula (Barfoot 2017, 7.86) on vectors.

    exp(τ ξ) p = p + τ ρ + φ × (a τ p + b τ² ρ + φ × (b τ² p + c τ³ ρ)) with ξ = (ρ, φ), θ = τ |φ| and the series
    a = Σ (−θ²)ⁿ/(2n+1)!, b = Σ (−θ²)ⁿ/(2n+2)!, c = Σ (−θ²)ⁿ/(2n+3)!. A turn of more than 1 rad is taken in steps.
    """
    flat, x, y, z = points.reshape(-1), twist[3], twist[4], twist[5]
    square = x * x + y * y + z * z
    longest = np.abs(shares).max() if shares.size else 0.0
    steps = int(np.ceil(min(max(np.sqrt(square) * longest, 1.0), 100.0)))  # no lidar turns by 100 rad per sweep
    ru, rv, rw = twist[0], twist[1], twist[2]
    for _ in range(steps):
        for i in range(shares.shape[0]):
            share, u, v, w = shares[i] / steps, flat[3 * i], flat[3 * i + 1], flat[3 * i + 2]
            share2 = share * share
            s = -square * share2
            a, b, c = _series(s, 1) * share, _series(s, 2) * share2, _series(s, 3) * share2 * share
            du, dv, dw = b * u + c * ru, b * v + c * rv, b * w + c * rw
            eu = a * u + b * ru + y * dw - z * dv
            ev = a * v + b * rv + z * du - x * dw
            ew = a * w + b * rw + x * dv - y * du
            flat[3 * i] = u + share * ru + y * ew - z * ev
            flat[3 * i + 1] = v + share * rv + z * eu - x * ew
            flat[3 * i + 2] = w + share * rw + x * ev - y * eu


@njit(nogil=True)
def poses_along(knots_s, rates, velocity, step_rad: float):
    """Times (P,) and poses (P, d+1, d+1) of the lidar in its own frame at time 0, which lies between two knots.

    knots_s : (K,) ascending; rates : (K−1, r) rad/s between them, r = 1 in the plane, 3 in space
    velocity : (d,) m/s, like the rates in the lidar's frame of each instant
    step_rad : largest rotation from one pose to the next
    """
    d, r = velocity.size, rates.shape[1]
    parts = np.empty(rates.shape[0], np.int64)
    for k in range(parts.size):
        turn = np.sqrt(np.sum(rates[k] * rates[k])) * (knots_s[k + 1] - knots_s[k])
        parts[k] = max(math.ceil(turn / step_rad), 1)
    times_s, inverses = np.empty(parts.sum() + 1), np.empty((parts.sum() + 1, d + 1, d + 1))
    T, origin, twist = np.eye(d + 1), np.zeros(3), np.empty(d + r)
    middle, count = np.eye(d + 1), 0
    for k in range(parts.size):
        step_s = (knots_s[k + 1] - knots_s[k]) / parts[k]
        for part in range(parts[k]):
            begin_s = knots_s[k] + part * step_s
            times_s[count], inverses[count] = begin_s, T
            if begin_s <= 0.0:
                twist[:d], twist[d:] = begin_s * velocity, begin_s * rates[k]
                perturb(twist, T.copy(), origin, middle)
            twist[:d], twist[d:] = -step_s * velocity, -step_s * rates[k]
            perturb(twist, T.copy(), origin, T)
            count += 1
    times_s[count], inverses[count] = knots_s[-1], T
    poses, to_middle = np.empty_like(inverses), inverse(middle)
    for k in range(count + 1):
        poses[k] = between(to_middle, inverse(inverses[k]))
    return times_s, poses


@njit(nogil=True)
def deskew_along(points, times_s, knots_s, poses):
    """Move each point, in place, by the pose of the lidar at its time, linear between knots close together.

    points : (N, d) meters, each in the lidar frame of its own instant, at times_s (N,)
    knots_s : (K,) ascending; poses : (K, d+1, d+1) of the lidar at these, in the frame that is wanted
    """
    d, last = points.shape[1], knots_s.size - 2
    k, moved = 0, np.empty(3)
    for i in range(points.shape[0]):
        at_s = times_s[i]
        while k < last and at_s >= knots_s[k + 1]:
            k += 1
        while k > 0 and at_s < knots_s[k]:
            k -= 1
        share = (at_s - knots_s[k]) / (knots_s[k + 1] - knots_s[k])
        for row in range(d):
            total = poses[k, row, d] + share * (poses[k + 1, row, d] - poses[k, row, d])
            for column in range(d):
                between = poses[k, row, column] + share * (poses[k + 1, row, column] - poses[k, row, column])
                total += between * points[i, column]
            moved[row] = total
        for row in range(d):
            points[i, row] = moved[row]


@njit(nogil=True)
def raise_elevation(points, offset_rad: float):
    """Points (N, 3) in the lidar frame with their elevation angles raised."""
    sine, cosine, raised = np.sin(offset_rad), np.cos(offset_rad), np.empty(points.shape)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        level = max(np.sqrt(x * x + y * y), 1e-9)
        stretch = cosine - sine * z / level
        raised[i, 0], raised[i, 1], raised[i, 2] = stretch * x, stretch * y, cosine * z + sine * level
    return raised


@njit(forceinline=True)
def _series(s: float, first: int) -> float:
    """Σ sⁿ/(2n + first)!, to 1e-17 for |s| ≤ 1."""
    total = 0.0
    for n in range(_TERMS - 1, -1, -1):
        total = total * s + _INVERSE_FACTORIALS[2 * n + first]
    return total


@njit(nogil=True)
def keep_valid(x, y, z, low_square: float, high_square: float, points, kept):
    """Copy the points whose squared range is finite, above low_square and at most high_square, in their order.

    x, y, z : (N,) float32 meters, with the stride of the records
    points : (N, 3) float32, filled from the front; kept : (N,) int32, the index of each in the cloud
    Returns the number kept. NaN fails both comparisons.
    """
    count = 0
    for i in range(x.size):
        u, v, w = x[i], y[i], z[i]
        square = u * u + v * v + w * w
        if low_square < square <= high_square:
            points[count, 0], points[count, 1], points[count, 2] = u, v, w
            kept[count] = i
            count += 1
    return count
