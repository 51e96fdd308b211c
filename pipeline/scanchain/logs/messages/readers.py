"""The table of message types, from which every channel gets the reader of its messages."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from functools import partial
from typing import Any, NamedTuple

from scanchain.logs.mcap.records import Channel
from scanchain.logs.messages import foxglove
from scanchain.logs.messages.cdr import CdrReader, Ros1Reader
from scanchain.logs.messages.laser_scan import read_laser_scan, read_multi_echo_scan
from scanchain.logs.messages.point_cloud import read_livox, read_point_cloud
from scanchain.logs.messages.poses import StampedPose, decode_odometry, decode_pose, decode_transforms

Read = Callable[..., Any]
_FORMS: dict[str, type[CdrReader]] = {"cdr": CdrReader, "ros1": Ros1Reader}
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
    """A message type: its reader, which of Foxglove's types takes the record that ``json_type`` describes."""

    role: Role
    read: Read
    json_type: type | None = None  # of ROS where None: laid out alike in ROS 1 and 2


_TYPES = {
    "sensor_msgs/LaserScan": _Type(Role.SCAN, read_laser_scan),
    "sensor_msgs/MultiEchoLaserScan": _Type(Role.SCAN, read_multi_echo_scan),
    "foxglove.LaserScan": _Type(Role.SCAN, foxglove.laser_scan, foxglove.JsonLaserScan),
    "sensor_msgs/PointCloud2": _Type(Role.CLOUD, read_point_cloud),
    "livox_ros_driver2/CustomMsg": _Type(Role.CLOUD, read_livox),
    "livox_ros_driver/CustomMsg": _Type(Role.CLOUD, read_livox),
    "livox_interfaces/CustomMsg": _Type(Role.CLOUD, read_livox),
    "foxglove.PointCloud": _Type(Role.CLOUD, foxglove.point_cloud, foxglove.JsonPointCloud),
    "nav_msgs/Odometry": _Type(Role.ODOMETRY, decode_odometry),
    "geometry_msgs/PoseStamped": _Type(Role.POSE, decode_pose),
    "geometry_msgs/PoseWithCovarianceStamped": _Type(Role.POSE, decode_pose),
    "foxglove.PoseInFrame": _Type(Role.POSE, foxglove.pose_in_frame, foxglove.JsonPoseInFrame),
    "tf2_msgs/TFMessage": _Type(Role.TRANSFORMS, decode_transforms),
    "tf/tfMessage": _Type(Role.TRANSFORMS, decode_transforms),
    "foxglove.FrameTransform": _Type(Role.TRANSFORMS, foxglove.frame_transform, foxglove.JsonFrameTransform),
    "foxglove.FrameTransforms": _Type(Role.TRANSFORMS, foxglove.frame_transforms, foxglove.JsonFrameTransforms),
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
    return known.role if (channel.encoding in _FORMS) == (known.json_type is None) else None


def is_scan(channel: Channel) -> bool:
    """True if its messages are planar laser scans of a supported type."""
    return role(channel) == Role.SCAN


def is_cloud(channel: Channel) -> bool:
    """True if its messages are clouds of a supported type."""
    return role(channel) == Role.CLOUD


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
    _, read, json_type = _TYPES[kind(channel)]
    if json_type is None:
        return partial(read, form=_FORMS[channel.encoding])
    is_json = channel.encoding == "json"
    parse = partial(foxglove.parse_json, kind=json_type) if is_json else foxglove.protobuf_parser(channel)
    return lambda data, **options: read(parse(data), **options)


def pose_reader(channel: Channel, dimension: int) -> Callable[[memoryview], StampedPose]:
    """Reader of the channel's poses, flattened for dimension 2."""
    return partial(reader(channel), dimension=dimension)
