"""Every scan of a planar log aligned once more, at the end, to the map that the corrected keyframes make."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from math import inf

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config, MatchingConfig
from scanchain.data import Keyframe, Matrix, Points
from scanchain.kernels.registration.refinement import refine
from scanchain.point_store import PointStore
from scanchain.registration import VoxelMap
from scanchain.registration.plicp import terms_of

_TOLERANCE_M, _TOLERANCE_RAD = 0.005, 0.002  # of a step after which another would change little
_THREADS = 2
_AT_ONCE = 2048  # scans a thread, in memory


def refined(
    poses: Matrix,
    spans: NDArray[np.int64],
    store: PointStore,
    keyframes: Sequence[Keyframe],
    config: Config,
) -> Matrix:
    """T_world_lidar (N, 3, 3) of all scans where they fit the keyframes of every pass best; near where they are.

    A pose is held, as surely as an edge of odometry, where the map tells nothing.
    spans : (N, 2) first row and number of each scan's points in the store
    """
    surfaces, least_share = _map_of(poses, keyframes, config), config.matching.min_inlier_share
    terms = terms_of(_briefly(config), surfaces, wide=False)
    sigma = lie.by_component(3, config.odometry.edge_sigma_m, config.odometry.edge_sigma_rad)
    held = np.diag(sigma**-2.0) * terms.variance
    result = poses.copy()

    def refine_part(part: slice, points: Points) -> None:
        starts = np.append(0, np.cumsum(spans[part, 1]))
        refine(surfaces.voxels, points, starts, result[part], held, least_share, terms)

    with ThreadPoolExecutor(_THREADS) as pool:  # no scan depends on another, and kernels let others run
        for first in range(0, len(poses), _THREADS * _AT_ONCE):
            parts = [slice(first + k * _AT_ONCE, first + (k + 1) * _AT_ONCE) for k in range(_THREADS)]
            clouds = [_points_of(spans[part], store) for part in parts]
            list(pool.map(refine_part, parts, clouds))
    return result


def _points_of(spans: NDArray[np.int64], store: PointStore) -> Points:
    """The points of scans, one after the other, (N, 2)."""
    scans = [store.read(row, count) for row, count in spans.tolist()]
    return np.concatenate([np.empty((0, 2)), *scans], dtype=np.float64)


def _map_of(poses: Matrix, keyframes: Sequence[Keyframe], config: Config) -> VoxelMap:
    """All keyframes in a map that forgets nothing."""
    whole = msgspec.structs.replace(config.local_map, max_distance_m=inf, max_insertions=len(keyframes) + 1)
    result = VoxelMap(2, whole)
    for keyframe in keyframes:
        result.insert(keyframe.points, poses[keyframe.scan_index])
    return result


def _briefly(config: Config) -> MatchingConfig:
    """Poses that are good already need no more than a few steps, to partners nearby."""
    return msgspec.structs.replace(
        config.matching, reach_voxels=1, tolerance_m=_TOLERANCE_M, tolerance_rad=_TOLERANCE_RAD
    )
