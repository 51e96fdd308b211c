"""The files that hold what a log amounts to: trajectories, graph, maps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain.config import Config, MapsConfig
from scanchain.data import Points, Pose
from scanchain.graph.files.g2o_write import rejected_path, write_g2o
from scanchain.maps import (
    OccupancyGrid,
    View,
    build_point_map,
    draw_grid,
    fitting_resolution,
    moved,
    write_laz,
    write_map,
    write_pcd,
    write_ply,
)
from scanchain.runs.recorder import Recorder
from scanchain.runs.verdicts import JudgedClosure
from scanchain.slam import SlamResult
from scanchain.trajectory import write_kitti, write_tum

GRAPH_FILE = "graph.g2o"  # what is in force; rejected edges stand in graph_rejected.g2o, if there are any


@dataclass(frozen=True, slots=True)
class Cloud:
    """The point cloud of the world: points (N, d), meters, and how many were left out as having moved."""

    points: Points
    removed: int


def write_results(
    folder: Path, result: SlamResult, judged: Sequence[JudgedClosure], config: Config, recording: Recorder
) -> Cloud:
    """Write trajectories, graph and maps into a run directory, and show them in the recording."""
    write_tum(folder / "trajectory.tum", result.trajectory)
    write_tum(folder / "odometry.tum", result.odometry)
    write_kitti(folder / "trajectory.kitti.txt", result.trajectory)
    write_g2o(folder / GRAPH_FILE, result.graph)
    if result.graph.is_rejected.any():
        write_g2o(rejected_path(folder / GRAPH_FILE), result.graph, edges="rejected")
    indices = np.arange(len(result.trajectory), dtype=np.int64)
    recording.log_trajectory(result.trajectory.stamps_ns, result.trajectory.poses, indices)
    recording.log_closures(judged, result.state)
    dimension = result.trajectory.dimension
    cloud = cloud_of(result, config)
    write_ply(folder / "map.ply", cloud.points)
    if config.maps.write_pcd:
        write_pcd(folder / "map.pcd", cloud.points)
    if config.maps.write_laz:
        write_laz(folder / "map.laz", cloud.points)
    recording.log_map(cloud.points)
    grid = grid_of(result, config.maps)
    write_map(folder, grid)
    if dimension == 2:
        x_m, y_m = grid.origin_m.tolist()
        recording.log_grid(occupancy(grid), resolution_m=grid.resolution_m, origin_m=(x_m, y_m))
    return cloud


def occupancy(grid: OccupancyGrid) -> NDArray[np.int8]:
    """Cells as ROS counts them: 0 free to 100 occupied, −1 where nothing was seen."""
    return np.where(grid.drawn > 0, np.rint(100.0 * grid.probability()), -1.0).astype(np.int8)


def cloud_of(result: SlamResult, config: Config) -> Cloud:
    """The cloud of all keyframes, without what moved if that is wished."""
    dimension = result.trajectory.dimension
    built = build_point_map(_scans(result), dimension=dimension, voxel_size_m=config.maps.voxel_size_m)
    points = built.points()
    if not config.maps.remove_moving:
        return Cloud(points, 0)
    views = (
        View(pose, keyframe.points, keyframe.scale * config.preprocess.map_voxel_m)
        for pose, keyframe in zip(result.T_world_keyframes, result.keyframes, strict=True)
    )
    gone = moved(points, built.voxel_size_m, views)
    return Cloud(points[~gone], int(gone.sum()))


def grid_of(result: SlamResult, config: MapsConfig) -> OccupancyGrid:
    """The grid of all keyframes, coarser than asked for where the world is too large."""
    resolution_m = fitting_resolution(
        result.T_world_keyframes, resolution_m=config.grid_resolution_m, max_range_m=config.grid_max_range_m
    )
    fitting = msgspec.structs.replace(config, grid_resolution_m=resolution_m)
    return draw_grid(_scans(result), fitting, max_range_m=config.grid_max_range_m)


def _scans(result: SlamResult) -> Iterator[tuple[Pose, Points]]:
    """Keyframes with their optimized poses."""
    for pose, keyframe in zip(result.T_world_keyframes, result.keyframes, strict=True):
        yield pose, keyframe.points
