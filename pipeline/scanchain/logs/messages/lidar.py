"""Messages of lidars to the points that came back: laser scans in the plane, clouds in space."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from functools import lru_cache
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.config import LogConfig
from scanchain.data import Pose, RawPoints
from scanchain.errors import one_line
from scanchain.kernels.scans import keep_valid
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

_NEAREST_M = float(np.finfo(np.float32).tiny)  # below it a range is zero
_MOST_GEOMETRIES = 16
_MOST_TURNS = 2.0  # largest number of turns that the beams of a scan cover; in degrees they seem to cover more
_FARTHEST_M = float(np.finfo(np.float32).max)
_MOST_STEP = (1 << 31) - 1
_PLANAR_M = 5e-4  # largest distance from the plane of a point of a planar cloud: rounding of float32
_FEWEST_POINTS, _ENOUGH_POINTS = 3, 1000  # least number of points of a cloud, and in all, that show a plane

_LIVOX_POINT_BYTES = 19  # offset_time, x, y, z, reflectivity, tag, line
_LIVOX_FIELDS = (("offset_time", 0, 6), ("x", 4, 7), ("y", 8, 7), ("z", 12, 7))


class Sensed(NamedTuple):
    """A LaserScan or PointCloud2 of sensor_msgs; pose (4, 4) of its points in its frame, None for its origin."""

    message: Any
    T_frame_points: Pose | None = None


def read_multi_echo_scan(message: Any) -> Sensed:
    """A sensor_msgs/MultiEchoLaserScan as the scan of each beam's first echo, inf where there is none."""
    firsts_m = [beam.echoes[0] if len(beam.echoes) else np.inf for beam in message.ranges]
    message.ranges = np.array(firsts_m, np.float32)
    return Sensed(message)


def decode_laser_scan(data: memoryview, read: Callable[[memoryview], Sensed], config: LogConfig) -> Returns:
    """Points of the beams that came back: finite, at least range_min, below range_max.

    Scanners write range_max, or more, for a beam without return, and zero for an invalid one; limits that are
    not positive are taken as unknown. Negative angle increments are as good as positive ones.
    """
    message, T_frame_points = read(data)
    ranges_m = message.ranges
    low_m = max(message.range_min if message.range_min > 0.0 else 0.0, config.min_range_m, _NEAREST_M)
    high_m = min(message.range_max if message.range_max > 0.0 else _FARTHEST_M, config.max_range_m, _FARTHEST_M)
    directions = _directions(message.angle_min, message.angle_increment, len(ranges_m))
    valid = ((ranges_m >= low_m) & (ranges_m < high_m)).nonzero()[0]
    points = directions[valid] * ranges_m[valid, None]
    times_s, stated = NO_TIMES, None
    if config.point_times in UNITS_S or config.point_times == "auto":
        turns = abs(message.angle_increment) * len(ranges_m) / (2.0 * np.pi)
        stated = Beams(valid, len(ranges_m), turns, message.time_increment, message.scan_time)
        times_s = stated.seconds(UNITS_S.get(config.point_times, 1.0) * message.time_increment)
    elif config.point_times not in ("none", "azimuth"):
        times_s = from_azimuth(points, config)
    points = moved(points, T_frame_points).astype(np.float32, copy=False)
    why = "" if len(valid) else _why_none(ranges_m, low_m, high_m)
    count = len(ranges_m) - len(valid)
    return Returns(stamp_ns(message), points, times_s, count, why, frame_of(message), stated)


@lru_cache(_MOST_GEOMETRIES)
def _directions(first_rad: float, step_rad: float, count: int) -> NDArray[np.float32]:
    """Directions (N, 2) of the beams."""
    if not isfinite(first_rad + step_rad * count):
        raise MalformedMessageError(
            f"its beams lie {step_rad:g} rad apart from {first_rad:g} rad on, which cannot be"
        )
    turns = abs(step_rad) * count / (2.0 * np.pi)
    if turns > _MOST_TURNS:
        raise MalformedMessageError(
            f"its {count} beams, {step_rad:g} rad apart, cover {turns:.3g} turns: degrees? wanted radians"
        )
    angles_rad = first_rad + step_rad * np.arange(count)
    return np.column_stack([np.cos(angles_rad), np.sin(angles_rad)]).astype(np.float32)


