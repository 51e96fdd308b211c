"""The trajectory of all scans from the keyframes' corrected poses; in the plane, refined scan by scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from math import inf

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Keyframe, Matrix, Points
from scanchain.kernels.registration.icp import refine
from scanchain.registration import VoxelMap
from scanchain.registration.plicp import settings_of
from scanchain.threads import threads

_MAX_SCANS = 2048  # largest number of scans per thread in memory


def spread(
    T_world_keyframes: Matrix, scan_indices: NDArray[np.int64], odometry: Matrix, starts: Sequence[int] = ()
) -> Matrix:
    """World poses (N, d+1, d+1) of all scans: odometry, with the corrections between keyframes interpolated.

    scan_indices : (K,) of the keyframes, the first of them 0; odometry : (N, d+1, d+1) T_odom_lidar
    starts : keyframes to which the motion is unknown, so that nothing is interpolated before them
    """
    following = np.append(np.arange(1, len(scan_indices)), -1)
    relative = lie.between(odometry[scan_indices], odometry[scan_indices[following]])
    target = lie.between(T_world_keyframes, T_world_keyframes[following])
    correction = lie.log(target @ lie.inverse(relative))
    correction[[start - 1 for start in starts if start > 0]] = 0.0
    before = np.searchsorted(scan_indices, np.arange(len(odometry)), side="right") - 1
    span = np.append(np.diff(scan_indices), 1)[before]
    share = np.clip((np.arange(len(odometry)) - scan_indices[before]) / span, 0.0, 1.0)
    within = lie.between(odometry[scan_indices[before]], odometry)
    return T_world_keyframes[before] @ lie.exp(share[:, None] * correction[before]) @ within


def refined(
    poses: Matrix,
    points_of: Callable[[int], Points],
    keyframes: Sequence[Keyframe],
    T_world_keyframes: Matrix,
    config: Config,
) -> Matrix:
    """T_world_lidar (N, 3, 3) of all scans, each aligned once more to the map of all keyframes.

    In directions that the map does not constrain, a prior as uncertain as an odometry edge keeps a pose unchanged.
    points_of : the points (M, 2) of a scan by its number
    keyframes, T_world_keyframes : of the map
    """
    T_world_keyframes, result = T_world_keyframes.copy(), poses.copy()
    origin_m = np.round(T_world_keyframes[:, :2, 2].mean(axis=0), -5)  # whole 100 km: what voxels can address
    for each in (T_world_keyframes, result):
        each[:, :2, 2] -= origin_m
    surfaces, least_share = _map_of(T_world_keyframes, keyframes, config), config.matching.min_inlier_share
    settings = settings_of(config.matching, surfaces, wide=False)
    settings = settings._replace(reach=1, last_reach=1, tolerance_m=0.005, tolerance_rad=0.002)
    sigma = lie.by_component(3, config.odometry.edge_sigma_m, config.odometry.edge_sigma_rad)
    prior = np.diag(sigma**-2.0) * settings.variance

    def refine_part(part: slice, clouds: list[Points]) -> None:
        starts = np.cumsum([0, *map(len, clouds)])
        points = np.concatenate([np.empty((0, 2)), *clouds], dtype=np.float64)
        refine(surfaces.voxels, points, starts, result[part], prior, least_share, settings)

    count = threads()
    with ThreadPoolExecutor(count) as pool:  # scans are independent, and kernels release the GIL
        for first in range(0, len(poses), count * _MAX_SCANS):
            parts = [slice(first + k * _MAX_SCANS, first + (k + 1) * _MAX_SCANS) for k in range(count)]
            clouds = [[points_of(scan) for scan in range(*part.indices(len(poses)))] for part in parts]
            list(pool.map(refine_part, parts, clouds))
    result[:, :2, 2] += origin_m
    return result


def _map_of(T_world_keyframes: Matrix, keyframes: Sequence[Keyframe], config: Config) -> VoxelMap:
    """A voxel map of all keyframes that never removes voxels."""
    whole = msgspec.structs.replace(config.local_map, max_distance_m=inf, max_insertions=len(keyframes) + 1)
    result = VoxelMap(2, whole, noise_m=max(keyframe.noise_m for keyframe in keyframes))
    for keyframe, T_world_lidar in zip(keyframes, T_world_keyframes, strict=True):
        result.insert(keyframe.points, T_world_lidar)
    return result
