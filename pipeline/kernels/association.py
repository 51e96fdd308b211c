"""The nearest voxel mean of every point, among the voxels around it."""

import numpy as np
from numba import njit

from pipeline.kernels.hashing import find, pack
from pipeline.kernels.voxels import move


@njit(cache=True, nogil=True)
def associate(voxels, points, T, reach: int, max_distance_m: float, partner):
    """Fill ``partner`` (N,) with the row of the nearest voxel mean, −1 where none is near enough.

    points : (N, d) metres; T moves them into the map's frame
    reach : voxels searched to each side: the 2ʳᵉᵃᶜʰ-fold of each axis around the point, (2·reach)ᵈ voxels
    Returns the number of points with a partner.
    """
    scale = 1.0 / voxels.size_m
    layers = 2 * reach if points.shape[1] == 3 else 1
    found = 0
    for i in range(points.shape[0]):
        x, y, z = move(T, points, i)
        ix = int(np.floor(x * scale - 0.5)) - reach + 1
        iy = int(np.floor(y * scale - 0.5)) - reach + 1
        iz = int(np.floor(z * scale - 0.5)) - reach + 1 if points.shape[1] == 3 else 0
        nearest = max_distance_m * max_distance_m
        chosen = -1
        for dx in range(2 * reach):
            for dy in range(2 * reach):
                for dz in range(layers):
                    slot = find(voxels.keys, pack(ix + dx, iy + dy, iz + dz))
                    if slot < 0:
                        continue
                    voxel = voxels.row[slot]
                    ex = voxels.cells[voxel, 0] - x
                    ey = voxels.cells[voxel, 1] - y
                    ez = voxels.cells[voxel, 2] - z
                    distance = ex * ex + ey * ey + ez * ez
                    if distance < nearest:
                        nearest = distance
                        chosen = voxel
        partner[i] = chosen
        found += chosen >= 0
    return found
