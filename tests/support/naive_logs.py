"""Logs written by the mcap package, packed by hand in either byte order: independent of scanchain.logs."""

import struct
from dataclasses import dataclass

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory

from scanchain.logs.writer import schema_text

SECOND = 1_000_000_000
STAMP_NS = 1_700_000_000 * SECOND
COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


class Cdr:
    """A message in CDR, little ("<") or big (">") endian."""

    def __init__(self, order="<"):
        self.order = order
        self.body = bytearray()

    def put(self, code, *values):
        for value in values:
            size = struct.calcsize(code)
            while len(self.body) % size:
                self.body.append(0xAA)  # padding is not always zero
            self.body += struct.pack(self.order + code, value)
        return self

    def string(self, text):
        raw = text.encode() + b"\0"
        self.put("I", len(raw))
        self.body += raw
        return self

    def header(self, stamp_ns, frame):
        return self.put("i", stamp_ns // SECOND).put("I", stamp_ns % SECOND).string(frame)

    def pose(self, x, y, yaw=0.0, z=0.0, roll=0.0):
        """Position, then the quaternion of Rz(yaw) Rx(roll)."""
        cy, sy, cr, sr = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(roll / 2), np.sin(roll / 2)
        return self.put("d", x, y, z, cy * sr, sy * sr, sy * cr, cy * cr)

    def __bytes__(self):
        return bytes([0, 1 if self.order == "<" else 0, 0, 0]) + bytes(self.body)


def laser_scan(
    stamp_ns, ranges, *, first=-1.0, step=0.01, beam_s=0.0, low=0.1, high=30.0, frame="laser", order="<",
    declared=None,
):  # fmt: skip
    cdr = Cdr(order).header(stamp_ns, frame)
    cdr.put("f", first, first + step * (len(ranges) - 1), step, beam_s, 0.1, low, high)
    cdr.put("I", len(ranges) if declared is None else declared).put("f", *ranges)
    return bytes(cdr.put("I", 0))


def point_cloud(
    stamp_ns, rows, *, frame="lidar", order="<", height=1, padding=0, fields=None, step=None, data=None,
    row_step=None,
):  # fmt: skip
    """A cloud of a structured array; ``padding`` bytes behind each row; other arguments tell lies."""
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    big = any(rows.dtype[name].byteorder == ">" for name in rows.dtype.names)
    width = len(rows) // height
    if fields is None:
        fields = [
            (name, rows.dtype.fields[name][1], codes[rows.dtype[name].str[1:]], 1) for name in rows.dtype.names
        ]
    if data is None:
        parts = rows.reshape(height, width)
        data = b"".join(part.tobytes() + b"\xff" * padding for part in parts)
    cdr = Cdr(order).header(stamp_ns, frame).put("I", height, width, len(fields))
    for name, offset, kind, count in fields:
        cdr.string(name).put("I", offset).put("B", kind).put("I", count)
    cdr.put("B", big)
    cdr.put("I", rows.dtype.itemsize if step is None else step)
    cdr.put("I", width * rows.dtype.itemsize + padding if row_step is None else row_step)
    cdr.put("I", len(data))
    cdr.body += data
    return bytes(cdr.put("B", 0))


def odometry(stamp_ns, x, y, yaw=0.0, *, z=0.0, frame="odom", child="base_link", order="<"):
    cdr = Cdr(order).header(stamp_ns, frame).string(child).pose(x, y, yaw, z)
    return bytes(cdr.put("d", *[0.0] * (36 + 6 + 36)))


def transforms(*entries, order="<", stamp_ns=0):
    """A TFMessage of (parent, child, x, y, yaw, roll)."""
    cdr = Cdr(order).put("I", len(entries))
    for parent, child, x, y, yaw, roll in entries:
        cdr.header(stamp_ns, parent).string(child).pose(x, y, yaw, 0.5, roll)
    return bytes(cdr)


@dataclass
class Said:
    """A message and where it goes."""

    topic: str
    kind: str
    log_ns: int
    data: bytes


def scan_said(log_ns, data, topic="/scan"):
    return Said(topic, "sensor_msgs/msg/LaserScan", log_ns, data)


def cloud_said(log_ns, data, topic="/points"):
    return Said(topic, "sensor_msgs/msg/PointCloud2", log_ns, data)


def odometry_said(log_ns, data, topic="/odom"):
    return Said(topic, "nav_msgs/msg/Odometry", log_ns, data)


def transforms_said(log_ns, data, topic="/tf_static"):
    return Said(topic, "tf2_msgs/msg/TFMessage", log_ns, data)


def write(
    path, messages, *, chunked=True, compression="zstd", summary=True, chunk_size=2000, crcs=True,
    encoding="ros2msg", rename=lambda kind: kind, message_encoding="cdr", announced=(), **options,
):  # fmt: skip
    """Write messages in the given order; ``announced`` are topics registered without any message."""
    if not summary:
        left_out = ("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets")
        options |= {"index_types": IndexType.NONE, **dict.fromkeys(left_out, False)}
    with path.open("wb") as stream:
        writer = Writer(
            stream,
            chunk_size=chunk_size,
            compression=COMPRESSIONS[compression],
            use_chunking=chunked,
            enable_crcs=crcs,
            **options,
        )
        writer.start(profile="ros2", library="by hand")
        channels = {}
        for said in (*announced, *messages):
            if said.topic not in channels:
                schema = writer.register_schema(rename(said.kind), encoding, schema_text(said.kind))
                channels[said.topic] = writer.register_channel(said.topic, message_encoding, schema)
            if said.data:
                writer.add_message(channels[said.topic], said.log_ns, said.data, said.log_ns)
        writer.finish()
    return path


def decoded(path, topics=None):
    """(schema, channel, message, contents) of every message, read by the mcap packages."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        yield from reader.iter_decoded_messages(topics)


def office(count=40, *, begin_ns=STAMP_NS):
    """A mounting, then ``count`` pairs of odometry and scan of one stamp; scan k sees ranges from 1 + k/100."""
    said = [transforms_said(begin_ns, transforms(("base_link", "laser", 0.2, 0.1, 0.3, 0.0)))]
    for k in range(count):
        stamp_ns = begin_ns + k * SECOND // 10
        ranges = 1.0 + k / 100 + 0.05 * np.arange(31)
        said.append(odometry_said(stamp_ns, odometry(stamp_ns, 0.1 * k, 0.0, 0.01 * k)))
        said.append(scan_said(stamp_ns, laser_scan(stamp_ns, ranges)))
    return said


def laser_points(ranges, first=-1.0, step=0.01):
    """What a scan's ranges are as points (N, 2)."""
    angles = np.float32(first) + np.float32(step).astype(float) * np.arange(len(ranges))
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])
