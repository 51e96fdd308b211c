"""ROS messages, unpacked by rosbags from ROS 2's CDR or ROS 1's packed serialization, and packed in CDR."""

from __future__ import annotations

from functools import cache
from typing import Any

from scanchain.errors import one_line

_TRANSFORMS = "tf2_msgs/msg/TFMessage"


class MalformedMessageError(Exception):
    """A message that contradicts its schema; the text says how."""


@cache
def typestore(encoding: str = "cdr") -> Any:
    """The message types of ROS 2, or of ROS 1 for the encoding ``ros1``."""
    from rosbags.typesys import Stores, get_typestore  # a twentieth of a second

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    if encoding == "ros1":  # there it is that of tf2_msgs, which is not of the core
        store.register({_TRANSFORMS: typestore().fielddefs[_TRANSFORMS]})
    return store


def unpacked(data: memoryview, type_name: str, encoding: str) -> Any:
    """A message of a type, pkg/msg/Type; its arrays are views. Raises MalformedMessageError."""
    from rosbags.serde import SerdeError

    store = typestore(encoding)
    unpack = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    try:
        return unpack(data, type_name)
    except SerdeError as error:
        raise MalformedMessageError(one_line(error)) from error


def packed(type_name: str, *fields: Any) -> bytes:
    """A message of a type, pkg/msg/Type, in CDR."""
    return bytes(typestore().serialize_cdr(new(type_name, *fields), type_name))


def new(type_name: str, *fields: Any) -> Any:
    """A message of a type, pkg/msg/Type, or a part of one."""
    return typestore().types[type_name](*fields)


def stamp_ns(message: Any) -> int:
    """The stamp of a message's header."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
