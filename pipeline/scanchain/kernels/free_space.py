"""Points compared with the ranges of a scan from elsewhere: on its surfaces, behind them, or in free space."""

import numpy as np

from scanchain.kernels.compiling import njit

FAR = 1e9  # m, range of bins that no ray fell into
_BLOCK = 256  # points whose directions are computed together


@njit(nogil=True)
def nearest_ranges(points, ranges_m):
    """Fill ``ranges_m`` (E, A) with the least range in each bin of direction, FAR without a point.

    points : (N, 3) meters, lidar frame; rows are E equal steps of elevation from −π/2 to π/2, columns A equal
    steps of azimuth from −π
    """
    ranges_m[:] = FAR
    rows, columns, ranges, heights = _room()
    here = np.eye(4)
    for start in range(0, points.shape[0], _BLOCK):
        part = points[start : start + _BLOCK]
        _locate(part, here, ranges_m.shape, rows, columns, ranges, heights)
        for i in range(part.shape[0]):
            if ranges[i] > 0.0:
                ranges_m[rows[i], columns[i]] = min(ranges_m[rows[i], columns[i]], ranges[i])


@njit(nogil=True)
def compare_ranges(points, T, ranges_m, margin_m: float, margin_share: float):
    """Numbers of points (N, 3), moved by T (4, 4) into the lidar's frame, that agree and that contradict.

    A point agrees where its range is that of its bin, within the margin, ``margin_m`` plus ``margin_share``
    of the range. It contradicts where all rays of its bin ended behind it. Others are occluded or out of view.
    """
    agreeing = contradicting = 0
    rows, columns, ranges, heights = _room()
    for start in range(0, points.shape[0], _BLOCK):
        part = points[start : start + _BLOCK]
        _locate(part, T, ranges_m.shape, rows, columns, ranges, heights)
        for i in range(part.shape[0]):
            range_m, seen_m = ranges[i], ranges_m[rows[i], columns[i]]
            if range_m <= 0.0 or seen_m >= FAR:
                continue
            margin = margin_m + margin_share * seen_m
            if range_m < seen_m - margin:
                contradicting += 1
            elif range_m <= seen_m + margin:
                agreeing += 1
    return agreeing, contradicting


@njit(nogil=True)
def weigh_points(points, spans, T, ranges_m, limits, enough, seen, seen_through):
    """Count, for each point, whether this scan saw a surface there or saw through it.

    All rays that pass within half the window of the point, to its sides and above it, are compared; below it, a
    single bin, or else the ground would confirm what moves above it. The point was seen where the shortest of them
    ended there, within the margin: a thin pole before a far wall is not free space, though most rays miss it. It
    was seen through where the shortest ended behind it, unless that one ended at the same height, as rays do that
    graze the ground, and only if a ray is within a bin of its direction. Where some ended before the point, only
    the bin of its direction is compared: what occludes a point need not occlude its neighbors. Otherwise it is
    occluded or out of view.

    points : (N, 3) meters, world; spans : (S, 2) int64 first and last + 1 of the points to test
    T : (4, 4) T_lidar_world; ranges_m : (E, A) of ``nearest_ranges``; one row for scans in a plane
    limits : (6,) reach m; window m; margin of a range m, and per meter; margin of a height m, and per meter
    enough : points that this many scans saw are not tested again
    seen, seen_through : (N,) int32, changed in place
    """
    reach_m, window_m, margin_m, margin_share, level_m, level_share = limits
    rows, columns, ranges, heights = _room()
    for s in range(spans.shape[0]):
        for start in range(spans[s, 0], spans[s, 1], _BLOCK):
            part = points[start : min(start + _BLOCK, spans[s, 1])]
            _locate(part, T, ranges_m.shape, rows, columns, ranges, heights)
            for k in range(part.shape[0]):
                if seen[start + k] >= enough or ranges[k] > reach_m:
                    continue
                sight = _sight(
                    rows[k], columns[k], ranges[k], heights[k],
                    ranges_m, window_m, margin_m, margin_share, level_m, level_share,
                )  # fmt: skip
                if sight > 0:
                    seen[start + k] += 1
                elif sight < 0:
                    seen_through[start + k] += 1


