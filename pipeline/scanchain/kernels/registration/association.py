"""Correspondences: the nearest voxel mean of every point, and the weighted pairs of the closed form."""

import numpy as np

from scanchain.kernels.compiling import njit
from scanchain.kernels.voxels.hashing import find_row, pack
from scanchain.kernels.voxels.voxel_shapes import move


@njit(nogil=True)
def associate(voxels, points, T, reach: int, max_distance_m: float, correspondence):
    """Number of points with a voxel mean within the distance; the row of the nearest in ``correspondence`` (N,).

    points : (N, d) meters; T moves them into the map's frame
    reach : voxels searched to each side: the 2ʳᵉᵃᶜʰ-fold of each axis around the point, (2·reach)ᵈ voxels
    correspondence : −1 where no mean is near enough
    A ring of voxels is searched only if a mean in it could be nearer than those found within: r rings hold all
    that lies nearer than r − ½ voxels.
    """
    scale = 1.0 / voxels.size_m
    flat = points.shape[1] == 2
    found = 0
    for i in range(points.shape[0]):
        x, y, z = move(T, points, i)
        ix, iy = int(np.floor(x * scale - 0.5)), int(np.floor(y * scale - 0.5))
        iz = 0 if flat else int(np.floor(z * scale - 0.5))
        nearest = max_distance_m * max_distance_m
        chosen = -1
        for ring in range(1, reach + 1):
            for dx in range(1 - ring, ring + 1):
                for dy in range(1 - ring, ring + 1):
                    on_side = dx == 1 - ring or dx == ring or dy == 1 - ring or dy == ring
                    for dz in range(0 if flat else 1 - ring, 1 if flat else ring + 1):
                        if ring > 1 and not on_side and (flat or (dz > 1 - ring and dz < ring)):
                            continue
                        voxel = find_row(voxels.rows, voxels.keys, pack(ix + dx, iy + dy, iz + dz))
                        if voxel < 0:
                            continue
                        ex = voxels.cells[voxel, 0] - x
                        ey = voxels.cells[voxel, 1] - y
                        ez = voxels.cells[voxel, 2] - z
                        distance = ex * ex + ey * ey + ez * ez
                        if distance < nearest:
                            nearest = distance
                            chosen = voxel
            covered = (ring - 0.5) * voxels.size_m
            if nearest <= covered * covered:
                break
        correspondence[i] = chosen
        found += chosen >= 0
    return found


@njit(nogil=True)
def weighted_pairs(voxels, points, T, correspondence, scale_m: float, source, target, weight):
    """Number of pairs; the moved point, voxel mean and Geman–McClure weight (s²/(s²+r²))² of each, one row a pair.

    points : (N, d) meters, source frame; correspondence : (N,) rows of the map, −1 for none
    source, target : (N, d) and weight : (N,), room for the pairs
    """
    pairs = 0
    s2 = scale_m * scale_m
    for i in range(points.shape[0]):
        voxel = correspondence[i]
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
