"""The files that hold what a log amounts to: trajectories, graph, maps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from pipeline.config import MapsConfig
from pipeline.data import Points, Pose
from pipeline.graph.g2o_write import write_g2o
from pipeline.maps import OccupancyGrid, build_point_map, draw_grid, fitting_resolution, write_map, write_ply
from pipeline.runs.recorder import Recorder
from pipeline.runs.verdicts import JudgedClosure
from pipeline.slam import SlamResult
from pipeline.trajectory import write_kitti, write_tum


def write_results(
    folder: Path, result: SlamResult, judged: Sequence[JudgedClosure], config: MapsConfig, recording: Recorder
) -> None:
    """Write trajectories, graph and maps into a run directory, and show them in the recording."""
    write_tum(folder / "trajectory.tum", result.trajectory)
    write_tum(folder / "odometry.tum", result.odometry)
    write_kitti(folder / "trajectory.kitti.txt", result.trajectory)
    write_g2o(folder / "graph.g2o", result.graph)
    indices = np.arange(len(result.trajectory), dtype=np.int64)
    recording.log_trajectory(result.trajectory.stamps_ns, result.trajectory.poses, indices)
    recording.log_closures([replace(item.closure, verdict=item.verdict) for item in judged], result.state)
    dimension = result.trajectory.dimension
    cloud = build_point_map(_scans(result), dimension=dimension, voxel_size_m=config.voxel_size_m).points()
    write_ply(folder / "map.ply", cloud)
    recording.log_map(cloud)
    grid = _grid(result, config)
    write_map(folder, grid)
    if dimension == 2:
        x_m, y_m = grid.origin_m.tolist()
        recording.log_grid(occupancy(grid), resolution_m=grid.resolution_m, origin_m=(x_m, y_m))


def occupancy(grid: OccupancyGrid) -> NDArray[np.int8]:
    """Cells as ROS counts them: 0 free to 100 occupied, −1 where nothing was seen."""
    return np.where(grid.drawn > 0, np.rint(100.0 * grid.probability()), -1.0).astype(np.int8)


def _grid(result: SlamResult, config: MapsConfig) -> OccupancyGrid:
    """The grid of all keyframes, coarser than asked for where the world is too large."""
    resolution_m = fitting_resolution(
        result.state.poses, resolution_m=config.grid_resolution_m, max_range_m=config.grid_max_range_m
    )
    fitting = msgspec.structs.replace(config, grid_resolution_m=resolution_m)
    return draw_grid(_scans(result), fitting, max_range_m=config.grid_max_range_m)


def _scans(result: SlamResult) -> Iterator[tuple[Pose, Points]]:
    """Keyframes with their optimised poses."""
    for pose, keyframe in zip(result.state.poses, result.keyframes, strict=True):
        yield pose, keyframe.points
