"""The table of message types: the role of a channel, and the reader of its messages."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_type_hints

from scanchain.logs.index import Channel
from scanchain.logs.messages import foxglove
from scanchain.logs.messages.gnss import read_fix
from scanchain.logs.messages.inertial import read_imu
from scanchain.logs.messages.lidar import Sensed, read_livox, read_multi_echo_scan
from scanchain.logs.messages.poses import Frames, read_pose, read_transforms
from scanchain.logs.messages.ros import unpacked

Read = Callable[..., Any]
_ROS, _FOXGLOVE = ("cdr", "ros1"), ("json", "protobuf")  # encodings


Role = Literal["scan", "cloud", "odometry", "pose", "transforms", "imu", "gnss"]  # use of a message type
_TYPES: dict[str, tuple[Role, Read]] = {  # ROS 1 and 2 have the same fields
    "sensor_msgs/LaserScan": ("scan", Sensed),
    "sensor_msgs/MultiEchoLaserScan": ("scan", read_multi_echo_scan),
    "foxglove.LaserScan": ("scan", foxglove.laser_scan),
    "sensor_msgs/PointCloud2": ("cloud", Sensed),
    "livox_ros_driver2/CustomMsg": ("cloud", read_livox),
    "livox_ros_driver/CustomMsg": ("cloud", read_livox),
    "livox_interfaces/CustomMsg": ("cloud", read_livox),
    "foxglove.PointCloud": ("cloud", foxglove.point_cloud),
    "nav_msgs/Odometry": ("odometry", read_pose),
    "geometry_msgs/PoseStamped": ("pose", read_pose),
    "geometry_msgs/PoseWithCovarianceStamped": ("pose", read_pose),
    "foxglove.PoseInFrame": ("pose", foxglove.pose_in_frame),
    "sensor_msgs/Imu": ("imu", read_imu),
    "sensor_msgs/NavSatFix": ("gnss", read_fix),
    "gps_msgs/GPSFix": ("gnss", read_fix),
    "gps_common/GPSFix": ("gnss", read_fix),
    "foxglove.LocationFix": ("gnss", foxglove.location_fix),
    "tf2_msgs/TFMessage": ("transforms", read_transforms),
    "tf/tfMessage": ("transforms", read_transforms),
    "foxglove.FrameTransform": ("transforms", foxglove.frame_transform),
    "foxglove.FrameTransforms": ("transforms", foxglove.frame_transforms),
}
LIDAR_TYPES = ", ".join(sorted(name for name, (role, _) in _TYPES.items() if role in ("scan", "cloud")))


def kind(channel: Channel) -> str:
    """Message type as package/Type, for any form of the schema's name."""
    return channel.type_name.replace("/msg/", "/").replace("::msg::dds_::", "/").rstrip("_")


def role(channel: Channel) -> Role | None:
    """Role of the channel's messages; None for an unsupported type or encoding."""
    name = kind(channel)
    encodings = _FOXGLOVE if name.startswith("foxglove.") else _ROS
    return _TYPES[name][0] if name in _TYPES and channel.encoding in encodings else None


def is_scan(channel: Channel) -> bool:
    """True if its messages are planar laser scans of a supported type."""
    return role(channel) == "scan"


def is_lidar(channel: Channel) -> bool:
    """True if its messages are scans or clouds of a supported type."""
    return role(channel) in ("scan", "cloud")


def has_poses(channel: Channel) -> bool:
    """True if its messages are stamped poses of any supported type."""
    return role(channel) in ("pose", "odometry")


def reader(channel: Channel) -> Read:
    """Reader of the messages of a channel that has a role; readers of poses accept ``dimension``."""
    name, encoding = kind(channel), channel.encoding
    _, read = _TYPES[name]
    if read is read_livox:
        return partial(read_livox, encoding=encoding)
    if encoding in _ROS:
        package, _, type_name = name.partition("/")
        ros_name = "tf2_msgs/msg/TFMessage" if package == "tf" else f"{package}/msg/{type_name}"
        parse = partial(unpacked, type_name=ros_name, encoding=encoding)
    elif encoding == "json":
        parse = partial(foxglove.parse_json, record=get_type_hints(read)["message"])
    else:
        parse = foxglove.protobuf_parser(channel)
    return lambda data, **options: read(parse(data), **options)


def pose_reader(channel: Channel, dimension: int, link: Frames | None = None) -> Read:
    """Reader of the channel's poses, flattened for dimension 2; of transforms, a list of those of the link."""
    chosen = {} if link is None else {"link": link}
    return partial(reader(channel), dimension=dimension, **chosen)


def is_moving_transforms(channel: Channel) -> bool:
    """True if its messages are transforms that may change."""
    return role(channel) == "transforms" and not channel.topic.endswith("tf_static")
