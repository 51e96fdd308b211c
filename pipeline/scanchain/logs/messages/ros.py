"""ROS messages, deserialized by rosbags from CDR (ROS 2) or ROS 1, and serialized to CDR."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

from scanchain.errors import one_line, printable

# of sensor_msgs/PointField, and 9 and 10 of PCL
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8"}
_ZSTD = b"\x28\xb5\x2f\xfd"  # with which data compressed by zstd begin
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_GPS = {  # of gps_msgs and gps_common: the types of the fields, each with names
    "GPSStatus": (
        "std_msgs/Header header",
        "uint16 satellites_used",
        "int32[] satellite_used_prn",
        "uint16 satellites_visible",
        "int32[] satellite_visible_prn satellite_visible_z satellite_visible_azimuth satellite_visible_snr",
        "int16 status",
        "uint16 motion_source orientation_source position_source",
    ),
    "GPSFix": (
        "std_msgs/Header header",
        "GPSStatus status",
        "float64 latitude longitude altitude track speed climb pitch roll dip time gdop pdop hdop vdop tdop",
        "float64 err err_horz err_vert err_track err_speed err_climb err_time err_pitch err_roll err_dip",
        "float64[9] position_covariance",
        "uint8 position_covariance_type",
    ),
}


class MalformedMessageError(Exception):
    """A message that contradicts its schema; the text states how."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))


@cache
def typestore(encoding: str = "cdr") -> Any:
    """Message types of ROS 2, or of ROS 1 for the encoding ``ros1``."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # takes 0.05 s

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    if encoding == "ros1":  # which has it outside of the core types
        store.register({_TRANSFORMS: typestore().fielddefs[_TRANSFORMS]})
    for package, (name, fields) in product(("gps_msgs", "gps_common"), _GPS.items()):  # nor are these among them
        pairs = ((kind, each) for kind, *names in map(str.split, fields) for each in names)
        store.register(get_types_from_msg("\n".join(map(" ".join, pairs)), f"{package}/msg/{name}"))
    return store


def unpacked(data: memoryview, type_name: str, encoding: str) -> Any:
    """Deserialized message of a type, pkg/msg/Type; its arrays are views. Raises MalformedMessageError."""
    from rosbags.serde import SerdeError

    store = typestore(encoding)
    unpack = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    try:
        return unpack(data, type_name)
    except SerdeError as error:
        packed_alone = "it is compressed: give the folder of the bag, with its metadata.yaml"
        raise MalformedMessageError(packed_alone if data[:4] == _ZSTD else one_line(error)) from error


def packed(type_name: str, *fields: Any) -> bytes:
    """Serialized message of a type, pkg/msg/Type, in CDR."""
    return bytes(typestore().serialize_cdr(new(type_name, *fields), type_name))


def new(type_name: str, *fields: Any) -> Any:
    """A message of a type, pkg/msg/Type, or a part of one."""
    return typestore().types[type_name](*fields)


def header(stamp_ns: int, frame: str) -> Any:
    """A std_msgs/Header."""
    return new("std_msgs/msg/Header", new("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000)), frame)


def point_fields(*layout: tuple[str, int, int]) -> list[Any]:
    """A sensor_msgs/PointField for each name, offset and number type."""
    return [new("sensor_msgs/msg/PointField", *each, 1) for each in layout]


def frame_name(frame: str) -> str:
    """Printable name of a frame, without the leading slash of some in ROS 1."""
    return printable(frame.lstrip("/"))


def frame_of(message: Any) -> str:
    """The frame of a message's header."""
    return frame_name(str(message.header.frame_id))


def stamp_ns(message: Any) -> int:
    """The stamp of a message's header."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
