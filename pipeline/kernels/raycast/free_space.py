"""Points compared with the ranges of a lidar elsewhere: on its surfaces, behind them, or in its free space."""

import numpy as np

from scanchain.kernels.compiling import njit

FAR = 1e9  # m, range of bins that no ray fell into


@njit(nogil=True)
def nearest_ranges(points, ranges_m):
    """Fill ``ranges_m`` (E, A) with the least range in each bin of direction, FAR where no point is.

    points : (N, 3) meters, lidar frame; rows are E equal steps of elevation from −π/2 to π/2, columns A equal
    steps of azimuth from −π
    """
    ranges_m[:] = FAR
    for i in range(points.shape[0]):
        row, column, range_m = _bin_of(points[i, 0], points[i, 1], points[i, 2], ranges_m.shape)
        if range_m > 0.0:
            ranges_m[row, column] = min(ranges_m[row, column], range_m)


@njit(nogil=True)
def compare_ranges(points, T, ranges_m, margin_m: float, margin_share: float):
    """Numbers of points (N, 3), moved by T (4, 4) into the lidar's frame, that agree and that contradict.

    A point agrees where its range is that of its bin, within the margin: so many meters and such a share of the
    range. It contradicts where all rays of its bin went on behind it. Others are hidden or out of sight.
    """
    agreeing = contradicting = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        row, column, range_m = _bin_of(
            T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
            T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
            T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
            ranges_m.shape,
        )
        seen_m = ranges_m[row, column]
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
    """Count, for each point, the scan as one that saw a surface there or saw through it.

    All rays that pass within half the window of the point, to its sides and above it, are compared; below it, a
    single bin, or else the ground would confirm what passes above it. The point was seen where the nearest of them
    ended there, within the margin: so a thin pole before a far wall is not free space, though most rays miss
    it. It was seen through where the nearest went on behind it, unless that one ended at the same height, as
    rays do on ground that they graze, and where one is within a bin of its direction. Where some ended before it,
    the bin of its direction alone is compared: what hides a point does not hide those beside it. Otherwise it is
    hidden or out of sight.

    points : (N, 3) meters, world; spans : (S, 2) int64 first and last + 1 of the points to test
    T : (4, 4) T_lidar_world; ranges_m : (E, A) of ``nearest_ranges``; one row for scans in a plane
    limits : (6,) reach m; window m; margin of a range m, and per meter; margin of a height m, and per meter
    enough : points that so many scans saw are not tested again
    seen, seen_through : (N,) int32, changed in place
    """
    reach_m, window_m, margin_m, margin_share, level_m, level_share = limits
    for s in range(spans.shape[0]):
        for i in range(spans[s, 0], spans[s, 1]):
            if seen[i] >= enough:
                continue
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            sight = _sight(
                T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
                T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
                T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
                ranges_m, reach_m, window_m, margin_m, margin_share, level_m, level_share,
            )  # fmt: skip
            if sight > 0:
                seen[i] += 1
            elif sight < 0:
                seen_through[i] += 1


@njit(inline="always")
def _sight(x, y, z, ranges_m, reach_m, window_m, margin_m, margin_share, level_m, level_share):
    """1 where a point in the lidar's frame was seen, −1 where it lies in free space, else 0."""
    if x * x + y * y + z * z > reach_m * reach_m:
        return 0
    row, column, range_m = _bin_of(x, y, z, ranges_m.shape)
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


@njit(inline="always")
def _least(ranges_m, row, column, half, enough_m):
    """Least range, or any below ``enough_m``, and its row; of the bins ``half`` away at most, below 1.

    Columns are closed in a ring.
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


@njit(inline="always")
def _bin_of(x: float, y: float, z: float, shape):
    """Row and column of a direction, and the range; (0, 0, 0) at the lidar itself."""
    range_m = np.sqrt(x * x + y * y + z * z)
    if range_m <= 0.0:
        return 0, 0, 0.0
    row = int((np.arcsin(z / range_m) / np.pi + 0.5) * shape[0])
    column = int((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * shape[1])
    return min(row, shape[0] - 1), min(column, shape[1] - 1), range_m
