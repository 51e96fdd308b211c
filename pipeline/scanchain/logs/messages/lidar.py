"""Messages of lidars to their valid returns: planar laser scans, and clouds."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from functools import lru_cache
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.config import LogConfig
from scanchain.data import Points, Pose, RawPoints
from scanchain.errors import one_line
from scanchain.kernels.scans import keep_valid, raise_elevation
from scanchain.logs.messages.point_times import NO_TIMES, UNITS_S, Beams, PointTimes, Returns, from_azimuth
from scanchain.logs.messages.ros import (
    NUMBERS,
    MalformedMessageError,
    frame_of,
    header,
    new,
    point_fields,
    stamp_ns,
)

_NEAREST_M, _FARTHEST_M = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)  # of any range
_MOST_TURNS = 2.0  # largest number of turns that the beams of a scan cover; above it angles are in degrees
_MOST_APART = 0.02  # largest difference of angle_max and the last beam, as a share of the angle that is covered
_PLANAR_M = 5e-4  # largest distance of a point from the plane of a planar cloud: rounding of float32
_LIVOX_POINT_BYTES = 19  # offset_time, x, y, z, reflectivity, tag, line
_LIVOX_FIELDS = (("offset_time", 0, 6), ("x", 4, 7), ("y", 8, 7), ("z", 12, 7))


class Sensed(NamedTuple):
    """A sensor_msgs/LaserScan or PointCloud2; pose (4, 4) of its points in its frame, None for the identity."""

    message: Any
    T_frame_points: Pose | None = None


def read_multi_echo_scan(message: Any) -> Sensed:
    """A sensor_msgs/MultiEchoLaserScan as a scan of the first echo of each beam, inf if there is none."""
    firsts_m = [beam.echoes[0] if len(beam.echoes) else np.inf for beam in message.ranges]
    message.ranges = np.array(firsts_m, np.float32)
    return Sensed(message)


def decode_laser_scan(data: memoryview, read: Callable[[memoryview], Sensed], config: LogConfig) -> Returns:
    """Valid returns of a laser scan: finite, at least range_min, below range_max.

    Scanners report range_max or more for a beam without return, and zero for an invalid one; limits that are not
    positive count as unknown. Angle increments may be negative; one of zero is unset, and follows from angle_max.
    """
    message, T_frame_points = read(data)
    ranges_m = message.ranges
    low_m = max(message.range_min if message.range_min > 0.0 else 0.0, config.min_range_m, _NEAREST_M)
    high_m = min(message.range_max if message.range_max > 0.0 else _FARTHEST_M, config.max_range_m, _FARTHEST_M)
    covered_rad, steps = message.angle_max - message.angle_min, max(len(ranges_m) - 1, 1)
    step_rad = message.angle_increment or covered_rad / steps
    directions = _directions(message.angle_min, step_rad, len(ranges_m))
    valid = ((ranges_m >= low_m) & (ranges_m < high_m)).nonzero()[0]
    points = directions[valid] * ranges_m[valid, None]
    times_s, stated = NO_TIMES, None
    if config.point_times in UNITS_S or config.point_times == "auto":
        turns = abs(step_rad) * len(ranges_m) / (2.0 * np.pi)
        stated = Beams(valid, len(ranges_m), turns, message.time_increment, message.scan_time)
        times_s = stated.seconds(UNITS_S.get(config.point_times, 1.0) * message.time_increment)
    elif config.point_times not in ("none", "azimuth"):
        times_s = from_azimuth(points, config)
    points = moved(points, T_frame_points).astype(np.float32, copy=False)
    why = "" if len(valid) else _why_none(ranges_m, low_m, high_m)
    count = len(ranges_m) - len(valid)
    apart_rad, odd = abs(steps * message.angle_increment - covered_rad), ""
    if apart_rad > _MOST_APART * abs(covered_rad) + 3.0 * abs(message.angle_increment):
        last_rad = message.angle_min + steps * message.angle_increment
        used = "angle_increment" if message.angle_increment else "angle_max"
        both = f"{last_rad:.3f} rad by angle_increment, {message.angle_max:.3f} by angle_max"
        odd = f"its last beam is at {both}: {used} used"
    return Returns(stamp_ns(message), points, times_s, count, why, frame_of(message), stated, odd=odd)


@lru_cache(16)  # few scanners have more than one geometry
def _directions(first_rad: float, step_rad: float, count: int) -> NDArray[np.float32]:
    """Directions (N, 2) of the beams."""
    if not isfinite(first_rad + step_rad * count) or (step_rad == 0.0 and count > 1):
        raise MalformedMessageError(
            f"its beams begin at {first_rad:g} rad and are {step_rad:g} rad apart, which is impossible"
        )
    turns = abs(step_rad) * count / (2.0 * np.pi)
    if turns > _MOST_TURNS:
        raise MalformedMessageError(
            f"its {count} beams, {step_rad:g} rad apart, cover {turns:.3g} turns: degrees? wanted radians"
        )
    angles_rad = first_rad + step_rad * np.arange(count)
    return np.column_stack([np.cos(angles_rad), np.sin(angles_rad)]).astype(np.float32)


def read_livox(data: memoryview, encoding: str) -> Sensed:
    """A Livox driver's CustomMsg as a cloud that is a view of it, one point per row as CDR aligns points."""
    is_ros1 = encoding == "ros1"
    order = "<" if is_ros1 or data[1:2] == b"\1" else ">"
    try:
        seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
        frame = str(data[16 : 16 + length], "utf-8", "replace").rstrip("\0")
        begin = 16 + length  # followed by the time of the first point by the lidar's clock, aligned to 8 bytes
        begin += 0 if is_ros1 else (4 - begin) % 8
        (count,) = struct.unpack_from(f"{order}I", data, begin + 16)
    except struct.error as error:
        raise MalformedMessageError(one_line(error)) from error
    stride = _LIVOX_POINT_BYTES if is_ros1 else _LIVOX_POINT_BYTES + 1
    if (count - 1) * stride + _LIVOX_POINT_BYTES > len(data) - begin - 20:
        raise MalformedMessageError(f"it has {len(data)} bytes, too few for {count} points of {stride} bytes")
    rows = count, 1, point_fields(*_LIVOX_FIELDS), order == ">", _LIVOX_POINT_BYTES, stride
    head = header(seconds * 1_000_000_000 + nanoseconds, frame)
    return Sensed(new("sensor_msgs/msg/PointCloud2", head, *rows, data[begin + 20 :], True))


