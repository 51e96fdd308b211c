"""Points held against what a lidar saw elsewhere: on its surfaces, behind them, or where it looked through."""

import numpy as np
from numba import njit

FAR = 1e9  # m, in bins that no ray fell into


@njit(cache=True, nogil=True)
def nearest_ranges(points, ranges_m):
    """Fill ``ranges_m`` (E, A) with the least range in each bin of direction, FAR where no point is.

    points : (N, 3) metres, lidar frame; rows are E equal steps of elevation from −π/2 to π/2, columns A equal
    steps of azimuth from −π
    """
    ranges_m[:] = FAR
    for i in range(points.shape[0]):
        row, column, range_m = _bin_of(points[i, 0], points[i, 1], points[i, 2], ranges_m.shape)
        if range_m > 0.0:
            ranges_m[row, column] = min(ranges_m[row, column], range_m)


@njit(cache=True, nogil=True)
def compare_ranges(points, T, ranges_m, margin_m: float, margin_share: float):
    """How many points (N, 3), moved by T (4, 4) into the lidar's frame, agree with its ranges and contradict.

    A point agrees where its range is that of its bin, within the margin: so many metres and such a share of the
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


@njit(cache=True, inline="always")
def _bin_of(x: float, y: float, z: float, shape):
    """Row and column of a direction, and the range; (0, 0, 0) at the lidar itself."""
    range_m = np.sqrt(x * x + y * y + z * z)
    if range_m <= 0.0:
        return 0, 0, 0.0
    row = int((np.arcsin(z / range_m) / np.pi + 0.5) * shape[0])
    column = int((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * shape[1])
    return min(row, shape[0] - 1), min(column, shape[1] - 1), range_m
