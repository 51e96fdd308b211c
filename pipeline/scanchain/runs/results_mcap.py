"""results.mcap: poses and maps as ROS 2 messages, for Foxglove and RViz along with the original log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose
from scanchain.logs import Log, writer
from scanchain.logs.mounting import MovingFrame, moving_frame
from scanchain.maps import read_map, read_ply
from scanchain.slam import SlamResult
from scanchain.steps import Steps

_WORLD, _ODOM = "world", "odom"
_PLANAR = [0, 1, 5]  # x, y, yaw among x, y, z, roll, pitch, yaw


def write_results_mcap(path: Path, log: Log, result: SlamResult, T_world_grid: Pose) -> None:
    """Write /tf and /odometry per scan, and /path, /map and /map_cloud at the log time of the first scan.

    world → odom is the correction by loop closures, odom → robot the odometry; the robot's frame is the root of
    the log's fixed transforms, so that the log's own sensors follow it. The maps are read from the files in the
    same folder; ``T_world_grid`` is the pose of the grid's frame.
    """
    moving = moving_frame(log.indexes, log.publishers.frame, log.mounting, dimension=log.dimension)
    steps = result.steps
    first_ns, first_log_ns = (int(steps.columns[name][0]) for name in ("stamp_ns", "log_time_ns"))
    with writer.LogWriter(path) as file:
        trajectory = result.trajectory
        places = [writer.place(T @ moving.T_lidar_frame) for T in trajectory.poses]
        data = writer.pack_path(first_ns, _WORLD, trajectory.stamps_ns.tolist(), places)
        file.append("/path", "nav_msgs/msg/Path", data, first_ns, first_log_ns)
        cells, resolution_m, origin_m = read_map(path.parent)
        T_grid_corner = lie.identity(log.dimension)
        T_grid_corner[:2, -1] = origin_m
        data = writer.pack_grid(first_ns, _WORLD, cells, resolution_m, writer.place(T_world_grid @ T_grid_corner))
        file.append("/map", "nav_msgs/msg/OccupancyGrid", data, first_ns, first_log_ns)
        points = lie.lift_points(read_ply(path.with_name("map.ply"))).astype("<f4")
        data = writer.pack_cloud(first_ns, _WORLD, points.view([(name, "<f4") for name in "xyz"])[:, 0])
        file.append("/map_cloud", "sensor_msgs/msg/PointCloud2", data, first_ns, first_log_ns)
        _write_motion(file, moving, steps, trajectory.poses)


def ros_covariance(covariance: Matrix, T: Pose) -> NDArray[np.float64]:
    """A covariance (6, 6) as in nav_msgs/Odometry: x, y, z, and rotations about the fixed axes of its frame.

    covariance : (k, k) of a twist in the moving frame, T exp(ξ), order (translation, rotation); NaN, where a
        direction is unobservable, becomes 0, which means unknown
    T : pose of the moving frame
    """
    spread = np.zeros((6, 6))
    places = _PLANAR if len(covariance) == 3 else list(range(6))
    spread[np.ix_(places, places)] = np.nan_to_num(covariance)
    turn = np.kron(np.eye(2), lie.lift(T)[:3, :3])
    return turn @ spread @ turn.T


def _write_motion(file: writer.LogWriter, moving: MovingFrame, steps: Steps, poses: Matrix) -> None:
    T_lidar_frame = moving.T_lidar_frame
    adjoint = lie.adjoint(lie.inverse(T_lidar_frame))
    stamps_ns, log_times_ns = (steps.columns[name].tolist() for name in ("stamp_ns", "log_time_ns"))
    odometry, covariances = steps.columns["T_odom_lidar"], steps.covariances()
    rows = zip(stamps_ns, log_times_ns, odometry, poses, covariances, strict=True)
    for stamp_ns, log_time_ns, T_odom_lidar, T_world_lidar, covariance in rows:
        T_odom_frame = T_odom_lidar @ T_lidar_frame
        T_world_odom = T_world_lidar @ lie.inverse(T_odom_lidar)
        here = writer.place(T_odom_frame)
        links = writer.Link(_WORLD, _ODOM, writer.place(T_world_odom)), writer.Link(_ODOM, moving.name, here)
        data = writer.pack_transforms(stamp_ns, *links)
        file.append("/tf", "tf2_msgs/msg/TFMessage", data, stamp_ns, log_time_ns)
        in_ros = ros_covariance(adjoint @ covariance @ adjoint.T, T_odom_frame)
        data = writer.pack_odometry(stamp_ns, _ODOM, moving.name, here, in_ros)
        file.append("/odometry", "nav_msgs/msg/Odometry", data, stamp_ns, log_time_ns)
