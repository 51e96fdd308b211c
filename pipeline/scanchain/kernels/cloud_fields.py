"""The points of a cloud that came back, out of the fields of its records."""

from scanchain.kernels.compiling import njit


@njit(nogil=True)
def keep_valid(x, y, z, low_square: float, high_square: float, points, kept):
    """Copy the points whose squared range is finite, above low_square and at most high_square, in their order.

    x, y, z : (N,) float32 meters, strided as the records are
    points : (N, 3) float32, filled from the front; kept : (N,) int32, the place of each in the cloud
    Returns how many were kept. NaN fails both comparisons.
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
