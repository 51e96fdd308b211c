"""PLY files: the vertices. Format: Turk 1994."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from scanchain.logs.formats.point_rows import CloudFileError, ascii_rows, binary_rows

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_MOST_HEADER_LINES = 1000


def read_ply(path: Path) -> NDArray[np.void]:
    """The vertices of a file, ascii or binary in either byte order, fields as they are."""
    with path.open("rb") as file:
        point, count, form = _header(file)
        return ascii_rows(file, point, count) if form == "ascii" else binary_rows(file, point, count)


def _header(file: IO[bytes]) -> tuple[np.dtype[np.void], int, str]:
    """The layout of a vertex, how many there are, and the form; vertices must come first, as they do."""
    fields: list[tuple[str, str]] = []
    form, element, count = "", "", 0
    for words in _lines(file):
        match words:
            case ["format", form, *_] if form in _ORDERS:
                pass
            case ["element", element, number, *_]:
                if element == "vertex" and number.isdigit():
                    count = int(number)
                elif not fields:
                    raise CloudFileError(f"has {element} before its vertices, which is not understood")
            case ["property", kind, name] if kind in _TYPES and element == "vertex":
                fields.append((name, _ORDERS.get(form, "<") + _TYPES[kind]))
            case ["property", *_] if element == "vertex":
                raise CloudFileError(f"has the vertex property {' '.join(words[1:])!r}, which is not understood")
    if not form or not fields:
        raise CloudFileError("is no PLY with vertices")
    if len(dict(fields)) < len(fields):
        raise CloudFileError(f"has a vertex property twice among {' '.join(name for name, _ in fields)}")
    return np.dtype(fields), count, form


def _lines(file: IO[bytes]) -> Iterator[list[str]]:
    if file.readline(8).strip() != b"ply":
        raise CloudFileError("is no PLY: its first line is another")
    for _ in range(_MOST_HEADER_LINES):
        words = file.readline(4096).decode("ascii", "replace").split()
        if words == ["end_header"]:
            return
        yield words
    raise CloudFileError("is no PLY: its header does not end")
