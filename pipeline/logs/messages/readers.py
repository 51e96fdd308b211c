"""The registries of encodings and message types, from which every channel gets the reader of its messages."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from scanchain.logs.mcap.records import Channel
from scanchain.logs.messages import foxglove
from scanchain.logs.messages.cdr import CdrReader, Ros1Reader
from scanchain.logs.messages.laser_scan import LaserScanMessage, read_laser_scan, read_multi_echo_scan
from scanchain.logs.messages.point_cloud import PointCloudMessage, read_livox, read_point_cloud
from scanchain.logs.messages.poses import StampedPose, decode_odometry, decode_pose, decode_transforms

Read = Callable[..., Any]
_Bind = Callable[[Channel], Read]  # the reader of one channel


class Kind(NamedTuple):
    """A message type as it is found in logs: (encoding, package/Type)."""

    encoding: str
    type_name: str


def kind(channel: Channel) -> str:
    """Message type as package/Type, whatever form the schema's name has."""
    return channel.type_name.replace("/msg/", "/").replace("::msg::dds_::", "/").rstrip("_")


def is_scan(channel: Channel) -> bool:
    """True if its messages are planar laser scans of a supported type."""
    return _kind(channel) in _SCANS


def is_cloud(channel: Channel) -> bool:
    """True if its messages are clouds of a supported type."""
    return _kind(channel) in _CLOUDS


def is_odometry(channel: Channel) -> bool:
    """True if its messages are nav_msgs/Odometry."""
    return _kind(channel) in _ODOMETRY


def has_poses(channel: Channel) -> bool:
    """True if its messages are stamped poses of any supported type."""
    return _kind(channel) in _POSES | _ODOMETRY


def has_transforms(channel: Channel) -> bool:
    """True if its messages are transforms between frames."""
    return _kind(channel) in _TRANSFORMS


def scan_reader(channel: Channel) -> Callable[[memoryview], LaserScanMessage]:
    """Reader of the channel's laser scans."""
    return _SCANS[_kind(channel)](channel)


def cloud_reader(channel: Channel) -> Callable[[memoryview], PointCloudMessage]:
    """Reader of the channel's clouds."""
    return _CLOUDS[_kind(channel)](channel)


def pose_reader(channel: Channel, dimension: int) -> Callable[[memoryview], StampedPose]:
    """Reader of the channel's poses, flattened for dimension 2."""
    read = (_POSES | _ODOMETRY)[_kind(channel)](channel)
    return partial(read, dimension=dimension)


def transforms_reader(channel: Channel) -> Callable[[memoryview], list[StampedPose]]:
    """Reader of the channel's transforms."""
    return _TRANSFORMS[_kind(channel)](channel)


def _kind(channel: Channel) -> Kind:
    """The registry's key; an encoding whose schema is in another language is none of ours."""
    is_ours = channel.schema_encoding in _SCHEMA_LANGUAGES.get(channel.encoding, ())
    return Kind(channel.encoding if is_ours else "", kind(channel))


_SCHEMA_LANGUAGES = {
    "cdr": ("ros2msg", "ros2idl"),
    "ros1": ("ros1msg",),
    "json": ("jsonschema", ""),
    "protobuf": ("protobuf",),
}


def _ros(type_names: tuple[str, ...], read: Read) -> dict[Kind, _Bind]:
    """A type that ROS 1 and ROS 2 lay out alike, each in its own serialization."""

    def binding(form: type[CdrReader]) -> _Bind:
        return lambda _: partial(read, form=form)

    forms = {"cdr": CdrReader, "ros1": Ros1Reader}
    return {Kind(encoding, name): binding(form) for name in type_names for encoding, form in forms.items()}


def _foxglove(type_name: str, json_type: type, take: Read) -> dict[Kind, _Bind]:
    """A type of Foxglove's, in JSON and in Protobuf."""

    def taking(parse: Read) -> Read:
        return lambda data, **options: take(parse(data), **options)

    return {
        Kind("json", type_name): lambda _: taking(partial(foxglove.parse_json, kind=json_type)),
        Kind("protobuf", type_name): lambda channel: taking(foxglove.protobuf_parser(channel)),
    }


_SCANS: dict[Kind, _Bind] = {
    **_ros(("sensor_msgs/LaserScan",), read_laser_scan),
    **_ros(("sensor_msgs/MultiEchoLaserScan",), read_multi_echo_scan),
    **_foxglove("foxglove.LaserScan", foxglove.JsonLaserScan, foxglove.laser_scan),
}
_CLOUDS: dict[Kind, _Bind] = {
    **_ros(("sensor_msgs/PointCloud2",), read_point_cloud),
    **_ros(
        tuple(f"{p}/CustomMsg" for p in ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces")), read_livox
    ),
    **_foxglove("foxglove.PointCloud", foxglove.JsonPointCloud, foxglove.point_cloud),
}
_ODOMETRY: dict[Kind, _Bind] = _ros(("nav_msgs/Odometry",), decode_odometry)
_POSES: dict[Kind, _Bind] = {
    **_ros(("geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped"), decode_pose),
    **_foxglove("foxglove.PoseInFrame", foxglove.JsonPoseInFrame, foxglove.pose_in_frame),
}
_TRANSFORMS: dict[Kind, _Bind] = {
    **_ros(("tf2_msgs/TFMessage", "tf/tfMessage"), decode_transforms),
    **_foxglove("foxglove.FrameTransform", foxglove.JsonFrameTransform, foxglove.frame_transform),
    **_foxglove("foxglove.FrameTransforms", foxglove.JsonFrameTransforms, foxglove.frame_transforms),
}
LIDAR_TYPES = tuple(sorted({kind.type_name for kind in (*_SCANS, *_CLOUDS)}))
