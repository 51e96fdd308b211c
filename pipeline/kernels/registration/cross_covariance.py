"""The sums that the closed-form rigid transformation needs, over pairs of points and voxel means."""

from numba import njit

from scanchain.kernels.voxels.voxel_shapes import move


@njit(cache=True, nogil=True)
def weighted_pairs(voxels, points, T, partner, scale_m: float, source, target, weight):
    """Write every pair's moved point, voxel mean and Geman–McClure weight (s²/(s²+r²))², one row a pair.

    points : (N, d) meters, source frame; partner : (N,) rows of the map, −1 for none
    source, target : (N, d) and weight : (N,), room for the pairs. Returns the number of pairs.
    """
    pairs = 0
    s2 = scale_m * scale_m
    for i in range(points.shape[0]):
        voxel = partner[i]
        if voxel < 0:
            continue
        moved = move(T, points, i)
        r2 = 0.0
        for axis in range(points.shape[1]):
            source[pairs, axis] = moved[axis]
            target[pairs, axis] = voxels.cells[voxel, axis]
            r2 += (source[pairs, axis] - target[pairs, axis]) ** 2
        ratio = s2 / (s2 + r2)
        weight[pairs] = ratio * ratio
        pairs += 1
    return pairs
