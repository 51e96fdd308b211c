"""The table of message types, from which every channel gets the reader of its messages."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from functools import partial
from typing import Any, NamedTuple

from scanchain.logs.mcap.records import Channel
from scanchain.logs.messages import foxglove
from scanchain.logs.messages.laser_scan import read_laser_scan, read_multi_echo_scan
from scanchain.logs.messages.point_cloud import read_livox, read_point_cloud
from scanchain.logs.messages.poses import StampedPose, read_odometry, read_pose, read_transforms
from scanchain.logs.messages.ros import unpacked

Read = Callable[..., Any]
_ROS = ("cdr", "ros1")
_SCHEMA_LANGUAGES = {
    "cdr": ("ros2msg", "ros2idl"),
    "ros1": ("ros1msg",),
    "json": ("jsonschema", ""),
    "protobuf": ("protobuf",),
}


class Role(StrEnum):
    """Use of a message type."""

    SCAN = "scan"
    CLOUD = "cloud"
    ODOMETRY = "odometry"
    POSE = "pose"
    TRANSFORMS = "transforms"


class _Type(NamedTuple):
    """A message type: its reader takes what the message is parsed to, of Foxglove's types like ``json_type``."""

    role: Role
    read: Read
    json_type: type | None = None  # of ROS where None: laid out alike in ROS 1 and 2


_TYPES = {
    "sensor_msgs/LaserScan": _Type(Role.SCAN, read_laser_scan),
    "sensor_msgs/MultiEchoLaserScan": _Type(Role.SCAN, read_multi_echo_scan),
    "foxglove.LaserScan": _Type(Role.SCAN, *foxglove.LASER_SCAN),
    "sensor_msgs/PointCloud2": _Type(Role.CLOUD, read_point_cloud),
    "livox_ros_driver2/CustomMsg": _Type(Role.CLOUD, read_livox),
    "livox_ros_driver/CustomMsg": _Type(Role.CLOUD, read_livox),
    "livox_interfaces/CustomMsg": _Type(Role.CLOUD, read_livox),
    "foxglove.PointCloud": _Type(Role.CLOUD, *foxglove.POINT_CLOUD),
    "nav_msgs/Odometry": _Type(Role.ODOMETRY, read_odometry),
    "geometry_msgs/PoseStamped": _Type(Role.POSE, read_pose),
    "geometry_msgs/PoseWithCovarianceStamped": _Type(Role.POSE, read_pose),
    "foxglove.PoseInFrame": _Type(Role.POSE, *foxglove.POSE_IN_FRAME),
    "tf2_msgs/TFMessage": _Type(Role.TRANSFORMS, read_transforms),
    "tf/tfMessage": _Type(Role.TRANSFORMS, read_transforms),
    "foxglove.FrameTransform": _Type(Role.TRANSFORMS, *foxglove.FRAME_TRANSFORM),
    "foxglove.FrameTransforms": _Type(Role.TRANSFORMS, *foxglove.FRAME_TRANSFORMS),
}
LIDAR_TYPES = tuple(sorted(name for name, each in _TYPES.items() if each.role in (Role.SCAN, Role.CLOUD)))


def kind(channel: Channel) -> str:
    """Message type as package/Type, whatever form the schema's name has."""
    return channel.type_name.replace("/msg/", "/").replace("::msg::dds_::", "/").rstrip("_")


def role(channel: Channel) -> Role | None:
    """Use of the channel's messages; None for a type or an encoding that is not supported."""
    known = _TYPES.get(kind(channel))
    if known is None or channel.schema_encoding not in _SCHEMA_LANGUAGES.get(channel.encoding, ()):
        return None
    return known.role if (channel.encoding in _ROS) == (known.json_type is None) else None


def is_scan(channel: Channel) -> bool:
    """True if its messages are planar laser scans of a supported type."""
    return role(channel) == Role.SCAN


def is_lidar(channel: Channel) -> bool:
    """True if its messages are scans or clouds of a supported type."""
    return role(channel) in (Role.SCAN, Role.CLOUD)


def is_odometry(channel: Channel) -> bool:
    """True if its messages are nav_msgs/Odometry."""
    return role(channel) == Role.ODOMETRY


def has_poses(channel: Channel) -> bool:
    """True if its messages are stamped poses of any supported type."""
    return role(channel) in (Role.POSE, Role.ODOMETRY)


def has_transforms(channel: Channel) -> bool:
    """True if its messages are transforms between frames."""
    return role(channel) == Role.TRANSFORMS


def reader(channel: Channel) -> Read:
    """Reader of the messages of a channel that has a role; that of poses takes their ``dimension``, too."""
    name, encoding = kind(channel), channel.encoding
    _, read, json_type = _TYPES[name]
    if read is read_livox:
        return partial(read_livox, encoding=encoding)
    if json_type is None:
        package, _, type_name = name.partition("/")
        ros_name = "tf2_msgs/msg/TFMessage" if package == "tf" else f"{package}/msg/{type_name}"
        parse = partial(unpacked, type_name=ros_name, encoding=encoding)
    elif encoding == "json":
        parse = partial(foxglove.parse_json, kind=json_type)
    else:
        parse = foxglove.protobuf_parser(channel)
    return lambda data, **options: read(parse(data), **options)


def pose_reader(channel: Channel, dimension: int) -> Callable[[memoryview], StampedPose]:
    """Reader of the channel's poses, flattened for dimension 2."""
    return partial(reader(channel), dimension=dimension)
