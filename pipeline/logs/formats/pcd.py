"""PCD files. Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import IO

import lzf
import numpy as np
from numpy.typing import NDArray

from scanchain.logs.formats.point_rows import CloudFileError, ascii_rows, binary_rows

_TYPES = {("F", "4"): "<f4", ("F", "8"): "<f8"} | {
    (sign, str(size)): f"<{code}{size}" for sign, code in (("I", "i"), ("U", "u")) for size in (1, 2, 4, 8)
}
_MOST_HEADER_LINES = 100
_MOST_RATIO = 1000  # LZF cannot pack tighter than about 1 to 130


def read_pcd(path: Path) -> NDArray[np.void]:
    """The points of a file, ascii, binary or binary_compressed, fields as they are."""
    with path.open("rb") as file:
        header = _header(file)
        try:
            point, count, form = _layout(header), int(header["POINTS"][0]), header["DATA"][0]
        except (KeyError, IndexError, ValueError) as error:
            raise CloudFileError(f"is no PCD: its header does not tell {error}") from error
        if form == "ascii":
            return ascii_rows(file, point, count)
        return _unpacked(file, point, count) if form == "binary_compressed" else binary_rows(file, point, count)


def _header(file: IO[bytes]) -> dict[str, list[str]]:
    """The words of each line, by the first."""
    header: dict[str, list[str]] = {}
    for _ in range(_MOST_HEADER_LINES):
        words = file.readline(65536).decode("ascii", "replace").split()
        if words:
            header[words[0]] = words[1:]
        if "DATA" in header:
            break
    return header


def _layout(header: dict[str, list[str]]) -> np.dtype[np.void]:
    """A point: each field by its name, several numbers of one field as one."""
    names, kinds = header["FIELDS"], list(zip(header["TYPE"], header["SIZE"], strict=True))
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    fields = [
        (f"_{place}" if name == "_" else name, _TYPES[kind], (count,) if count > 1 else ())
        for place, (name, kind, count) in enumerate(zip(names, kinds, counts, strict=True))
    ]
    return np.dtype(fields)


def _unpacked(file: IO[bytes], point: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """Points that are packed by LZF, field by field."""
    sizes = file.read(8)
    if len(sizes) < 8:
        raise CloudFileError("ends within its header")
    packed_size, size = struct.unpack("<II", sizes)
    packed = file.read(packed_size)
    if size < count * point.itemsize or size > _MOST_RATIO * len(packed):
        raise CloudFileError(f"does not unpack: {size} bytes are told for {count} points, {len(packed)} are there")
    try:
        data = lzf.decompress(packed, size)
    except ValueError:
        data = None
    if data is None or len(data) != size:
        raise CloudFileError("does not unpack: its bytes are damaged")
    rows = np.empty(count, point)
    offset = 0
    for name in point.names or ():
        field = point[name]
        rows[name] = np.frombuffer(data, field, count, offset)
        offset += count * field.itemsize
    return rows
