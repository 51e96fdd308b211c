"""Foxglove's messages LaserScan, PointCloud, PoseInFrame, FrameTransforms, LocationFix, in JSON or Protobuf.

Schemas: https://docs.foxglove.dev/docs/sdk/schemas. The records are those of JSON; messages parsed by Protobuf
have the same attributes.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct, field

from scanchain.data import Pose
from scanchain.logs.index import Channel
from scanchain.logs.messages.gnss import Fix, fix_of
from scanchain.logs.messages.lidar import Sensed
from scanchain.logs.messages.poses import Frames, StampedPose, pose_of
from scanchain.logs.messages.ros import MalformedMessageError, frame_name, header, new, point_fields

_NUMBERS = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}  # foxglove.NumericType to sensor_msgs/PointField


class _Stamp(Struct, frozen=True):
    seconds: int = field(name="sec", default=0)
    nanos: int = field(name="nsec", default=0)
    nanosec: int = 0  # as in ROS 2

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "nanos", self.nanos or self.nanosec)


class _Vector(Struct, frozen=True):
    """Meters, or with w a quaternion; zero if it is missing."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 0.0


class _Pose(Struct, frozen=True):
    position: _Vector = _Vector()
    orientation: _Vector = _Vector()


class _Header(Struct, frozen=True, kw_only=True):
    timestamp: _Stamp = _Stamp()
    frame_id: str = ""


class _LaserScan(_Header, frozen=True):
    """A foxglove.LaserScan; a range of null is NaN."""

    ranges: list[float | None]
    start_angle: float
    end_angle: float
    pose: _Pose = _Pose()


class _PackedField(Struct, frozen=True):
    name: str
    offset: int
    type: int


class _PointCloud(_Header, frozen=True):
    """A foxglove.PointCloud; ``data`` is base64."""

    point_stride: int
    fields: list[_PackedField]
    data: bytes
    pose: _Pose = _Pose()


class _PoseInFrame(_Header, frozen=True):
    pose: _Pose


class _FrameTransform(Struct, frozen=True):
    parent_frame_id: str
    child_frame_id: str
    translation: _Vector = _Vector()
    rotation: _Vector = _Vector()
    timestamp: _Stamp = _Stamp()


class _FrameTransforms(Struct, frozen=True):
    transforms: list[_FrameTransform]


class _LocationFix(_Header, frozen=True):
    latitude: float
    longitude: float
    altitude: float = 0.0
    position_covariance: list[float] = []
    position_covariance_type: int = 0


def laser_scan(message: _LaserScan) -> Sensed:
    """The message as a sensor_msgs/LaserScan, without range limits and times, which Foxglove lacks."""
    with np.errstate(over="ignore", invalid="ignore"):
        ranges_m = np.array(message.ranges, np.float64).astype(np.float32)
    step_rad = (message.end_angle - message.start_angle) / max(len(ranges_m) - 1, 1)
    angles_rad = message.start_angle, message.end_angle, step_rad
    unknown = (0.0,) * 4
    return _sensed(message, "sensor_msgs/msg/LaserScan", *angles_rad, *unknown, ranges_m, ranges_m[:0])


def point_cloud(message: _PointCloud) -> Sensed:
    """The message as a sensor_msgs/PointCloud2, little endian."""
    stride = message.point_stride
    if not stride:
        raise MalformedMessageError("point_stride is zero")
    count = len(message.data) // stride
    fields = point_fields(*((each.name, each.offset, _NUMBERS.get(each.type, 0)) for each in message.fields))
    rows = 1, count, fields, False, stride, count * stride, message.data, True
    return _sensed(message, "sensor_msgs/msg/PointCloud2", *rows)


def _sensed(message: _LaserScan | _PointCloud, type_name: str, *parts: Any) -> Sensed:
    """A message of sensor_msgs with these fields after its header."""
    T = _pose(message.pose.position, message.pose.orientation, 3)
    head = header(_stamp_ns(message.timestamp), message.frame_id)
    return Sensed(new(type_name, head, *parts), None if np.array_equal(T, np.eye(4)) else T)


def pose_in_frame(message: _PoseInFrame, dimension: int) -> StampedPose:
    """A foxglove.PoseInFrame, flattened for dimension 2."""
    pose = _pose(message.pose.position, message.pose.orientation, dimension)
    return StampedPose(_stamp_ns(message.timestamp), frame_name(message.frame_id), "", pose)


def frame_transform(message: _FrameTransform, link: Frames | None = None, dimension: int = 3) -> list[StampedPose]:
    """A foxglove.FrameTransform, flattened for dimension 2; none if it is not between the frames of ``link``.

    Raises MalformedMessageError for one of the link that is no pose; another that is none is NaN.
    """
    frames = frame_name(message.parent_frame_id), frame_name(message.child_frame_id)
    if link not in (None, frames):
        return []
    T = np.full((dimension + 1, dimension + 1), np.nan)
    with suppress(*() if link else (MalformedMessageError,)):
        T = _pose(message.translation, message.rotation, dimension)
    return [StampedPose(_stamp_ns(message.timestamp), *frames, T)]


def frame_transforms(message: _FrameTransforms, **chosen: Any) -> list[StampedPose]:
    """Transforms of a foxglove.FrameTransforms, as those of single ones."""
    return [found for each in message.transforms for found in frame_transform(each, **chosen)]


def location_fix(message: _LocationFix) -> Fix:
    """A foxglove.LocationFix."""
    return fix_of(message, _stamp_ns(message.timestamp), frame_name(message.frame_id))


def _stamp_ns(stamp: _Stamp) -> int:
    return stamp.seconds * 1_000_000_000 + stamp.nanos


def _pose(position: _Vector, orientation: _Vector, dimension: int) -> Pose:
    """A pose; a missing quaternion, which is zero, counts as the identity."""
    is_given = any((orientation.x, orientation.y, orientation.z, orientation.w))
    return pose_of(position, orientation if is_given else _Vector(w=1.0), dimension)


def parse_json(data: memoryview, record: type[Struct]) -> Any:
    """A record of this type; NaN and Infinity, which Python writes although JSON has none, are accepted."""
    try:
        return msgspec.json.decode(data, type=record)
    except msgspec.ValidationError as error:
        raise MalformedMessageError(f"it does not match its type: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError):
        pass
    try:
        return msgspec.convert(json.loads(bytes(data)), record)
    except (ValueError, RecursionError) as error:
        raise MalformedMessageError(f"it is not JSON of its type: {error}") from error


def protobuf_parser(channel: Channel) -> Callable[[memoryview], Any]:
    """Parser of a channel's messages; without a usable schema it raises at every message."""
    from google.protobuf.message import DecodeError
    from mcap.exceptions import McapError
    from mcap.records import Schema
    from mcap_protobuf.decoder import DecoderFactory

    schema = Schema(data=channel.definition, encoding="protobuf", id=1, name=channel.type_name)
    decode, broken = None, ""
    try:
        decode = DecoderFactory().decoder_for("protobuf", schema)
    except (McapError, DecodeError, TypeError, KeyError, RecursionError) as error:
        broken = f"its schema {channel.type_name} is broken: {' '.join(str(error).split())}"

    def parse(data: memoryview) -> Any:
        if decode is None:
            raise MalformedMessageError(broken)
        try:
            return decode(bytes(data))
        except DecodeError as error:
            raise MalformedMessageError(f"it is not Protobuf of its schema: {error}") from error

    return parse
