"""A text file, plain or packed by bzip2 or gzip, as far as it unpacks."""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, NamedTuple, Protocol

from scanchain.errors import InputError

_MOST_BYTES = 2 << 30  # of text
_PLAIN_BYTES = 1 << 20  # read at once
_PACKED_BYTES = 64  # unpacked at once: what comes of so many before damage is lost with it


class Text(NamedTuple):
    """What a file unpacks to; ``damage`` says what is wrong with the rest, empty where all is well."""

    data: bytes
    damage: str


class _Unpacker(Protocol):
    @property
    def eof(self) -> bool: ...
    @property
    def unused_data(self) -> bytes: ...
    def decompress(self, data: bytes, /) -> bytes: ...


def read_text(path: Path) -> Text:
    """The text of a file. Raises InputError where it cannot be read or unpacks to more than is believed."""
    text = bytearray()
    try:
        with path.open("rb") as file:
            for piece in _pieces(file):
                text += piece
                if len(text) > _MOST_BYTES:
                    raise InputError(f"{path}: unpacks to more than {_MOST_BYTES:,} bytes; is it a CARMEN log?")
    except (zlib.error, EOFError, ValueError) as error:
        return Text(bytes(text), f"{path}: does not unpack beyond byte {len(text)} of the text ({error})")
    except OSError as error:
        if error.errno is None:  # of bz2, not of the system
            return Text(bytes(text), f"{path}: does not unpack beyond byte {len(text)} of the text ({error})")
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file") from error
    return Text(bytes(text), "")


def _pieces(file: IO[bytes]) -> Iterator[bytes]:
    head = file.read(3)
    file.seek(0)
    if head == b"BZh":
        yield from _unpacked(file, bz2.BZ2Decompressor)
    elif head[:2] == b"\x1f\x8b":
        yield from _unpacked(file, lambda: zlib.decompressobj(zlib.MAX_WBITS | 16))
    else:
        while piece := file.read(_PLAIN_BYTES):
            yield piece


def _unpacked(file: IO[bytes], begin: Callable[[], _Unpacker]) -> Iterator[bytes]:
    """What comes out of one packed stream after the other. Raises EOFError where the last is cut off."""
    unpacker = begin()
    while packed := file.read(_PACKED_BYTES):
        while packed:
            unpacker = begin() if unpacker.eof else unpacker
            yield unpacker.decompress(packed)
            packed = unpacker.unused_data
    if not unpacker.eof:
        raise EOFError("it is cut off")
