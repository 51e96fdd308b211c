"""Messages in Protobuf, by the schema that the log carries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from scanchain.logs.mcap.records import Channel
from scanchain.logs.messages.cdr import MalformedMessageError


def parser(channel: Channel) -> Callable[[memoryview], Any]:
    """What parses the messages of a channel; one that cannot be made complains at every message."""
    from google.protobuf.message import DecodeError
    from mcap.exceptions import McapError
    from mcap.records import Schema
    from mcap_protobuf.decoder import DecoderFactory

    schema = Schema(data=channel.definition, encoding="protobuf", id=1, name=channel.type_name)
    try:
        decode = DecoderFactory().decoder_for("protobuf", schema)
    except (McapError, DecodeError, TypeError, KeyError, RecursionError) as error:
        reason = f"its schema {channel.type_name} is broken: {' '.join(str(error).split())}"
        return lambda _: _complain(reason)
    assert decode is not None

    def parse(data: memoryview) -> Any:
        try:
            return decode(bytes(data))
        except DecodeError as error:
            raise MalformedMessageError(f"it is no Protobuf of its schema: {error}") from error

    return parse


def _complain(reason: str) -> None:
    raise MalformedMessageError(reason)
