"""KITTI's folders: sweeps of the raw recordings and of the odometry benchmark, with their ground truth.

Geiger, Lenz, Stiller & Urtasun 2013, "Vision meets robotics: the KITTI dataset".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path

from numpy.linalg import LinAlgError

from scanchain.data import Pose
from scanchain.errors import InputError
from scanchain.logs.formats.cloud_file import read_xyzi
from scanchain.logs.formats.kitti_truth import (
    read_calibration,
    read_camera_poses,
    read_oxts,
    read_seconds,
    read_times,
)
from scanchain.logs.formats.made import made_block, made_channel, made_index, natural_order
from scanchain.logs.formats.point_rows import CloudFileError
from scanchain.logs.mcap.records import Block, Channel, Contents, FileIndex, Message
from scanchain.logs.writing.pack import pack_cloud, pack_odometry, place
from scanchain.words import counted

_TRUTH = -1  # the block of the ground truth
_POSE_BYTES = 720
Told = list[tuple[int, Pose]]  # stamps in nanoseconds, and T_world_lidar


def index_kitti_raw(folder: Path, number: int) -> FileIndex:
    """A drive of the raw recordings (``..._sync``); truth is its GPS/INS, moved to the lidar."""
    files = _sweeps(folder / "velodyne_points" / "data")
    times_ns = read_times(folder / "velodyne_points" / "timestamps.txt")
    index = made_index(folder, number)
    return _index(index, files, times_ns, _told(index, lambda: _raw_truth(index, folder)))


def index_kitti_odometry(folder: Path, number: int) -> FileIndex:
    """A sequence of the odometry benchmark (``sequences/00``); truth lies in ``poses/00.txt`` beside it."""
    files = _sweeps(folder / "velodyne")
    times_ns = read_seconds(folder / "times.txt")
    index = made_index(folder, number)
    return _index(index, files, times_ns, _told(index, lambda: _benchmark_truth(index, folder, times_ns)))


def _raw_truth(index: FileIndex, folder: Path) -> Told:
    calibration = folder.parent / "calib_imu_to_velo.txt"
    if not (folder / "oxts").is_dir():
        index.notes.append(f"{folder}: has no oxts folder, so no ground truth")
        return []
    if not calibration.is_file():
        index.notes.append(
            f"{calibration}: is absent, so the GPS/INS poses cannot be moved to the lidar; no truth"
        )
        return []
    times_ns = read_times(folder / "oxts" / "timestamps.txt")
    poses = read_oxts(folder / "oxts" / "data", read_calibration(calibration))
    if len(poses) != len(times_ns):
        raise InputError(
            f"{folder / 'oxts'}: has {counted(len(poses), 'reading')} and {counted(len(times_ns), 'time')}; "
            "fetch it again"
        )
    return list(zip(times_ns, poses, strict=True))


def _benchmark_truth(index: FileIndex, folder: Path, times_ns: Sequence[int]) -> Told:
    name = folder.resolve().name
    file = folder.resolve().parent.parent / "poses" / f"{name}.txt"
    if not file.is_file():
        index.notes.append(f"{file}: is absent, so there is no ground truth")
        return []
    return list(zip(times_ns, read_camera_poses(file, folder / "calib.txt"), strict=False))


def _told(index: FileIndex, read: Callable[[], Told]) -> Told:
    """The ground truth; none where its files are damaged, which the sweeps do not suffer from."""
    try:
        return read()
    except (InputError, LinAlgError) as error:
        index.note_damage(f"{error}; until then there is no ground truth")
        return []


def _sweeps(folder: Path) -> list[Path]:
    files = sorted(folder.glob("*.bin"), key=natural_order)
    if not files:
        raise InputError(f"{folder}: has no .bin file; of the raw recordings take the synced ones (..._sync)")
    return files


def _index(index: FileIndex, files: Sequence[Path], times_ns: Sequence[int], told: Told) -> FileIndex:
    """/velodyne_points from the files, whose names count the times, and /ground_truth."""
    numbers = [int(file.stem) for file in files if file.stem.isdigit()]
    if len(numbers) < len(files) or max(numbers) >= len(times_ns):
        raise InputError(
            f"{files[-1]}: does not fit the {counted(len(times_ns), 'timestamp')}; names must be numbers from 0 up"
        )
    lidar = made_channel(index, "/velodyne_points", "sensor_msgs/msg/PointCloud2")
    for entry, file in enumerate(files):
        made_block(index, entry, file.stat().st_size, [times_ns[numbers[entry]]], {lidar: 1})
    if told:
        poses = made_channel(index, "/ground_truth", "nav_msgs/msg/Odometry")
        made_block(index, _TRUTH, _POSE_BYTES * len(told), [stamp_ns for stamp_ns, _ in told], {poses: len(told)})

    def make(block: Block, wanted: AbstractSet[int] | None) -> Contents:
        channel = index.channels[block.entries[0].channel]
        if wanted is not None and channel.key[1] not in wanted:
            return Contents([], "")
        if block.offset == _TRUTH:
            return _truth(channel, told)
        return _sweep(channel, files[block.offset], block.start_ns)

    index.make = make
    return index


def _sweep(channel: Channel, file: Path, stamp_ns: int) -> Contents:
    try:
        data = pack_cloud(stamp_ns, "velodyne", read_xyzi(file))
    except (CloudFileError, OSError) as error:
        return Contents([], f"{file}: {error}; it was left out")
    return Contents([Message(channel, stamp_ns, memoryview(data))], "")


def _truth(channel: Channel, told: Told) -> Contents:
    messages = []
    for stamp_ns, T_world_lidar in told:
        data = pack_odometry(stamp_ns, "world", "velodyne", place(T_world_lidar))
        messages.append(Message(channel, stamp_ns, memoryview(data)))
    return Contents(messages, "")
