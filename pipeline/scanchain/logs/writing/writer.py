"""Writing an MCAP log of ROS 2 messages, without ROS."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Literal, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from scanchain.data import Matrix, Pose
from scanchain.errors import InputError
from scanchain.logs.mcap.records import Channel
from scanchain.logs.writing.pack import (
    Link,
    pack_cloud,
    pack_laser_scan,
    pack_odometry,
    pack_transforms,
    place,
    schema_text,
)

CHUNK_BYTES = 4 * 1024 * 1024


class LogWriter:
    """A new log; a context manager. It takes its name only when complete, an exception leaves nothing behind.

    Messages are recorded at ``log_time_ns``, by default their own stamp. Poses may be SE(2) or SE(3).
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
            raise InputError(f"{destination}: not writable ({error.strerror}); choose another place") from error
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile=profile, library="scanchain")
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, str, bytes], int] = {}
        self._sequence = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
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
            with suppress(OSError):  # what is buffered still, on a full disk
                self._stream.close()
            self._partial.unlink(missing_ok=True)

    def laser_scan(
        self,
        topic: str,
        stamp_ns: int,
        frame: str,
        angle_min_rad: float,
        angle_increment_rad: float,
        time_increment_s: float,
        ranges_m: NDArray[np.floating],
        *,
        range_min_m: float,
        range_max_m: float,
        scan_time_s: float = 0.0,
        log_time_ns: int | None = None,
    ) -> None:
        """Append a sensor_msgs/LaserScan; (N,) ranges, inf where nothing came back, stamp = first beam."""
        data = pack_laser_scan(
            stamp_ns,
            frame,
            angle_min_rad,
            angle_increment_rad,
            ranges_m,
            range_min_m=range_min_m,
            range_max_m=range_max_m,
            time_increment_s=time_increment_s,
            scan_time_s=scan_time_s,
        )
        self.append(topic, "sensor_msgs/msg/LaserScan", data, stamp_ns, log_time_ns)

    def point_cloud(
        self,
        topic: str,
        stamp_ns: int,
        frame: str,
        points: NDArray[np.floating],
        *,
        times_s: NDArray[np.floating] | None = None,
        time_field: Literal["t", "time"] = "t",
        ring: NDArray[np.integer] | None = None,
        intensity: NDArray[np.floating] | None = None,
        log_time_ns: int | None = None,
    ) -> None:
        """Append a sensor_msgs/PointCloud2 of one row.

        points : (N, 3) meters
        times_s : (N,) seconds after ``stamp_ns``; written as ``t`` (uint32 ns, from 0 up) or ``time`` (float32 s)
        ring, intensity : (N,) written as uint16 and float32
        """
        columns: dict[str, tuple[str, NDArray[np.number]]] = {
            name: ("<f4", points[:, axis]) for axis, name in enumerate("xyz")
        }
        if intensity is not None:
            columns["intensity"] = ("<f4", intensity)
        if times_s is not None:
            columns[time_field] = ("<f4", times_s) if time_field == "time" else ("<u4", _whole_ns(times_s))
        if ring is not None:
            columns["ring"] = ("<u2", ring)
        rows = np.empty(len(points), dtype=[(name, code) for name, (code, _) in columns.items()])
        for name, (_, values) in columns.items():
            rows[name] = values
        self.append(topic, "sensor_msgs/msg/PointCloud2", pack_cloud(stamp_ns, frame, rows), stamp_ns, log_time_ns)

    def odometry(
        self,
        topic: str,
        stamp_ns: int,
        frame: str,
        child_frame: str,
        T: Pose,
        covariance: Matrix | None = None,
        *,
        log_time_ns: int | None = None,
    ) -> None:
        """Append a nav_msgs/Odometry: pose of ``child_frame`` in ``frame``, (6, 6) covariance; no twist."""
        data = pack_odometry(stamp_ns, frame, child_frame, place(T), covariance)
        self.append(topic, "nav_msgs/msg/Odometry", data, stamp_ns, log_time_ns)

    def static_transform(
        self, stamp_ns: int, parent: str, child: str, T: Pose, *, log_time_ns: int | None = None
    ) -> None:
        """Append a tf2_msgs/TFMessage to /tf_static: pose of ``child`` in ``parent``."""
        data = pack_transforms(stamp_ns, Link(parent, child, place(T)))
        self.append("/tf_static", "tf2_msgs/msg/TFMessage", data, stamp_ns, log_time_ns)

    def copy(self, channel: Channel, log_time_ns: int, data: bytes) -> None:
        """Append a message of another log as it is, with its topic, type, encoding and definition."""
        key = (channel.topic, channel.encoding, channel.type_name, channel.definition)
        if key not in self._channels:
            number = self._schema(channel.type_name, channel.schema_encoding, channel.definition)
            self._channels[key] = self._writer.register_channel(channel.topic, channel.encoding, number)
        self._add(self._channels[key], log_time_ns, data)

    def append(self, topic: str, schema: str, data: bytes, stamp_ns: int, log_time_ns: int | None = None) -> None:
        """Append a packed message of the type ``schema``, pkg/msg/Type."""
        time_ns = stamp_ns if log_time_ns is None else log_time_ns
        key = (topic, "cdr", schema, b"")
        if key not in self._channels:
            number = self._schema(schema, "ros2msg", schema_text(schema))
            self._channels[key] = self._writer.register_channel(topic, "cdr", number)
        self._add(self._channels[key], time_ns, data)

    def _add(self, channel: int, log_time_ns: int, data: bytes) -> None:
        self._writer.add_message(channel, log_time_ns, data, log_time_ns, self._sequence)
        self._sequence += 1

    def _schema(self, name: str, encoding: str, definition: bytes) -> int:
        """The id of a schema; 0 stands for none."""
        key = (name, encoding, definition)
        if not name and not definition:
            return 0
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(name, encoding, definition)
        return self._schemas[key]


def _whole_ns(times_s: NDArray[np.floating]) -> NDArray[np.int64]:
    if len(times_s) and times_s.min() < 0.0:
        raise InputError(f"point time {times_s.min():.6f} s is before the stamp; use time_field='time'")
    return np.rint(np.asarray(times_s, dtype=np.float64) * 1e9).astype(np.int64)
