"""Foxglove's own messages, LaserScan, PointCloud, PoseInFrame and FrameTransforms, told in JSON or Protobuf.

Schemas: https://docs.foxglove.dev/docs/sdk/schemas
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from scanchain.data import Pose
from scanchain.logs.messages.cdr import MalformedMessageError
from scanchain.logs.messages.laser_scan import LaserScanMessage
from scanchain.logs.messages.point_cloud import PointCloudMessage, PointField
from scanchain.logs.messages.poses import StampedPose, pose_matrix

_POINT_FIELD = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}  # foxglove.NumericType to sensor_msgs/PointField


class _Stamp(Protocol):
    seconds: int
    nanos: int


class _Vector(Protocol):
    x: float
    y: float
    z: float


class _Quaternion(_Vector, Protocol):
    w: float


class _Pose(Protocol):
    position: _Vector
    orientation: _Quaternion


class _Posed(Protocol):
    timestamp: _Stamp
    frame_id: str
    pose: _Pose


class ToldScan(_Posed, Protocol):
    """A foxglove.LaserScan."""

    start_angle: float
    end_angle: float
    ranges: Sequence[float]


class _Field(Protocol):
    name: str
    offset: int
    type: int


class ToldCloud(_Posed, Protocol):
    """A foxglove.PointCloud."""

    point_stride: int
    fields: Sequence[_Field]
    data: bytes


class ToldTransform(Protocol):
    """A foxglove.FrameTransform."""

    timestamp: _Stamp
    parent_frame_id: str
    child_frame_id: str
    translation: _Vector
    rotation: _Quaternion


class ToldTransforms(Protocol):
    """A foxglove.FrameTransforms."""

    transforms: Sequence[ToldTransform]


def laser_scan(told: ToldScan) -> LaserScanMessage:
    """The scan, without range limits and times, which Foxglove does not tell."""
    with np.errstate(over="ignore"):
        ranges_m = np.array(told.ranges, np.float64).astype(np.float32)
    step_rad = (told.end_angle - told.start_angle) / max(len(ranges_m) - 1, 1)
    return LaserScanMessage(
        stamp_ns=_stamp_ns(told.timestamp),
        frame=told.frame_id,
        first_rad=told.start_angle,
        last_rad=told.end_angle,
        step_rad=step_rad,
        beam_s=0.0,
        scan_s=0.0,
        range_min_m=0.0,
        range_max_m=0.0,
        ranges_m=ranges_m,
        T_frame_scan=_unless_identity(told.pose),
    )


def point_cloud(told: ToldCloud) -> PointCloudMessage:
    """The cloud, its number types in the codes of sensor_msgs/PointField; little endian."""
    if not told.point_stride:
        raise MalformedMessageError("point_stride is zero")
    count = len(told.data) // told.point_stride
    fields = [PointField(field.name, field.offset, _POINT_FIELD.get(field.type, 0), 1) for field in told.fields]
    return PointCloudMessage(
        stamp_ns=_stamp_ns(told.timestamp),
        frame=told.frame_id,
        height=1,
        width=count,
        fields=fields,
        is_bigendian=False,
        point_step=told.point_stride,
        row_step=count * told.point_stride,
        data=memoryview(told.data),
        described=repr((told.point_stride, fields)).encode(),
        T_frame_cloud=_unless_identity(told.pose),
    )


def pose_in_frame(told: _Posed, dimension: int) -> StampedPose:
    """A foxglove.PoseInFrame, flattened for dimension 2."""
    pose = _pose(told.pose.position, told.pose.orientation, dimension)
    return StampedPose(_stamp_ns(told.timestamp), told.frame_id, "", pose)


def frame_transform(told: ToldTransform) -> list[StampedPose]:
    """A foxglove.FrameTransform."""
    pose = _pose(told.translation, told.rotation, 3)
    return [StampedPose(_stamp_ns(told.timestamp), told.parent_frame_id, told.child_frame_id, pose)]


def frame_transforms(told: ToldTransforms) -> list[StampedPose]:
    """All transforms of a foxglove.FrameTransforms."""
    return [transform for each in told.transforms for transform in frame_transform(each)]


def _stamp_ns(stamp: _Stamp) -> int:
    return stamp.seconds * 1_000_000_000 + stamp.nanos


def _unless_identity(pose: _Pose) -> Pose | None:
    T = _pose(pose.position, pose.orientation, 3)
    return None if np.array_equal(T, np.eye(4)) else T


def _pose(position: _Vector, orientation: _Quaternion, dimension: int) -> Pose:
    """A pose; a quaternion that was left out, zero, turns nothing."""
    quaternion = (orientation.x, orientation.y, orientation.z, orientation.w)
    quaternion = quaternion if any(quaternion) else (0.0, 0.0, 0.0, 1.0)
    return pose_matrix((position.x, position.y, position.z, *quaternion), dimension)
