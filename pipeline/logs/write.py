"""Writing an MCAP log of ROS 2 messages, without ROS."""

from __future__ import annotations

import struct
from pathlib import Path
from types import TracebackType
from typing import IO, Literal, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from pipeline import lie
from pipeline.data import Matrix, Pose
from pipeline.errors import InputError
from pipeline.logs.ros2_definitions import schema_text

CHUNK_BYTES = 4 * 1024 * 1024
_FIELD_TYPES = {"<f4": 7, "<u4": 6, "<u2": 4}  # sensor_msgs/PointField


class LogWriter:
    """A new log; a context manager. It takes its name only when complete, an exception leaves nothing behind.

    Messages are recorded at ``log_time_ns``, by default their own stamp. Poses may be SE(2) or SE(3).
    """

    def __init__(self, destination: Path, *, force: bool = False) -> None:
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
        self._writer.start(profile="ros2", library="scanchain")
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._sequence = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None
    ) -> None:
        if kind is not None:
            self._stream.close()
            self._partial.unlink()
            return
        self._writer.finish()
        self._stream.close()
        self._partial.replace(self.destination)

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
        angle_max_rad = angle_min_rad + (len(ranges_m) - 1) * angle_increment_rad
        cdr = _Cdr()
        cdr.header(stamp_ns, frame)
        cdr.numbers("f", angle_min_rad, angle_max_rad, angle_increment_rad, time_increment_s, scan_time_s)
        cdr.numbers("f", range_min_m, range_max_m)
        cdr.numbers("I", len(ranges_m))
        cdr.data += np.ascontiguousarray(ranges_m, dtype="<f4").tobytes()
        cdr.numbers("I", 0)  # intensities
        self._append(topic, "sensor_msgs/msg/LaserScan", cdr, stamp_ns, log_time_ns)

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

        points : (N, 3) metres
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
        self._append(topic, "sensor_msgs/msg/PointCloud2", _cloud(stamp_ns, frame, rows), stamp_ns, log_time_ns)

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
        cdr = _Cdr()
        cdr.header(stamp_ns, frame)
        cdr.string(child_frame)
        cdr.numbers("d", *_position_and_quaternion(T))
        cdr.data += (np.zeros((6, 6)) if covariance is None else covariance.astype("<f8")).tobytes()
        cdr.numbers("d", *([0.0] * 42))
        self._append(topic, "nav_msgs/msg/Odometry", cdr, stamp_ns, log_time_ns)

    def static_transform(
        self, stamp_ns: int, parent: str, child: str, T: Pose, *, log_time_ns: int | None = None
    ) -> None:
        """Append a tf2_msgs/TFMessage to /tf_static: pose of ``child`` in ``parent``."""
        cdr = _Cdr()
        cdr.numbers("I", 1)
        cdr.header(stamp_ns, parent)
        cdr.string(child)
        cdr.numbers("d", *_position_and_quaternion(T))
        self._append("/tf_static", "tf2_msgs/msg/TFMessage", cdr, stamp_ns, log_time_ns)

    def _append(self, topic: str, schema: str, cdr: _Cdr, stamp_ns: int, log_time_ns: int | None) -> None:
        time_ns = stamp_ns if log_time_ns is None else log_time_ns
        self._writer.add_message(self._channel(topic, schema), time_ns, bytes(cdr.data), time_ns, self._sequence)
        self._sequence += 1

    def _channel(self, topic: str, schema: str) -> int:
        key = (topic, schema)
        if key not in self._channels:
            if schema not in self._schemas:
                self._schemas[schema] = self._writer.register_schema(schema, "ros2msg", schema_text(schema))
            self._channels[key] = self._writer.register_channel(topic, "cdr", self._schemas[schema])
        return self._channels[key]


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
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        self.numbers("i", seconds)
        self.numbers("I", nanoseconds)
        self.string(frame)


def _cloud(stamp_ns: int, frame: str, rows: NDArray[np.void]) -> _Cdr:
    fields = rows.dtype.fields or {}
    cdr = _Cdr()
    cdr.header(stamp_ns, frame)
    cdr.numbers("I", 1, len(rows), len(fields))
    for name, field in fields.items():
        cdr.string(name)
        cdr.numbers("I", field[1])
        cdr.numbers("B", _FIELD_TYPES[field[0].str])
        cdr.numbers("I", 1)
    cdr.numbers("B", 0)  # little endian
    cdr.numbers("I", rows.itemsize, rows.nbytes, rows.nbytes)
    cdr.data += rows.tobytes()
    cdr.numbers("B", 1)  # dense
    return cdr


def _whole_ns(times_s: NDArray[np.floating]) -> NDArray[np.int64]:
    if len(times_s) and times_s.min() < 0.0:
        raise InputError(f"point time {times_s.min():.6f} s is before the stamp; use time_field='time'")
    return np.rint(np.asarray(times_s, dtype=np.float64) * 1e9).astype(np.int64)


def _position_and_quaternion(T: Pose) -> tuple[float, ...]:
    lifted = lie.lift(np.asarray(T, dtype=np.float64))
    return (*lifted[:3, 3].tolist(), *lie.to_quaternion(lifted[:3, :3]).tolist())
