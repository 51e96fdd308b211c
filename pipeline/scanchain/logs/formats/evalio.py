"""Sequences of evalio's data sets, ``evalio:NAME/SEQUENCE``: their lidar, IMU and ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs.files import evalio_name, evalio_sequence
from scanchain.logs.formats import Format
from scanchain.logs.formats.mcap import temporary_index
from scanchain.logs.index import FileIndex
from scanchain.logs.writer import Link, LogWriter, pack_imu, pack_odometry, pack_transforms, place

_LIDAR, _IMU = "lidar", "imu"  # frames


def index_sequence(path: Path, number: int, _: LogConfig) -> FileIndex:
    """Index of a sequence, converted to a temporary MCAP file."""
    sequence = evalio_sequence(path)
    index = temporary_index(path, number, lambda log: _write(log, sequence))
    if not index.numbers_of("/points"):
        raise InputError(f"{sequence}: has no scan; download it again: evalio dl {sequence}")
    return index


def _write(log: LogWriter, sequence: Any) -> None:
    T_imu_lidar = sequence.imu_T_lidar().to_mat()
    truth = iter(list[Any](sequence.ground_truth() or ()))
    upcoming = next(truth, None)
    for count, measurement in enumerate(sequence):
        stamp_ns = measurement.stamp.to_nsec()
        if not count:
            links = pack_transforms(stamp_ns, Link(_IMU, _LIDAR, place(T_imu_lidar)))
            log.append("/tf_static", "tf2_msgs/msg/TFMessage", links, stamp_ns)
        while upcoming is not None and upcoming[0].to_nsec() <= stamp_ns:
            _write_truth(log, *upcoming)
            upcoming = next(truth, None)
        if hasattr(measurement, "gyro"):
            data = pack_imu(stamp_ns, _IMU, measurement.gyro.tolist(), measurement.accel.tolist())
            log.append("/imu", "sensor_msgs/msg/Imu", data, stamp_ns)
            continue
        times_s = np.array(measurement.to_vec_stamps(), np.float32)
        points = np.array(measurement.to_vec_positions(), np.float32).reshape(-1, 3)
        log.point_cloud("/points", stamp_ns, _LIDAR, points, {"time": times_s})
    for each in [upcoming, *truth] if upcoming is not None else []:
        _write_truth(log, *each)


def _write_truth(log: LogWriter, stamp: Any, T_world_imu: Any) -> None:
    stamp_ns = stamp.to_nsec()
    data = pack_odometry(stamp_ns, "world", _IMU, place(T_world_imu.to_mat()))
    log.append("/ground_truth", "nav_msgs/msg/Odometry", data, stamp_ns)


FORMAT = Format(
    "evalio",
    "a sequence of evalio (evalio:NAME/SEQUENCE)",
    lambda path, _: bool(evalio_name(path)),
    index_sequence,
)
