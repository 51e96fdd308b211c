"""KITTI folders: lidar sweeps of the raw recordings and of the odometry benchmark, with ground truth.

Geiger, Lenz, Stiller & Urtasun 2013, "Vision meets robotics: the KITTI dataset".
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from functools import partial
from pathlib import Path

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.config import LogConfig
from scanchain.data import Matrix, Pose
from scanchain.errors import InputError, counted, shown
from scanchain.logs.formats import Format, add_block, add_channel, natural_order
from scanchain.logs.formats.clouds import XYZI, contents_of, read_raw
from scanchain.logs.index import Block, Contents, FileIndex, Message
from scanchain.logs.writer import LATEST_NS, pack_odometry, place

_TRUTH = -1  # offset of the block of the ground truth
_TIME = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d+)?$")
Truth = list[tuple[int, Pose]]  # stamps in nanoseconds, and T_world_lidar

_EARTH_M = 6378137.0  # equatorial radius of WGS 84, as in KITTI's development kit
_MOST_LATITUDE_DEG = 89.0  # the Mercator projection is singular at the poles
_MOST_NUMBER = 1e12  # meters, seconds or degrees; larger numbers, infinity or NaN indicate damage


def index_kitti_raw(folder: Path, number: int, _: LogConfig) -> FileIndex:
    """Index of a drive of the raw recordings (``..._sync``); ground truth is its GPS/INS, moved to the lidar."""
    times_ns = read_times(folder / "velodyne_points" / "timestamps.txt")
    return _index(FileIndex(folder, number), folder / "velodyne_points/data", times_ns, lambda: _raw_truth(folder))


def index_kitti_odometry(folder: Path, number: int, _: LogConfig) -> FileIndex:
    """Index of a sequence of the odometry benchmark (``sequences/00``) with ground truth in ``poses/00.txt``."""
    times = folder / "times.txt"
    times_ns = _checked(times, np.rint(_table(times, 1)[:, 0] * 1_000_000_000))  # one line of seconds per scan
    return _index(
        FileIndex(folder, number), folder / "velodyne", times_ns, lambda: _benchmark_truth(folder, times_ns)
    )


def _raw_truth(folder: Path) -> Truth:
    calibration, readings = folder.parent / "calib_imu_to_velo.txt", folder / "oxts"
    if absent := next((path for path in (readings, calibration) if not path.exists()), None):
        raise FileNotFoundError(absent)
    times_ns = read_times(readings / "timestamps.txt")
    T_lidar_imu = np.eye(4)
    T_lidar_imu[:3, :3], T_lidar_imu[:3, 3] = _entry(calibration, "R", (3, 3)), _entry(calibration, "T", (3,))
    poses = read_oxts(readings / "data", T_lidar_imu)
    if len(poses) != len(times_ns):
        raise InputError(
            f"{readings}: has {counted(len(poses), 'reading')} and {counted(len(times_ns), 'time')}; "
            "download it again"
        )
    return list(zip(times_ns, poses, strict=True))


def _benchmark_truth(folder: Path, times_ns: Sequence[int]) -> Truth:
    file = folder.resolve().parent.parent / "poses" / f"{folder.resolve().name}.txt"
    if not file.is_file():
        raise FileNotFoundError(file)
    return list(zip(times_ns, read_camera_poses(file, folder / "calib.txt"), strict=False))


def _index(index: FileIndex, folder: Path, times_ns: Sequence[int], read_truth: Callable[[], Truth]) -> FileIndex:
    """Index of /velodyne_points, and of /ground_truth if readable; a file's name is the index of its time."""
    files, truth = sorted(folder.glob("*.bin"), key=natural_order), Truth()
    if not files:
        raise InputError(f"{folder}: has no .bin file; use the synced raw recordings (..._sync)")
    try:
        truth = read_truth()
    except FileNotFoundError as absent:
        index.notes.append(f"{absent}: is absent, so there is no ground truth")
    except (InputError, LinAlgError) as error:
        index.add_damage(f"{error}; there is no ground truth until then")
    numbers = [int(file.stem) for file in files if file.stem.isdigit()]
    if len(numbers) < len(files) or max(numbers) >= len(times_ns):
        raise InputError(
            f"{files[-1]}: does not fit the {counted(len(times_ns), 'timestamp')}; names must be numbers from 0 up"
        )
    lidar = add_channel(index, "/velodyne_points", "sensor_msgs/msg/PointCloud2")
    for entry, file in enumerate(files):
        add_block(index, entry, file.stat().st_size, [times_ns[numbers[entry]]], {lidar: 1})
    if truth:
        poses = add_channel(index, "/ground_truth", "nav_msgs/msg/Odometry")
        add_block(index, _TRUTH, 720 * len(truth), [each for each, _ in truth], {poses: len(truth)})

    def make(index: FileIndex, block: Block, _: AbstractSet[int] | None) -> Contents:
        channel = index.channels[next(iter(block.counts))]
        if block.offset == _TRUTH:
            packed = [(each, pack_odometry(each, "world", "velodyne", place(T))) for each, T in truth]
            return Contents([Message(channel, each, memoryview(data)) for each, data in packed], "")
        read = partial(read_raw, point=XYZI)
        return contents_of(files[block.offset], channel, block.start_ns, read, "velodyne")

    index.contents = make
    return index


