"""A Livox driver's CustomMsg as a cloud with a time for each point."""

from __future__ import annotations

from scanchain.logs.messages.cdr import CdrReader, MalformedMessageError
from scanchain.logs.messages.point_cloud import PointCloudMessage, PointField

_POINT_BYTES = 19  # offset_time, x, y, z, reflectivity, tag, line
_FIELDS = [
    PointField("offset_time", 0, 6, 1),
    PointField("x", 4, 7, 1),
    PointField("y", 8, 7, 1),
    PointField("z", 12, 7, 1),
]
_DESCRIBED = b"livox CustomMsg, little endian", b"livox CustomMsg, big endian"


def read_livox(data: memoryview, form: type[CdrReader] = CdrReader) -> PointCloudMessage:
    """Take a message apart; the points are a view of it, each a row of its own as CDR aligns them."""
    reader = form(data)
    stamp_ns, frame = reader.header()
    reader.numbers("Q")  # time of the first point, by the lidar's clock
    reader.integer()  # the number of points, told once more by their array
    reader.numbers("B", 4)  # lidar and reserved
    count = reader.integer()
    before = reader.offset
    reader.offset += _POINT_BYTES
    reader.align(4)
    stride = reader.offset - before
    if (count - 1) * stride + _POINT_BYTES > len(data) - before:
        raise MalformedMessageError(f"it has {len(data)} bytes, too few for {count} points of {stride} bytes")
    is_bigendian = reader.order == ">"
    body, described = data[before:], _DESCRIBED[is_bigendian]
    return PointCloudMessage(
        stamp_ns, frame, count, 1, _FIELDS, is_bigendian, _POINT_BYTES, stride, body, described
    )
