"""ROS 2 messages serialized as CDR, and MCAP logs of them; written without ROS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import IO, Any, NamedTuple, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose
from scanchain.errors import InputError
from scanchain.logs.index import Channel
from scanchain.logs.messages.ros import NUMBERS, header, new, packed, point_fields, typestore

LATEST_NS = (1 << 31) * 1_000_000_000  # upper limit of ROS stamps
_NUMBER_TYPES = {code: number for number, code in NUMBERS.items()}


def place(T: Pose) -> Any:
    """A geometry_msgs/Pose of an SE(2) or SE(3) pose, (3, 3) or (4, 4)."""
    lifted = lie.lift(np.asarray(T, dtype=np.float64))
    return place_of(lifted[:3, 3].tolist(), lie.to_quaternion(lifted[:3, :3]).tolist())


def place_of(position_m: Sequence[float], quat_xyzw: Sequence[float]) -> Any:
    """A geometry_msgs/Pose."""
    position = new("geometry_msgs/msg/Point", *position_m)
    return new("geometry_msgs/msg/Pose", position, new("geometry_msgs/msg/Quaternion", *quat_xyzw))


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
    """A sensor_msgs/LaserScan; ranges (N,), inf for no return; the stamp is that of the first beam."""
    angle_max_rad = angle_min_rad + (len(ranges_m) - 1) * angle_increment_rad
    angles_rad = angle_min_rad, angle_max_rad, angle_increment_rad
    limits = time_increment_s, scan_time_s, range_min_m, range_max_m
    ranges = np.ascontiguousarray(ranges_m, np.float32)
    head = header(stamp_ns, frame)
    return packed("sensor_msgs/msg/LaserScan", head, *angles_rad, *limits, ranges, ranges[:0])


def pack_cloud(stamp_ns: int, frame: str, rows: NDArray[np.void]) -> bytes:
    """A sensor_msgs/PointCloud2 of one row: the fields of a structured array (N,), little endian."""
    layout = (rows.dtype.fields or {}).items()
    fields = point_fields(*((name, offset, _NUMBER_TYPES[kind.str[1:]]) for name, (kind, offset, *_) in layout))
    data = np.frombuffer(rows.tobytes(), np.uint8)
    parts = 1, len(rows), fields, False, rows.itemsize, rows.nbytes, data, True
    return packed("sensor_msgs/msg/PointCloud2", header(stamp_ns, frame), *parts)


def pack_odometry(
    stamp_ns: int, frame: str, child_frame: str, pose: Any, covariance: Matrix | None = None
) -> bytes:
    """A nav_msgs/Odometry: pose of ``child_frame`` in ``frame``, (6, 6) covariance; no twist."""
    spread = np.zeros(36) if covariance is None else covariance.astype(np.float64).ravel()
    posed = new("geometry_msgs/msg/PoseWithCovariance", pose, spread)
    still = new("geometry_msgs/msg/Twist", *[new("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)] * 2)
    twist = new("geometry_msgs/msg/TwistWithCovariance", still, np.zeros(36))
    return packed("nav_msgs/msg/Odometry", header(stamp_ns, frame), child_frame, posed, twist)


def pack_imu(stamp_ns: int, frame: str, rate_rad_s: Sequence[float], acceleration_m_s2: Sequence[float]) -> bytes:
    """A sensor_msgs/Imu without orientation and with unknown covariances; gravity is part of the acceleration."""
    unknown = np.zeros(9)
    absent = np.array([-1.0, *unknown[1:]])
    orientation = new("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    vectors = [new("geometry_msgs/msg/Vector3", *vector) for vector in (rate_rad_s, acceleration_m_s2)]
    parts = orientation, absent, vectors[0], unknown, vectors[1], unknown
    return packed("sensor_msgs/msg/Imu", header(stamp_ns, frame), *parts)


def pack_fix(stamp_ns: int, frame: str, position: Sequence[float], sigma_m: Sequence[float] | None) -> bytes:
    """A sensor_msgs/NavSatFix: latitude, longitude, altitude, σ east, north and up; None for no fix."""
    status = new("sensor_msgs/msg/NavSatStatus", -1 if sigma_m is None else 0, 1)
    covariance = np.diag(np.square(sigma_m or (0.0, 0.0, 0.0))).ravel()
    kind = 0 if sigma_m is None else 2  # unknown, or the diagonal is known
    return packed("sensor_msgs/msg/NavSatFix", header(stamp_ns, frame), status, *position, covariance, kind)


class Link(NamedTuple):
    """Pose of the frame ``child`` in ``parent``."""

    parent: str
    child: str
    pose: Any


def pack_transforms(stamp_ns: int, *links: Link) -> bytes:
    """A tf2_msgs/TFMessage."""
    transforms = []
    for parent, child, pose in links:
        moved = new("geometry_msgs/msg/Transform", pose.position, pose.orientation)
        transforms.append(new("geometry_msgs/msg/TransformStamped", header(stamp_ns, parent), child, moved))
    return packed("tf2_msgs/msg/TFMessage", transforms)


def pack_path(stamp_ns: int, frame: str, stamps_ns: Sequence[int], poses: Sequence[Any]) -> bytes:
    """A nav_msgs/Path: poses in ``frame``, each with its own stamp."""
    stamped = [
        new("geometry_msgs/msg/PoseStamped", header(each_ns, frame), pose)
        for each_ns, pose in zip(stamps_ns, poses, strict=True)
    ]
    return packed("nav_msgs/msg/Path", header(stamp_ns, frame), stamped)


def pack_grid(stamp_ns: int, frame: str, cells: NDArray[np.int8], resolution_m: float, origin: Any) -> bytes:
    """A nav_msgs/OccupancyGrid: (rows, columns) cells 0 free to 100 occupied, −1 unknown, row 0 at the origin."""
    rows, columns = cells.shape
    head = header(stamp_ns, frame)
    about = new("nav_msgs/msg/MapMetaData", head.stamp, resolution_m, columns, rows, origin)
    return packed("nav_msgs/msg/OccupancyGrid", head, about, np.ascontiguousarray(cells, np.int8).ravel())


@cache
def schema_text(name: str) -> bytes:
    """Definition of ``pkg/msg/Type`` and of every type it uses, as rosbag2 writes it.

    Empty for a type that is not part of ROS 2.
    """
    from rosbags.typesys import TypesysError

    try:
        return typestore().generate_msgdef(name, ros_version=2)[0].encode()
    except TypesysError:
        return b""


CHUNK_BYTES = 4 * 1024 * 1024  # uncompressed; smaller chunks compress less, larger ones cost memory on reading


class LogWriter:
    """Writer of a new log, a context manager. The file gets its name only when complete; errors leave none behind.

    Messages are recorded at ``log_time_ns``, by default their own stamp.
    """

    def __init__(self, destination: Path, *, force: bool = False, profile: str = "ros2") -> None:
        if destination.is_dir():
            raise InputError(f"{destination}: is a directory; give the name of a file to write")
        if destination.exists() and not force:
            raise InputError(f"{destination}: exists; choose another name or pass --force to replace it")
        self.destination = destination
        self._partial = destination.with_name(f".{destination.name}.partial")
        try:
            destination.parent.mkdir(parents=True, exist_ok=True)
            self._stream: IO[bytes] = self._partial.open("wb")
        except OSError as error:
            raise InputError(f"{destination}: not writable ({error.strerror}); choose another path") from error
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile=profile, library="scanchain")
        self._schema, self._channel = cache(self._writer.register_schema), cache(self._writer.register_channel)
        self._sequence = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, _: object) -> None:
        try:
            if kind is None:
                self._writer.finish()
                self._stream.close()
                self._partial.replace(self.destination)
        except OSError as failure:
            error = failure
            raise
        finally:
            if isinstance(error, OSError) and error.filename is None:
                error.filename = str(self.destination)
            with suppress(OSError):  # flushing buffered data fails on a full disk
                self._stream.close()
            self._partial.unlink(missing_ok=True)

    def point_cloud(
        self,
        topic: str,
        stamp_ns: int,
        frame: str,
        points: NDArray[np.floating],
        fields: Mapping[str, NDArray[np.number]] | None = None,
        log_time_ns: int | None = None,
    ) -> None:
        """Append a sensor_msgs/PointCloud2 of one row: points (N, 3) in meters, and more fields (N,) by name."""
        columns = dict(zip("xyz", points.T.astype(np.float32), strict=True)) | dict(fields or {})
        point = [(name, values.dtype) for name, values in columns.items()]
        rows = np.rec.fromarrays(list(columns.values()), dtype=point)
        self.append(topic, "sensor_msgs/msg/PointCloud2", pack_cloud(stamp_ns, frame, rows), stamp_ns, log_time_ns)

    def append(self, topic: str, schema: str, data: bytes, stamp_ns: int, log_time_ns: int | None = None) -> None:
        """Append a packed message of the type ``schema``, pkg/msg/Type."""
        channel = Channel((0, 0), topic, "cdr", 0, schema, "ros2msg", schema_text(schema))
        self.copy(channel, stamp_ns if log_time_ns is None else log_time_ns, data)

    def copy(self, channel: Channel, log_time_ns: int, data: bytes) -> None:
        """Append a message of another log unchanged, with its topic, type, encoding and definition."""
        schema = 0  # stands for none
        if channel.type_name or channel.definition:
            schema = self._schema(channel.type_name, channel.schema_encoding, channel.definition)
        number = self._channel(channel.topic, channel.encoding, schema)
        self._writer.add_message(number, log_time_ns, data, log_time_ns, self._sequence)
        self._sequence += 1
