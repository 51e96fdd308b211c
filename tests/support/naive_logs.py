"""Logs as others write them: messages of ROS by rosbags, in either byte order, in MCAP by the mcap package."""

import struct
from dataclasses import dataclass

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SECOND = 1_000_000_000
STAMP_NS = 1_700_000_000 * SECOND
COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))


class Ros:
    """Messages of ROS 1 or 2 as rosbags builds and serializes them."""

    def __init__(self, store):
        self.store = store
        self.is_ros1 = store is ROS1
        self.encoding, self.language = ("ros1", "ros1msg") if self.is_ros1 else ("cdr", "ros2msg")

    def serialize(self, message, type_name, order="<"):
        if self.is_ros1:
            return bytes(self.store.serialize_ros1(message, type_name))
        return bytes(self.store.serialize_cdr(message, type_name, little_endian=order == "<"))

    def definition(self, type_name):
        return self.store.generate_msgdef(type_name, ros_version=1 if self.is_ros1 else 2)[0].encode()

    def new(self, type_name, **fields):
        return self.store.types[type_name](**fields)

    def header(self, stamp_ns, frame):
        stamp = self.new("builtin_interfaces/msg/Time", sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
        sequence = {"seq": 7} if self.is_ros1 else {}
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **sequence)

    def pose(self, x, y=0.0, yaw=0.0, z=0.0, roll=0.0):
        """Position, and the quaternion of Rz(yaw) Rx(roll)."""
        cy, sy, cr, sr = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(roll / 2), np.sin(roll / 2)
        turn = self.new("geometry_msgs/msg/Quaternion", x=cy * sr, y=sy * sr, z=sy * cr, w=cy * cr)
        position = self.new("geometry_msgs/msg/Point", x=x, y=y, z=z)
        return self.new("geometry_msgs/msg/Pose", position=position, orientation=turn)

    def with_covariance(self, pose):
        return self.new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))

    def laser_scan(
        self, stamp_ns, ranges, *, first=-1.0, step=0.01, beam_s=0.0, low=0.1, high=30.0, frame="laser",
        kind="LaserScan",
    ):  # fmt: skip
        return self.new(
            f"sensor_msgs/msg/{kind}", header=self.header(stamp_ns, frame), angle_min=first,
            angle_max=first + step * (len(ranges) - 1), angle_increment=step, time_increment=beam_s, scan_time=0.1,
            range_min=low, range_max=high, ranges=ranges,
            intensities=np.zeros(0, "f4") if kind == "LaserScan" else [],
        )  # fmt: skip

    def point_cloud(
        self, stamp_ns, rows, *, frame="lidar", height=1, padding=0, fields=None, step=None, data=None,
        row_step=None,
    ):  # fmt: skip
        """A cloud of a structured array; ``padding`` bytes behind each row; other arguments tell lies."""
        codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8, "u8": 10}
        names, width = rows.dtype.names, len(rows) // height
        if fields is None:
            fields = [(name, rows.dtype.fields[name][1], codes[rows.dtype[name].str[1:]], 1) for name in names]
        if data is None:
            data = b"".join(part.tobytes() + b"\xff" * padding for part in rows.reshape(height, width))
        keys = ("name", "offset", "datatype", "count")
        fields = [self.new("sensor_msgs/msg/PointField", **dict(zip(keys, each, strict=True))) for each in fields]
        size = rows.dtype.itemsize
        return self.new(
            "sensor_msgs/msg/PointCloud2", header=self.header(stamp_ns, frame), height=height, width=width,
            fields=fields, is_bigendian=any(rows.dtype[name].byteorder == ">" for name in names),
            point_step=size if step is None else step, data=np.frombuffer(data, np.uint8), is_dense=False,
            row_step=width * size + padding if row_step is None else row_step,
        )  # fmt: skip

    def odometry(self, stamp_ns, x, y=0.0, yaw=0.0, *, z=0.0, frame="odom", child="base_link"):
        vector = self.new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.new("geometry_msgs/msg/Twist", linear=vector, angular=vector)
        return self.new(
            "nav_msgs/msg/Odometry", header=self.header(stamp_ns, frame), child_frame_id=child,
            pose=self.with_covariance(self.pose(x, y, yaw, z)),
            twist=self.new("geometry_msgs/msg/TwistWithCovariance", covariance=np.zeros(36), twist=twist),
        )  # fmt: skip

    def transforms(self, *entries, stamp_ns=0):
        """A TFMessage of (parent, child, x, y, yaw, roll), half a meter above the parent."""
        told = []
        for parent, child, x, y, yaw, roll in entries:
            turn = self.pose(x, y, yaw, 0.5, roll).orientation
            move = self.new("geometry_msgs/msg/Vector3", x=x, y=y, z=0.5)
            moved = self.new("geometry_msgs/msg/Transform", translation=move, rotation=turn)
            head = self.header(stamp_ns, parent)
            told.append(
                self.new("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=moved)
            )
        return self.new("tf2_msgs/msg/TFMessage", transforms=told)


ROS = Ros(ROS2)


def laser_scan(stamp_ns, ranges, *, order="<", declared=None, **told):
    ranges = np.asarray(ranges, np.float32)
    data = bytearray(ROS.serialize(ROS.laser_scan(stamp_ns, ranges, **told), "sensor_msgs/msg/LaserScan", order))
    if declared is not None:  # another number of ranges than there are
        struct.pack_into(f"{order}I", data, len(data) - 4 * len(ranges) - 8, declared)
    return bytes(data)


def point_cloud(stamp_ns, rows, *, order="<", **told):
    return ROS.serialize(ROS.point_cloud(stamp_ns, rows, **told), "sensor_msgs/msg/PointCloud2", order)


def odometry(*words, order="<", **told):
    return ROS.serialize(ROS.odometry(*words, **told), "nav_msgs/msg/Odometry", order)


def transforms(*entries, order="<", stamp_ns=0):
    return ROS.serialize(ROS.transforms(*entries, stamp_ns=stamp_ns), "tf2_msgs/msg/TFMessage", order)


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
    encoding="", rename=str, message_encoding="", announced=(), ros=ROS, **options,
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
                language, definition = encoding or ros.language, ros.definition(said.kind)
                schema = writer.register_schema(rename(said.kind), language, definition)
                form = message_encoding or ros.encoding
                channels[said.topic] = writer.register_channel(said.topic, form, schema)
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
