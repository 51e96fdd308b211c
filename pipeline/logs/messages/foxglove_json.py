"""Foxglove's messages in JSON; fields are named as Protobuf names them, so that both read alike."""

from __future__ import annotations

import json
from typing import TypeVar

import msgspec
from msgspec import Struct, field

from scanchain.logs.messages.cdr import MalformedMessageError

T = TypeVar("T")


class Stamp(Struct, frozen=True):
    """Seconds and nanoseconds since the epoch."""

    seconds: int = field(name="sec", default=0)
    nanos: int = field(name="nsec", default=0)


class Vector(Struct, frozen=True):
    """Meters."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Quaternion(Struct, frozen=True):
    """All zero where it was left out."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 0.0


class Pose(Struct, frozen=True):
    """Position and orientation."""

    position: Vector = Vector()
    orientation: Quaternion = Quaternion()


class LaserScan(Struct, frozen=True):
    """A foxglove.LaserScan; a range that is null is no number."""

    ranges: list[float | None]
    start_angle: float
    end_angle: float
    timestamp: Stamp = Stamp()
    frame_id: str = ""
    pose: Pose = Pose()


class PackedField(Struct, frozen=True):
    """A foxglove.PackedElementField."""

    name: str
    offset: int
    type: int


class PointCloud(Struct, frozen=True):
    """A foxglove.PointCloud; ``data`` comes in base64."""

    point_stride: int
    fields: list[PackedField]
    data: bytes
    timestamp: Stamp = Stamp()
    frame_id: str = ""
    pose: Pose = Pose()


class PoseInFrame(Struct, frozen=True):
    """A foxglove.PoseInFrame."""

    pose: Pose
    timestamp: Stamp = Stamp()
    frame_id: str = ""


class FrameTransform(Struct, frozen=True):
    """A foxglove.FrameTransform."""

    parent_frame_id: str
    child_frame_id: str
    translation: Vector = Vector()
    rotation: Quaternion = Quaternion()
    timestamp: Stamp = Stamp()


class FrameTransforms(Struct, frozen=True):
    """A foxglove.FrameTransforms."""

    transforms: list[FrameTransform]


def parse(data: memoryview, kind: type[T]) -> T:
    """One message. NaN and Infinity, which are no JSON but which Python and others write, are taken."""
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.ValidationError as error:
        raise MalformedMessageError(f"it does not fit its type: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError):
        pass
    try:
        return msgspec.convert(json.loads(bytes(data)), kind)
    except (ValueError, RecursionError) as error:
        raise MalformedMessageError(f"it is no JSON of its type: {error}") from error
