"""ROS 2 messages packed in CDR, and the definitions (schema encoding ros2msg) that a log carries beside them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose

LATEST_NS = (1 << 31) * 1_000_000_000  # largest stamp of ROS
_FIELD_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}  # sensor_msgs/PointField


class Place(NamedTuple):
    """A pose in messages: meters and a unit quaternion."""

    x: float
    y: float
    z: float
    qx: float
    qy: float
    qz: float
    qw: float


ORIGIN = Place(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def place(T: Pose) -> Place:
    """An SE(2) or SE(3) pose, (3, 3) or (4, 4)."""
    lifted = lie.lift(np.asarray(T, dtype=np.float64))
    return Place(*lifted[:3, 3].tolist(), *lie.to_quaternion(lifted[:3, :3]).tolist())


def pack_laser_scan(
    stamp_ns: int,
    frame: str,
    angle_min_rad: float,
    angle_increment_rad: float,
    ranges_m: NDArray[np.floating],
    *,
    range_min_m: float,
    range_max_m: float,
    time_increment_s: float = 0.0,
    scan_time_s: float = 0.0,
) -> bytes:
    """A sensor_msgs/LaserScan; (N,) ranges, inf where nothing came back, stamp = first beam."""
    angle_max_rad = angle_min_rad + (len(ranges_m) - 1) * angle_increment_rad
    cdr = _Cdr()
    cdr.header(stamp_ns, frame)
    cdr.numbers("f", angle_min_rad, angle_max_rad, angle_increment_rad, time_increment_s, scan_time_s)
    cdr.numbers("f", range_min_m, range_max_m)
    cdr.numbers("I", len(ranges_m))
    cdr.data += np.ascontiguousarray(ranges_m, dtype="<f4").tobytes()
    cdr.numbers("I", 0)  # intensities
    return bytes(cdr.data)


def pack_cloud(stamp_ns: int, frame: str, rows: NDArray[np.void]) -> bytes:
    """A sensor_msgs/PointCloud2 of one row: the fields of a structured array (N,), little endian."""
    fields = rows.dtype.fields or {}
    cdr = _Cdr()
    cdr.header(stamp_ns, frame)
    cdr.numbers("I", 1, len(rows), len(fields))
    for name, field in fields.items():
        cdr.string(name)
        cdr.numbers("I", field[1])
        cdr.numbers("B", _FIELD_TYPES[field[0].str[1:]])
        cdr.numbers("I", 1)
    cdr.numbers("B", 0)  # little endian
    cdr.numbers("I", rows.itemsize, rows.nbytes, rows.nbytes)
    cdr.data += rows.tobytes()
    cdr.numbers("B", 1)  # dense
    return bytes(cdr.data)


def pack_odometry(
    stamp_ns: int, frame: str, child_frame: str, pose: Place, covariance: Matrix | None = None
) -> bytes:
    """A nav_msgs/Odometry: pose of ``child_frame`` in ``frame``, (6, 6) covariance; no twist."""
    cdr = _Cdr()
    cdr.header(stamp_ns, frame)
    cdr.string(child_frame)
    cdr.numbers("d", *pose)
    cdr.data += (np.zeros((6, 6)) if covariance is None else covariance.astype("<f8")).tobytes()
    cdr.numbers("d", *([0.0] * 42))
    return bytes(cdr.data)


class Link(NamedTuple):
    """The pose of the frame ``child`` in ``parent``."""

    parent: str
    child: str
    pose: Place


def pack_transforms(stamp_ns: int, *links: Link) -> bytes:
    """A tf2_msgs/TFMessage."""
    cdr = _Cdr()
    cdr.numbers("I", len(links))
    for link in links:
        cdr.header(stamp_ns, link.parent)
        cdr.string(link.child)
        cdr.numbers("d", *link.pose)
    return bytes(cdr.data)


def pack_path(stamp_ns: int, frame: str, stamps_ns: Sequence[int], poses: Sequence[Place]) -> bytes:
    """A nav_msgs/Path: poses in ``frame``, each with its own stamp."""
    cdr = _Cdr()
    cdr.header(stamp_ns, frame)
    cdr.numbers("I", len(poses))
    for each_ns, pose in zip(stamps_ns, poses, strict=True):
        cdr.header(each_ns, frame)
        cdr.numbers("d", *pose)
    return bytes(cdr.data)


def pack_grid(stamp_ns: int, frame: str, cells: NDArray[np.int8], resolution_m: float, origin: Place) -> bytes:
    """A nav_msgs/OccupancyGrid: (rows, columns) cells 0 free to 100 occupied, −1 unknown, row 0 at the origin."""
    rows, columns = cells.shape
    cdr = _Cdr()
    cdr.header(stamp_ns, frame)
    cdr.stamp(stamp_ns)
    cdr.numbers("f", resolution_m)
    cdr.numbers("I", columns, rows)
    cdr.numbers("d", *origin)
    cdr.numbers("I", cells.size)
    cdr.data += np.ascontiguousarray(cells, np.int8).tobytes()
    return bytes(cdr.data)


class _Cdr:
    """A message in ROS 2's CDR, little endian: numbers lie at multiples of their size, counted from byte 4."""

    __slots__ = ("data",)

    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")

    def numbers(self, code: str, *values: float) -> None:
        size = struct.calcsize(f"<{code}")
        self.data += bytes(-(len(self.data) - 4) % size)
        self.data += struct.pack(f"<{len(values)}{code}", *values)

    def string(self, text: str) -> None:
        encoded = text.encode() + b"\x00"
        self.numbers("I", len(encoded))
        self.data += encoded

    def header(self, stamp_ns: int, frame: str) -> None:
        self.stamp(stamp_ns)
        self.string(frame)

    def stamp(self, stamp_ns: int) -> None:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        self.numbers("i", seconds)
        self.numbers("I", nanoseconds)


@cache
def schema_text(name: str) -> bytes:
    """The definition of ``pkg/msg/Type`` followed by those of every type it uses, as rosbag2 writes it.

    Empty for a type that ROS 2 does not bring.
    """
    from rosbags.typesys import Stores, TypesysError, get_typestore  # a tenth of a second

    try:
        return get_typestore(Stores.ROS2_HUMBLE).generate_msgdef(name, ros_version=2)[0].encode()
    except TypesysError:
        return b""
