"""Which topic of a log is the lidar, which the wheels."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.errors import InputError
from pipeline.logs.index import Channel, FileIndex

LASER_SCAN, POINT_CLOUD = "sensor_msgs/LaserScan", "sensor_msgs/PointCloud2"
ODOMETRY, TRANSFORMS = "nav_msgs/Odometry", "tf2_msgs/TFMessage"


def kind(channel: Channel) -> str:
    """The message type as package/Type, whatever form the schema's name has."""
    return channel.type_name.replace("/msg/", "/").replace("::msg::dds_::", "/").rstrip("_")


def readable(channel: Channel) -> bool:
    """Whether its messages are ROS 2's, in CDR."""
    return channel.encoding == "cdr" and channel.schema_encoding in ("ros2msg", "ros2idl")


def topics_of(indexes: Sequence[FileIndex]) -> dict[str, Channel]:
    """One channel of each topic, in the order of the files."""
    channels: dict[str, Channel] = {}
    for index in indexes:
        for channel in index.channels.values():
            channels.setdefault(channel.topic, channel)
    return channels


def find_lidar(indexes: Sequence[FileIndex], wanted: str) -> Channel:
    """The lidar's channel: the topic asked for, else the only one that fits."""
    channels = topics_of(indexes)
    path = indexes[0].path
    listed = ", ".join(f"{topic} ({channel.type_name or 'no schema'})" for topic, channel in sorted(channels.items()))
    lidars = [c for c in channels.values() if kind(c) in (LASER_SCAN, POINT_CLOUD) and readable(c)]
    if wanted:
        if wanted not in channels:
            raise InputError(f"{path}: has no topic {wanted}; choose --topic from: {listed or 'none at all'}")
        if channels[wanted] not in lidars:
            raise InputError(
                f"{path}: topic {wanted} is {channels[wanted].type_name} in {channels[wanted].encoding}, not a "
                f"{LASER_SCAN} or {POINT_CLOUD} of ROS 2; the log holds: {listed}"
            )
        return channels[wanted]
    if not lidars:
        raise InputError(
            f"{path}: has no lidar topic ({LASER_SCAN} or {POINT_CLOUD} of ROS 2); it holds: {listed or 'no topics'}"
        )
    if len(lidars) > 1:
        raise InputError(
            f"{path}: several lidar topics; choose one with --topic: "
            + ", ".join(f"{c.topic} ({c.type_name})" for c in sorted(lidars, key=lambda c: c.topic))
        )
    return lidars[0]


def find_odometry(
    indexes: Sequence[FileIndex], wanted: str, ground_truth: str, notes: list[str]
) -> Channel | None:
    """The wheel odometry's channel: the topic asked for, else the only one apart from the ground truth."""
    channels = topics_of(indexes)
    if wanted:
        if wanted not in channels or kind(channels[wanted]) != ODOMETRY:
            raise InputError(f"{indexes[0].path}: log.odometry_topic {wanted} is no {ODOMETRY} topic of the log")
        return channels[wanted]
    found = [c for c in channels.values() if kind(c) == ODOMETRY and readable(c) and c.topic != ground_truth]
    if len(found) > 1:
        names = ", ".join(sorted(channel.topic for channel in found))
        notes.append(f"several odometry topics ({names}), none is used; choose with --log.odometry_topic")
        return None
    return found[0] if found else None