@njit(forceinline=True)
def _sight(row, column, range_m, z, ranges_m, window_m, margin_m, margin_share, level_m, level_share):
    """1 where a point at that range and height was seen, −1 where it lies in free space, else 0."""
    if range_m <= window_m:
        return 0
    step_rad = 2.0 * np.pi / ranges_m.shape[1]
    margin = margin_m + margin_share * range_m
    if ranges_m[row, column] < range_m - margin:
        return 0
    half = max(int(np.ceil(0.5 * window_m / (range_m * step_rad))), 1)
    nearest_m, row_of_nearest = _least(ranges_m, row, column, half, range_m - margin)
    if nearest_m < range_m - margin:
        nearest_m, row_of_nearest = ranges_m[row, column], row
    if nearest_m >= FAR or nearest_m < range_m - margin:
        return 0
    if nearest_m <= range_m + margin:
        return 1
    if ranges_m.shape[0] > 1:
        height_m = nearest_m * np.sin((row_of_nearest + 0.5) * step_rad - 0.5 * np.pi)
        if abs(height_m - z) <= level_m + level_share * nearest_m:
            return 0
    return -1 if _least(ranges_m, row, column, 1, FAR)[0] < FAR else 0


@njit(forceinline=True)
def _least(ranges_m, row, column, half, enough_m):
    """Least range, or any below ``enough_m``, and its row, in bins at most ``half`` away, at most 1 below.

    Columns wrap around.
    """
    rows, columns = ranges_m.shape
    least_m, row_of_least = FAR, row
    for r in range(max(row - 1, 0), min(row + half, rows - 1) + 1):
        for c in range(column - half, column + half + 1):
            range_m = ranges_m[r, c + columns if c < 0 else c - columns if c >= columns else c]  # % is a division
            if range_m < least_m:
                least_m, row_of_least = range_m, r
                if least_m < enough_m:
                    return least_m, row_of_least
    return least_m, row_of_least


@njit(forceinline=True)
def _room():
    """Buffers for ``_locate``."""
    return np.empty(_BLOCK, np.int32), np.empty(_BLOCK, np.int32), np.empty(_BLOCK), np.empty(_BLOCK)


@njit(nogil=True)
def _locate(points, T, shape, rows, columns, ranges, heights):
    """Row and column of the direction of each point (N, 3) moved by T (4, 4), its range and its height.

    Without branches and with coordinates read at a fixed stride, so that the compiler vectorizes it.
    """
    flat = points.reshape(-1)
    rxx, rxy, rxz, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    ryx, ryy, ryz, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    rzx, rzy, rzz, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for i in range(points.shape[0]):
        px, py, pz = flat[3 * i], flat[3 * i + 1], flat[3 * i + 2]
        x = rxx * px + rxy * py + rxz * pz + tx
        y = ryx * px + ryy * py + ryz * pz + ty
        z = rzx * px + rzy * py + rzz * pz + tz
        square = x * x + y * y
        row = np.int32((_angle(z, np.sqrt(square)) / np.pi + 0.5) * shape[0])
        column = np.int32((_angle(y, x) / (2.0 * np.pi) + 0.5) * shape[1])
        rows[i], columns[i] = min(row, shape[0] - 1), min(column, shape[1] - 1)
        ranges[i], heights[i] = np.sqrt(square + z * z), z


@njit(forceinline=True)
def _angle(y: float, x: float) -> float:
    """``atan2`` to 2e-8 rad, by a polynomial (Abramowitz & Stegun 1964, 4.4.49); a bin is 9e-3 rad wide."""
    ratio = min(abs(x), abs(y)) / max(abs(x), abs(y), 1e-300)
    s = ratio * ratio
    high = 0.1065626393 + s * (-0.07528964 + s * (0.0429096138 + s * (-0.0161657367 + s * 0.0028662257)))
    angle = ratio * (1.0 + s * (-0.3333314528 + s * (0.1999355085 + s * (-0.1420889944 + s * high))))
    angle = 0.5 * np.pi - angle if abs(y) > abs(x) else angle
    angle = np.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle
