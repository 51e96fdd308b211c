"""Results of a run: its output files, and the maps made from the keyframes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie, maps
from scanchain.config import Config, MapsConfig
from scanchain.data import Closure, Influence, Keyframe, Matrix, Points, Pose, Scan, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import ExpectedError, ExpectedErrors, ScanPoses, expected_errors
from scanchain.graph.g2o import rejected_path, write_g2o
from scanchain.logs import Log
from scanchain.loops import level_of, outline_of
from scanchain.odometry.jackknife import influence
from scanchain.runs.closures import closures_table
from scanchain.runs.evidence import evidence_of
from scanchain.runs.job import Recorder
from scanchain.runs.results_mcap import write_results_mcap
from scanchain.runs.step_table import steps_table, write_table
from scanchain.runs.track import write_track
from scanchain.slam import SlamResult
from scanchain.trajectory import write_kitti, write_tum
from scanchain.verdict import Judged, judge

if TYPE_CHECKING:
    import pyarrow as pa

GRAPH_FILE = "graph.g2o"  # the edges in force; rejected ones go to graph_rejected.g2o, if there are any
_TILTED_RAD = math.radians(5.0)  # tilt of the lidar's first frame to the ground above which it is reported


@dataclass(frozen=True, slots=True)
class Cloud:
    """The point cloud of the world: points (N, d), meters, and the number of points removed as moving."""

    points: Points
    removed: int


@dataclass(frozen=True)
class Results:
    """Everything computed from a log, from which the files of a run directory are written.

    ``cloud_ahead`` is the cloud, computed in a background thread while the files that do not need it are written.
    In 3D the ``grid`` is level: ``T_world_level`` (4, 4) rotates it into the world frame, whose z axis is that of
    the first lidar pose.
    """

    log: Log
    result: SlamResult
    final: tuple[Closure, ...]
    cloud_ahead: Future[Cloud]
    grid: maps.OccupancyGrid
    T_world_level: Pose

    @cached_property
    def steps_table(self) -> pa.Table:
        """The table of the scans."""
        return steps_table(self.result.steps, self.result.trajectory, self.result.T_base_lidar)

    @cached_property
    def closures_table(self) -> pa.Table:
        """The table of the closures tried."""
        return closures_table(self.final, self.result.keyframes, self.log.dimension)

    def judged(self, expected: ExpectedError | None) -> Judged:
        """The verdict on the run."""
        evidence = evidence_of(self.steps_table, self.closures_table, expected)
        return judge(evidence, self.result.T_base_lidar, self.log.distortion)

    @property
    def cloud(self) -> Cloud:
        """The cloud; waits until it is computed."""
        return self.cloud_ahead.result()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the maps, not the trajectory."""
        tilt_rad = math.acos(min(self.T_world_level[-2, -2], 1.0))
        if tilt_rad < _TILTED_RAD:
            return ()
        return (
            f"the lidar began tilted by {math.degrees(tilt_rad):.0f} deg to the ground: map.pgm is level, "
            "trajectory and point cloud are in the frame that the lidar began in",
        )


def _write_saved_map(path: Path, results: Results) -> None:
    """Write the saved map, from the largest submap of the log only."""
    result, graph = results.result, results.result.graph
    chosen = np.flatnonzero(result.components == np.bincount(result.components).argmax())
    poses = result.T_world_keyframes
    keyframes = tuple(replace(result.keyframes[k], T_odom_lidar=poses[k]) for k in chosen.tolist())
    edges = maps.Edges(graph.edges, graph.measurements, graph.information, graph.is_loop, graph.weight)
    in_force = edges.where(~graph.is_rejected & (graph.is_odometry | graph.is_loop)).among(chosen)
    stamps_ns = result.trajectory.stamps_ns
    session = maps.Session(Path(results.log.name).name, int(stamps_ns[0]), int(stamps_ns[-1]), len(keyframes))
    numbers = np.zeros(len(keyframes), np.int64)
    maps.write_saved_map(maps.SavedMap(path, graph.dimension, keyframes, numbers, (session,), in_force))
    if result.config.loops.enabled and graph.dimension == 3:
        outline_of(path, maps.open_saved_map(path).keyframes, result.config.local_map)


def results_of(log: Log, result: SlamResult, final: tuple[Closure, ...]) -> Results:
    """The results of a log with the maps made from its keyframes."""
    config, executor = result.config, ThreadPoolExecutor(1, thread_name_prefix="scanchain-cloud")
    cloud = executor.submit(cloud_of, result.keyframes, result.T_world_keyframes, config)
    executor.shutdown(wait=False)
    T_world_level = lie.identity(log.dimension)
    if log.dimension == 3:
        T_world_level = level_of(result.keyframes, result.T_world_keyframes, config.local_map)
    grid = grid_of(result.keyframes, lie.inverse(T_world_level) @ result.T_world_keyframes, config.maps)
    return Results(log, result, final, cloud, grid, T_world_level)


def expected_of(
    result: SlamResult, scans: Iterable[Scan] | None = None, distorted_share: float = 0.0
) -> ExpectedErrors | None:
    """Expected errors of scans and keyframes; None without edges, or where these do not constrain all poses.

    scans, distorted_share : as in ``systematic_of``; without scans, random errors only
    Raises InputError where the scans cannot be read again.
    """
    if not len(result.graph.edges):
        return None
    systematic = systematic_of(result, scans, distorted_share)
    try:
        expected = expected_errors(result.graph, result.map_errors, result.config, *systematic)
    except InputError:  # poses that no edge constrains
        return None
    where = _most_uncertain(result.keyframe_trajectory, expected.covariances)
    return expected._replace(ate=msgspec.structs.replace(expected.ate, where=where))


def systematic_of(
    result: SlamResult, scans: Iterable[Scan] | None, distorted_share: float
) -> tuple[ScanPoses, Influence | None]:
    """Poses of scans, with their possible distortion, and the influence of groups of beam directions on them.

    Of all scans of a log, or, in a long log, of evenly spread scans and all keyframes.
    scans : of the log, read again, in order; None for no influence and no distortion
    distorted_share : share of the motion between two scans by which they may be distorted
    """
    keyframes, odometry = np.array([keyframe.scan_index for keyframe in result.keyframes]), result.odometry.poses
    chosen = np.union1d(np.arange(0, len(odometry), math.ceil(len(odometry) / 20_000)), keyframes)  # evenly spread
    found, open_motions = None, np.zeros((len(chosen), result.graph.freedom))
    if scans is not None:
        mounting, offset_rad = result.T_base_lidar, result.elevation_offset_rad
        found = influence(scans, odometry, keyframes, chosen, result.config, mounting, offset_rad)
        after = np.minimum(chosen, len(odometry) - 2) + 1
        open_motions = distorted_share * lie.log(lie.between(odometry[after - 1], odometry[after]))
    poses = result.trajectory.poses[chosen]
    return ScanPoses.of(poses, np.searchsorted(chosen, keyframes), open_motions), found


def _most_uncertain(keyframes: Trajectory, covariances: Matrix) -> str:
    """Text on the interval around the most uncertain position, in which all σ are at least half as large."""
    d = keyframes.dimension
    sigma_m = np.sqrt(np.trace(covariances[:, :d, :d], axis1=1, axis2=2))
    worst = int(sigma_m.argmax())
    is_less = np.append(sigma_m < 0.5 * sigma_m[worst], True)
    last = worst + int(is_less[worst:].argmax()) - 1
    first = worst + 1 - int(is_less[worst::-1].argmax() or worst + 1)
    seconds = 1e-9 * (keyframes.stamps_ns - keyframes.stamps_ns[0])
    at = f"between {seconds[first]:.0f} and {seconds[last]:.0f} s"
    return f"most {at}, where a position is known to ±{sigma_m[worst]:.2g} m"


