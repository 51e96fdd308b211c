"""sensor_msgs/PointCloud2 to points in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.logs.cdr import CdrReader, MalformedMessageError
from pipeline.logs.laser_scan import Returns
from pipeline.logs.limits import RangeLimits
from pipeline.logs.point_times import NAMES, seconds_after

_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField


@dataclass(frozen=True, slots=True)
class Layout:
    """Where a channel keeps its fields: a structured type, and the name of the time field, if any."""

    point: np.dtype[np.void]
    time: str


class PointCloudDecoder:
    """Decodes the clouds of one channel; field offsets are worked out once for each layout."""

    dimension = 3

    def __init__(self, limits: RangeLimits) -> None:
        self.limits = limits
        self.layouts: dict[tuple[bytes, bool, int], Layout] = {}

    def decode(self, data: memoryview) -> Returns:
        """Points that came back: finite, not the origin, within the limits; their times with them.

        Rows may be padded, bytes in either order, x y z of any number type, other fields are passed over.
        """
        reader = CdrReader(data)
        stamp_ns, frame = reader.header()
        height, width = reader.integer(), reader.integer()
        begin = reader.offset
        fields = [self._field(reader) for _ in range(reader.integer())]
        described = bytes(data[begin : reader.offset])
        big_endian = bool(reader.integer("B"))
        point_step, row_step = reader.integer(), reader.integer()
        body = reader.octets()
        key = (described, big_endian, point_step)
        layout = self.layouts.get(key)
        if layout is None:
            layout = self.layouts[key] = _layout(fields, big_endian, point_step)
        cloud = _rows(body, layout.point, height, width, row_step)
        return self._filter(cloud, layout, stamp_ns, frame)

    def _filter(self, cloud: NDArray[np.void], layout: Layout, stamp_ns: int, frame: str) -> Returns:
        points = np.empty((len(cloud), 3), np.float32)
        for axis, name in enumerate("xyz"):
            points[:, axis] = cloud[name]
        square = np.einsum("ij,ij->i", points, points)
        low, high = self.limits.min_m**2, self.limits.max_m**2
        valid = (square > low) & (square < min(high, np.finfo(np.float32).max))
        times_s = seconds_after(stamp_ns, cloud[layout.time]) if layout.time else np.empty(0, np.float32)
        kept = int(np.count_nonzero(valid))
        if kept < len(cloud):
            points = points[valid]
            times_s = times_s[valid] if layout.time else times_s
        why = "" if kept else _why_none(cloud, square)
        return Returns(stamp_ns, frame, points, times_s, len(cloud) - kept, why)

    @staticmethod
    def _field(reader: CdrReader) -> tuple[str, int, int, int]:
        """Name, offset, data type and count of a sensor_msgs/PointField."""
        name = reader.string()
        return name, reader.integer(), reader.integer("B"), reader.integer()


def _layout(fields: list[tuple[str, int, int, int]], big_endian: bool, point_step: int) -> Layout:
    wanted: dict[str, tuple[str, int]] = {}
    order = ">" if big_endian else "<"
    for name, offset, kind, _ in fields:
        if name not in ("x", "y", "z", *NAMES):
            continue
        if kind not in _FORMATS:
            raise MalformedMessageError(f"field {name} has data type {kind}; PointField knows 1 to 8")
        number = np.dtype(order + _FORMATS[kind])
        if offset + number.itemsize > point_step:
            raise MalformedMessageError(
                f"field {name} reaches to byte {offset + number.itemsize} of a point, beyond point_step {point_step}"
            )
        wanted[name] = (number.str, offset)
    missing = [name for name in "xyz" if name not in wanted]
    if missing:
        names = ", ".join(field[0] for field in fields) or "none"
        raise MalformedMessageError(f"the cloud has no field {' '.join(missing)} (it has {names})")
    time = next((name for name in NAMES if name in wanted), "")
    chosen = ["x", "y", "z", time] if time else ["x", "y", "z"]
    point = np.dtype({
        "names": chosen,
        "formats": [wanted[name][0] for name in chosen],
        "offsets": [wanted[name][1] for name in chosen],
        "itemsize": point_step,
    })  # fmt: skip
    return Layout(point, time)


def _rows(
    body: memoryview, point: np.dtype[np.void], height: int, width: int, row_step: int
) -> NDArray[np.void]:
    """All points of all rows, the padding behind each row left out."""
    row = width * point.itemsize
    stride = row_step if height > 1 else row
    needed = (height - 1) * stride + row if height and width else 0
    if len(body) < needed or stride < row:
        raise MalformedMessageError(
            f"data has {len(body)} bytes, fewer than the {needed} of {height} × {width} points of {point.itemsize} bytes"
            if stride >= row
            else f"row_step {row_step} is less than the {row} bytes of {width} points"
        )
    if height <= 1 or stride == row:
        return np.frombuffer(body, point, height * width)
    rows = [np.frombuffer(body, point, width, number * stride) for number in range(height)]
    return np.concatenate(rows)


def _why_none(cloud: NDArray[np.void], square: NDArray[np.float32]) -> str:
    if not len(cloud):
        return "the cloud is empty"
    undefined = int(np.count_nonzero(~np.isfinite(square)))
    zero = int(np.count_nonzero(square == 0.0))
    outside = len(cloud) - undefined - zero
    return f"of {len(cloud)} points {undefined} are NaN or infinite, {zero} are (0, 0, 0), {outside} are out of range"