def decode_cloud(
    data: memoryview, read: Callable[[memoryview], Sensed], times: PointTimes, plane_m: float | None = None
) -> Returns:
    """Valid returns of a cloud, with their times: finite, not the origin, within the limits.

    Rows may be padded, bytes in either order, x y z of any number type; other fields are ignored.

    plane_m : height of the plane of a planar scanner, whose points are (N, 2)
    Raises MalformedMessageError, also if a point is outside of that plane.
    """
    message, T_frame_points = read(data)
    point = _layout(message, times)
    cloud = _rows(message, point)
    points = np.empty((len(cloud), 3), np.float32)
    valid = np.empty(len(cloud), np.int32)
    x, y, z = (_as_float32(cloud[name]) for name in "xyz")
    low_m, high_m = times.config.min_range_m, times.config.max_range_m
    high_square = min(high_m * high_m, _FARTHEST_M)
    count = keep_valid(x, y, z, low_m**2, high_square, points, valid)
    times_s, stated = NO_TIMES, None
    for name in (point.names or ())[3:] if count else ():
        values = cloud[name] if count == len(cloud) else cloud[name][valid[:count]]
        stated = times.from_field(name, stamp_ns(message), values)
        times_s = stated.seconds(stamp_ns(message)) if stated.span else NO_TIMES
        if stated.core > 0.0:
            break
    if times.by_azimuth:
        times_s = from_azimuth(points[:count], times.config)
    points = moved(points[:count], T_frame_points)
    if plane_m is not None:
        off_m = np.abs(points[:, 2] - plane_m).max(initial=0.0)
        if off_m > _PLANAR_M:
            where = f"off the plane z = {plane_m:.3g} m, in which all points of the first clouds lie"
            raise MalformedMessageError(f"a point lies {off_m:.3g} m {where}")
        points = np.ascontiguousarray(points[:, :2])
    why = ""
    if not count:
        why = _why_none(np.hypot(np.hypot(x, y), z), max(low_m, _NEAREST_M), np.sqrt(high_square))
    height, width, step, odd = message.height, message.width, message.point_step, ""
    if (rest := (len(message.data) - height * max(message.row_step, width * step)) // step) > 0 and len(cloud):
        odd = f"its data have {rest:,} more points than height {height} × width {width}: the rest is left out"
    return Returns(stamp_ns(message), points, times_s, len(cloud) - count, why, frame_of(message), stated, odd=odd)


def plane_height_m(clouds: Iterable[Returns]) -> float | None:
    """Height of the plane that contains all points of the first clouds; None if there is none, or few points."""
    heights_m = np.empty(0, np.float32)
    most = 0
    for cloud in clouds:
        most = max(most, len(cloud.points))
        heights_m = np.concatenate([heights_m, cloud.points[:, 2]])
        if len(heights_m) and np.ptp(heights_m) > 2.0 * _PLANAR_M:
            return None
        if len(heights_m) > 1000:
            break
    return float(np.median(heights_m)) if most >= 3 else None  # three points define a plane


def _as_float32(values: NDArray[np.generic]) -> NDArray[np.float32]:
    """The field itself if it is native float32, else a copy; infinite beyond the range of float32."""
    if values.dtype == np.float32 and values.dtype.isnative and values.flags.aligned:
        return values.view(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32)


def _layout(message: Any, times: PointTimes) -> np.dtype[np.void]:
    """A point as a structured type: x, y, z and the fields with times."""
    if message.point_step >= 1 << 31:
        raise MalformedMessageError(f"point_step {message.point_step} is too large for a point")
    fields = {field.name: field for field in message.fields}
    if missing := [name for name in "xyz" if name not in fields]:
        raise MalformedMessageError(
            f"the cloud has no field {' '.join(missing)} (it has: {', '.join(fields) or 'none'})"
        )
    chosen = ["x", "y", "z", *times.fields(fields)]
    numbers: list[np.dtype[np.generic]] = []
    for name in chosen:
        field = fields[name]
        if field.datatype not in NUMBERS:
            raise MalformedMessageError(
                f"field {name} has data type {field.datatype}; PointField defines 1 to 8, PCL 9 and 10"
            )
        numbers.append(np.dtype((">" if message.is_bigendian else "<") + NUMBERS[field.datatype]))
        end = field.offset + numbers[-1].itemsize
        if end > message.point_step:
            raise MalformedMessageError(
                f"field {name} reaches to byte {end} of a point, beyond point_step {message.point_step}"
            )
    offsets = [fields[name].offset for name in chosen]
    return np.dtype({"names": chosen, "formats": numbers, "offsets": offsets, "itemsize": message.point_step})


def _rows(message: Any, point: np.dtype[np.void]) -> NDArray[np.void]:
    """All points of all rows, without the padding after each row."""
    height, width, body = message.height, message.width, message.data
    row = width * point.itemsize
    # drivers of packed points state 0, as of an empty cloud, or the bytes of all rows
    stride = row if height <= 1 or len(body) == height * row else message.row_step
    if stride < row:
        raise MalformedMessageError(f"row_step {stride} is less than the {row} bytes of {width} points")
    needed = (height - 1) * stride + row if height and width else 0
    if len(body) < needed:
        raise MalformedMessageError(
            f"data has {len(body)} bytes, fewer than the {needed} of {height} × {width} points "
            f"of {point.itemsize} bytes"
        )
    if not needed:
        return np.empty(0, point)
    return np.ndarray((height, width), point, body, strides=(stride, point.itemsize)).reshape(-1)


def moved(points: RawPoints, T: Pose | None) -> RawPoints:
    """Points (N, d) transformed by a pose (4, 4); None is the identity."""
    d = points.shape[1]
    return points if T is None else (points @ T[:d, :d].T + T[:d, 3]).astype(np.float32)


def with_offsets(points: Points, elevation_rad: float, range_m: float) -> Points:
    """Points (N, d) in the lidar's own frame, raised, if d = 3, and their ranges lengthened."""
    if points.shape[1] == 3 and elevation_rad:
        points = raise_elevation(np.ascontiguousarray(points, np.float64), elevation_rad)
    lengths_m = np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
    return points * (1.0 + range_m / lengths_m)


def _why_none(ranges_m: NDArray[np.float32], low_m: float, high_m: float) -> str:
    """Reason why none of the ranges (N,) is a return between the limits, as text."""
    undefined = int(np.count_nonzero(~np.isfinite(ranges_m)))
    near = int(np.count_nonzero(ranges_m < low_m)) - int(np.count_nonzero(np.isneginf(ranges_m)))
    far_m = ranges_m[np.isfinite(ranges_m) & (ranges_m >= high_m)]
    in_millimeters = len(far_m) and low_m <= 1e-3 * float(far_m.min()) <= 1e-3 * float(far_m.max()) < high_m
    hint = ": millimeters? convert them to meters" if in_millimeters else ""
    return (
        f"of {len(ranges_m)} ranges {undefined} are NaN or infinite, {near} are below {low_m:.3g} m, "
        f"{len(far_m)} are at {high_m:.3g} m or beyond{hint}"
    )