def read_times(file: Path) -> list[int]:
    """Times in nanoseconds of lines such as ``2011-09-26 13:02:25.594360375``, read as UTC."""
    try:
        if odd := next((line for line in _lines(file) if not _TIME.match(line)), ""):
            raise ValueError(shown(odd))
        times_ns = np.array(_lines(file), "datetime64[ns]").astype(np.int64)
    except ValueError as error:
        raise InputError(f"{file}: is not a list of times ({error}); download it again") from error
    return _checked(file, times_ns)


def _checked(file: Path, times_ns: NDArray[np.int64] | Matrix) -> list[int]:
    if not ((times_ns >= 0) & (times_ns < LATEST_NS)).all():
        raise InputError(f"{file}: has times before 1970 or after 2038; download it again")
    return times_ns.astype(np.int64).tolist()


def _entry(file: Path, name: str, shape: tuple[int, ...]) -> Matrix:
    """Numbers of the line ``name: numbers``."""
    entries = dict(line.split(":", 1) for line in _lines(file) if ":" in line)
    try:
        numbers = np.array(entries[name].split(), np.float64).reshape(shape)
    except (KeyError, ValueError) as error:
        count = int(np.prod(shape))
        raise InputError(f"{file}: has no line {name}: of {count} numbers ({error}); download it again") from error
    if not (np.abs(numbers) < _MOST_NUMBER).all():
        raise InputError(f"{file}: its line {name}: contains {numbers.ravel().tolist()}; download it again")
    return numbers


def read_oxts(folder: Path, T_lidar_imu: Pose) -> Matrix:
    """T_world_lidar (N, 4, 4) of the GPS/INS readings, relative to the first lidar pose.

    Latitude and longitude are projected by the Mercator projection scaled at the first latitude; R = Rz(yaw)
    Ry(pitch) Rx(roll), both as in KITTI's development kit.
    """
    rows = np.vstack([_table(file, 6)[:1] for file in sorted(folder.glob("*.txt"))] or [np.empty((0, 6))])
    if not len(rows):
        return np.empty((0, 4, 4))
    if np.abs(rows[:, 0]).max() > _MOST_LATITUDE_DEG:
        raise InputError(f"{folder}: has a latitude beyond {_MOST_LATITUDE_DEG:g} degrees; download it again")
    latitude, longitude, up_m, roll, pitch, yaw = rows.T
    scale = np.cos(np.radians(latitude[0]))
    T_world_imu = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_imu[:, 0, 3] = scale * _EARTH_M * np.radians(longitude)
    T_world_imu[:, 1, 3] = scale * _EARTH_M * np.log(np.tan(np.radians(90.0 + latitude) / 2.0))
    T_world_imu[:, 2, 3] = up_m
    T_world_imu[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    T_world_lidar = T_world_imu @ lie.inverse(T_lidar_imu)
    return lie.inverse(T_world_lidar[0]) @ T_world_lidar


def read_camera_poses(file: Path, calibration: Path) -> Matrix:
    """T_world_lidar (N, 4, 4) of the odometry benchmark's camera poses, relative to the first lidar pose."""
    rows = _table(file, 12)
    T_world_camera = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_camera[:, :3] = rows.reshape(-1, 3, 4)
    T_camera_lidar = np.vstack([_entry(calibration, "Tr", (3, 4)), [0.0, 0.0, 0.0, 1.0]])
    T_world_lidar = T_world_camera @ T_camera_lidar
    return np.linalg.inv(T_world_lidar[0]) @ T_world_lidar


def _table(file: Path, columns: int) -> Matrix:
    """First columns of a file of numbers. Raises InputError if one is not finite or implausibly large."""
    lines = _lines(file)
    try:
        rows = np.loadtxt(lines, comments=None, usecols=range(columns), ndmin=2) if lines else np.empty(0)
    except ValueError as error:
        raise InputError(
            f"{file}: is not a table of {columns} numbers per line ({error}); download it again"
        ) from error
    if not len(rows) or not (np.abs(rows) < _MOST_NUMBER).all():
        raise InputError(
            f"{file}: is empty or contains numbers that are not finite or too large; download it again"
        )
    return rows


def _lines(file: Path) -> list[str]:
    try:
        lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); download it again") from error
    return [line.strip() for line in lines if line.strip()]


RAW = Format(
    "kitti-raw", "a KITTI raw drive", lambda path, _: (path / "velodyne_points").is_dir(), index_kitti_raw
)
ODOMETRY = Format(
    "kitti-odometry",
    "a KITTI odometry sequence",
    lambda path, _: (path / "velodyne").is_dir() and (path / "times.txt").is_file(),
    index_kitti_odometry,
)
