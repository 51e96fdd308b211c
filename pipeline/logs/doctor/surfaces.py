"""How well the surfaces in a scan determine its motion, estimated from the scan alone, without matching it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scanchain.config import PreprocessConfig
from scanchain.data import Points, RawPoints

_VOXEL_M = 0.5  # at most one point in each, in 3D: else the ground near the lidar outweighs all else
_POINTS = 1500  # whose normals are estimated, at most
_NEIGHBORS = {2: 7, 3: 10}  # of a point, for its normal
_FLAT = 0.02  # largest ratio of the two least eigenvalues of the covariance of neighbors on a surface
_LINE = 0.03  # least ratio of the two largest ones: neighbors on one ring make no surface
_FEW_SURFACES = 20
_MOTIONS = {
    2: ("motion along x", "motion along y", "rotation"),
    3: (
        "motion along x",
        "motion along y",
        "motion along z",
        "rotation about x",
        "rotation about y",
        "rotation about z",
    ),
}


class Weakest(NamedTuple):
    """The motion that a scan's surfaces determine least: 0 to 1, relative to one that all constrain; and which."""

    information: float
    direction: str


def weakest_motion(points: RawPoints, config: PreprocessConfig) -> Weakest:
    """The least eigenvalue of the information Σ JᵀJ / n of point-to-plane residuals, J = [nᵀ, (p × n)ᵀ / range].

    points : (N, d) meters, lidar frame
    """
    from scipy.spatial import KDTree

    d = points.shape[1]
    ranges_m = np.linalg.norm(points, axis=1)
    near: Points = points[(ranges_m >= config.min_range_m) & (ranges_m <= config.max_range_m)].astype(np.float64)
    if d == 3:
        _, first = np.unique(np.floor(near / _VOXEL_M).astype(np.int64), axis=0, return_index=True)
        near = near[np.sort(first)]
    if len(near) <= _NEIGHBORS[d]:
        return Weakest(0.0, _MOTIONS[d][0])
    some = near[:: max(1, len(near) // _POINTS)]
    neighbors = near[KDTree(near).query(some, _NEIGHBORS[d])[1]]
    off_m = neighbors - neighbors.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off_m, off_m))
    on_surface = values[:, 0] < _FLAT * values[:, 1]
    if d == 3:
        on_surface &= values[:, 1] > _LINE * values[:, 2]
    if np.count_nonzero(on_surface) < _FEW_SURFACES:
        return Weakest(0.0, _MOTIONS[d][0])
    p, n = some[on_surface], vectors[on_surface, :, 0]
    turning = np.cross(p, n) if d == 3 else (p[:, :1] * n[:, 1:] - p[:, 1:] * n[:, :1])
    J = np.hstack([n, turning / np.sqrt(np.mean(np.sum(np.square(p), axis=1)))])
    information, directions = np.linalg.eigh(J.T @ J / len(J))
    return Weakest(float(information[0]), _MOTIONS[d][int(np.argmax(np.abs(directions[:, 0])))])