def read_livox(data: memoryview, encoding: str) -> Sensed:
    """A Livox driver's CustomMsg, the points a view of it, each a row of its own as CDR aligns them."""
    is_ros1 = encoding == "ros1"
    order = "<" if is_ros1 or data[1:2] == b"\1" else ">"
    try:
        seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
        frame = str(data[16 : 16 + length], "utf-8", "replace").rstrip("\0")
        begin = 16 + length  # behind it the time of the first point by the lidar's clock, aligned to 8 bytes
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
    """Points that came back: finite, not the origin, within the limits; their times with them.

    Rows may be padded, bytes in either order, x y z of any number type; other fields are passed over.

    plane_m : height of the plane of a planar scanner, whose points (N, 2) are those in the plane
    Raises MalformedMessageError, also where a point is not in the plane of the others.
    """
    message, T_frame_points = read(data)
    point = _layout(message, times)
    cloud = _rows(message, point)
    points = np.empty((len(cloud), 3), np.float32)
    kept = np.empty(len(cloud), np.int32)
    x, y, z = (_as_float32(cloud[name]) for name in "xyz")
    low_m, high_m = times.config.min_range_m, times.config.max_range_m
    high_square = min(high_m * high_m, _FARTHEST_M)  # where float32 ends
    count = keep_valid(x, y, z, low_m**2, high_square, points, kept)
    times_s, stated = NO_TIMES, None
    for name in (point.names or ())[3:] if count else ():
        values = cloud[name] if count == len(cloud) else cloud[name][kept[:count]]
        stated = times.from_field(name, stamp_ns(message), values)
        times_s = stated.seconds(stamp_ns(message)) if stated.span else NO_TIMES
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
    return Returns(stamp_ns(message), points, times_s, len(cloud) - count, why, frame_of(message), stated)


def plane_height_m(clouds: Iterable[Returns]) -> float | None:
    """The common height of all points of the first clouds, None without one or with too few points."""
    heights_m = np.empty(0, np.float32)
    most = 0
    for cloud in clouds:
        most = max(most, len(cloud.points))
        heights_m = np.concatenate([heights_m, cloud.points[:, 2]])
        if len(heights_m) and np.ptp(heights_m) > 2.0 * _PLANAR_M:
            return None
        if len(heights_m) > _ENOUGH_POINTS:
            break
    return None if most < _FEWEST_POINTS else float(np.median(heights_m))


def _as_float32(values: NDArray[np.generic]) -> NDArray[np.float32]:
    """The field itself where it is native float32 already, else a copy; infinite where float32 ends."""
    if values.dtype == np.float32 and values.dtype.isnative and values.flags.aligned:
        return values.view(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32)


def _layout(message: Any, times: PointTimes) -> np.dtype[np.void]:
    """A point as a structured type: x, y, z and the time field, if any."""
    if message.point_step > _MOST_STEP:
        raise MalformedMessageError(f"point_step {message.point_step} is more than a point can have")
    fields = {field.name: field for field in message.fields}
    if missing := [name for name in "xyz" if name not in fields]:
        raise MalformedMessageError(
            f"the cloud has no field {' '.join(missing)} (it has: {', '.join(fields) or 'none'})"
        )
    chosen = ["x", "y", "z", *[name for name in times.fields if name in fields][:1]]
    numbers: list[np.dtype[np.generic]] = []
    for name in chosen:
        field = fields[name]
        if field.datatype not in NUMBERS:
            raise MalformedMessageError(f"field {name} has data type {field.datatype}; PointField has 1 to 8")
        numbers.append(np.dtype((">" if message.is_bigendian else "<") + NUMBERS[field.datatype]))
        end = field.offset + numbers[-1].itemsize
        if end > message.point_step:
            raise MalformedMessageError(
                f"field {name} reaches to byte {end} of a point, beyond point_step {message.point_step}"
            )
    offsets = [fields[name].offset for name in chosen]
    return np.dtype({"names": chosen, "formats": numbers, "offsets": offsets, "itemsize": message.point_step})


def _rows(message: Any, point: np.dtype[np.void]) -> NDArray[np.void]:
    """All points of all rows, the padding behind each row left out."""
    height, width, body = message.height, message.width, message.data
    row = width * point.itemsize
    stride = message.row_step if height > 1 else row
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
    """Points (N, d) moved by a pose (4, 4); None moves nothing."""
    d = points.shape[1]
    return points if T is None else (points @ T[:d, :d].T + T[:d, 3]).astype(np.float32)


def _why_none(ranges_m: NDArray[np.float32], low_m: float, high_m: float) -> str:
    """Reason why none of the ranges (N,) is a return between these limits."""
    undefined = int(np.count_nonzero(~np.isfinite(ranges_m)))
    near = int(np.count_nonzero(ranges_m < low_m)) - int(np.count_nonzero(np.isneginf(ranges_m)))
    far_m = ranges_m[np.isfinite(ranges_m) & (ranges_m >= high_m)]
    in_millimeters = len(far_m) and low_m <= 1e-3 * float(far_m.min()) <= 1e-3 * float(far_m.max()) < high_m
    hint = ": millimeters? convert them to meters" if in_millimeters else ""
    return (
        f"of {len(ranges_m)} ranges {undefined} are NaN or infinite, {near} are below {low_m:.3g} m, "
        f"{len(far_m)} are at {high_m:.3g} m or beyond{hint}"
    )