def write_results(folder: Path, results: Results) -> None:
    """Write every requested output into a run directory; a new format needs a writer and a line here."""
    log, result, config = results.log, results.result, results.result.config
    trajectory, graph = result.trajectory, result.graph
    write_tum(folder / "trajectory.tum", trajectory)
    write_kitti(folder / "trajectory.kitti.txt", trajectory)
    write_tum(folder / "odometry.tum", result.odometry)
    if log.mounting.base and log.mounting.motion is None:  # robot base, in the same world frame
        poses = trajectory.poses @ lie.inverse(log.T_base_lidar)
        write_tum(folder / "trajectory_base.tum", Trajectory(trajectory.stamps_ns, poses))
    if (place := result.georeference) is not None:
        path = place.enu(trajectory)
        write_tum(folder / "trajectory_enu.tum", path)
        write_track(folder, Path(str(log.paths[0])).stem, path, place)
    write_g2o(folder / GRAPH_FILE, graph)
    if graph.is_rejected.any():
        write_g2o(rejected_path(folder / GRAPH_FILE), graph, edges="rejected")
    write_table(folder / "loops.parquet", results.closures_table)
    write_table(folder / "steps.parquet", results.steps_table)
    maps.write_map(folder, results.grid)
    if config.outputs.map:
        _write_saved_map(folder / maps.MAP_FOLDER, results)
    points = results.cloud.points
    maps.write_ply(folder / "map.ply", points)
    if config.maps.write_pcd:
        maps.write_pcd(folder / "map.pcd", points)
    if config.maps.write_laz:
        projected, crs = (points, None) if place is None else place.projected(points)
        maps.write_laz(folder / "map.laz", projected, crs)
    if config.outputs.mcap:  # after the maps, which it reads
        write_results_mcap(folder / "results.mcap", log, result, results.T_world_level)


def record_results(recording: Recorder, results: Results) -> None:
    """Send optimized trajectory, final verdicts, cloud and, in 2D, the occupancy grid to the recording."""
    trajectory, grid = results.result.trajectory, results.grid
    recording.log_trajectory(trajectory)
    recording.log_innovations(results.result.steps)
    recording.log_closures(results.final, results.result.state)
    recording.log_map(results.cloud.points)
    if trajectory.dimension == 2:
        x_m, y_m = grid.origin_m.tolist()
        recording.log_grid(occupancy(grid), resolution_m=grid.resolution_m, origin_m=(x_m, y_m))


def occupancy(grid: maps.OccupancyGrid) -> NDArray[np.int8]:
    """Cells in the convention of ROS: 0 free to 100 occupied, −1 unknown."""
    return np.where(grid.drawn > 0, np.rint(100.0 * grid.probability()), -1.0).astype(np.int8)


def cloud_of(keyframes: Sequence[Keyframe], poses: Matrix, config: Config) -> Cloud:
    """The cloud of keyframes at their final poses (K, d+1, d+1), without moving objects if so configured."""
    scans = ((T, keyframe.points) for T, keyframe in zip(poses, keyframes, strict=True))
    built = maps.build_point_map(scans, dimension=poses.shape[-1] - 1, voxel_size_m=config.maps.voxel_size_m)
    points = built.points()
    if not config.maps.remove_moving:
        return Cloud(points, 0)
    gone = maps.moved(points, built.voxel_size_m, views_of(keyframes, poses, config))
    return Cloud(points[~gone], int(gone.sum()))


def views_of(keyframes: Sequence[Keyframe], poses: Matrix, config: Config) -> Iterator[maps.View]:
    """Free space of keyframes at their final poses (K, d+1, d+1)."""
    for T, keyframe in zip(poses, keyframes, strict=True):
        for T_world_origin, points in keyframe.views(T):
            yield maps.View(T_world_origin, points, keyframe.scale * config.preprocess.map_voxel_m)


def grid_of(keyframes: Sequence[Keyframe], poses: Matrix, config: MapsConfig) -> maps.OccupancyGrid:
    """The grid of keyframes at poses (K, d+1, d+1), coarser than configured where it would be too large."""
    resolution_m = maps.fitting_resolution(
        poses, resolution_m=config.grid_resolution_m, max_range_m=config.grid_max_range_m
    )
    fitting = msgspec.structs.replace(config, grid_resolution_m=resolution_m)
    views = (each for T, keyframe in zip(poses, keyframes, strict=True) for each in keyframe.views(T))
    return maps.draw_grid(views, fitting)
