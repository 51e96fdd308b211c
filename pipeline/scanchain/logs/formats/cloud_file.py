"""One cloud in a file, PCD, PLY, .npy or raw numbers, as an array of points with named fields.

PCD: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. PLY: Turk 1994.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import IO

import lzf
import numpy as np
from numpy.typing import NDArray

SUFFIXES = (".pcd", ".ply", ".npy", ".bin")
_MOST_COLUMNS = 16
XYZI = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])

_PCD_TYPES = {("F", "4"): "<f4", ("F", "8"): "<f8"} | {
    (sign, str(size)): f"<{code}{size}" for sign, code in (("I", "i"), ("U", "u")) for size in (1, 2, 4, 8)
}
_MOST_PCD_LINES = 100
_MOST_LZF_RATIO = 1000  # largest ratio of packing that is accepted; LZF reaches about 130

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_MOST_PLY_LINES = 1000


class CloudFileError(Exception):
    """A file that contradicts its header; the message says where."""


def ascii_rows(file: IO[bytes], point: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """``count`` lines of numbers."""
    lines = list(islice((line for line in file if line.strip()), count))
    try:
        rows = np.loadtxt(lines, point, comments=None, ndmin=1) if lines else np.empty(0, point)
    except ValueError as error:
        raise CloudFileError(f"is no list of {count} points ({error})") from error
    return _all_of(rows, count)


def binary_rows(file: IO[bytes], point: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """``count`` points, one after the other."""
    data = file.read(min(count * point.itemsize, os.fstat(file.fileno()).st_size))  # whatever a header claims
    return _all_of(np.frombuffer(data, point, len(data) // max(point.itemsize, 1)), count)


def _all_of(rows: NDArray[np.void], count: int) -> NDArray[np.void]:
    if len(rows) < count:
        raise CloudFileError(f"ends after {len(rows)} of its {count} points")
    return rows


def read_cloud_file(path: Path, raw: np.dtype[np.void] = XYZI) -> NDArray[np.void]:
    """The points (N,) of a file as they are, little endian, in number types of ROS.

    raw : a point of a .bin file
    Raises CloudFileError, and OSError where the file cannot be read.
    """
    readers = {".pcd": read_pcd, ".ply": read_ply, ".npy": read_npy, ".bin": lambda path: read_raw(path, raw)}
    rows = readers[path.suffix.lower()](path)
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise CloudFileError(f"has no x, y and z, but {', '.join(names) or 'nothing'}")
    numbers = [name for name in names if not rows.dtype[name].shape]
    point = np.dtype([(name, _ros_type(rows.dtype[name])) for name in numbers])
    return rows[numbers].astype(point, copy=False)


def read_xyzi(path: Path) -> NDArray[np.void]:
    """The points of a file of float32 x, y, z, intensity, as KITTI and others write them."""
    return read_raw(path, XYZI)


def read_raw(path: Path, point: np.dtype[np.void]) -> NDArray[np.void]:
    """The points of a file without a header."""
    size = path.stat().st_size
    if size % point.itemsize:
        names = ", ".join(point.names or ())
        raise CloudFileError(f"has {size} bytes, not a multiple of the {point.itemsize} of {names}")
    return np.fromfile(path, point)


def read_npy(path: Path) -> NDArray[np.void]:
    """The points of a NumPy array, (N, 3) or more columns, x y z first, or (N,) with fields of these names."""
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, MemoryError) as error:
        raise CloudFileError("is no .npy array of numbers") from error
    if not isinstance(array, np.ndarray):
        raise CloudFileError("is an archive of arrays, no .npy array; save each cloud in a file of its own")
    if array.dtype.names and array.ndim == 1:
        return array
    is_list = array.ndim == 2 and 3 <= array.shape[1] <= _MOST_COLUMNS
    if array.dtype.kind not in "fiu" or not is_list or (len(array) in (3, 4) and array.shape[1] > 4):
        raise CloudFileError(
            f"is an array {array.shape} of {array.dtype}; give numbers (N, 3), (N, 4) or more columns, x y z first"
        )
    return np.rec.fromarrays(list(array.T), dtype=point_of_columns(array.dtype, array.shape[1]))


def point_of_columns(kind: np.dtype[np.generic], count: int) -> np.dtype[np.void]:
    """A point of so many numbers of a kind."""
    names = ["x", "y", "z", "intensity", *(f"column_{k}" for k in range(5, count + 1))][:count]
    return np.dtype([(name, kind.str) for name in names])


def _ros_type(kind: np.dtype[np.generic]) -> str:
    """The number type itself, little endian; float64 for one that ROS lacks, float32 for one of 16 bits."""
    if kind.kind == "f" and kind.itemsize not in (4, 8):
        return "<f4" if kind.itemsize == 2 else "<f8"
    return "<f8" if kind.itemsize == 8 else kind.newbyteorder("<").str.replace("|", "<")


def read_pcd(path: Path) -> NDArray[np.void]:
    """The points of a file, ascii, binary or binary_compressed, fields as they are."""
    with path.open("rb") as file:
        header = _pcd_header(file)
        try:
            point, count, form = _pcd_point(header), int(header["POINTS"][0]), header["DATA"][0]
        except (KeyError, IndexError, ValueError) as error:
            raise CloudFileError(f"is no PCD: its header does not state {error}") from error
        if form == "ascii":
            return ascii_rows(file, point, count)
        return (
            _lzf_unpacked(file, point, count) if form == "binary_compressed" else binary_rows(file, point, count)
        )


def _pcd_header(file: IO[bytes]) -> dict[str, list[str]]:
    """The words of each line, by the first."""
    header: dict[str, list[str]] = {}
    for _ in range(_MOST_PCD_LINES):
        words = file.readline(65536).decode("ascii", "replace").split()
        if words:
            header[words[0]] = words[1:]
        if "DATA" in header:
            break
    return header


def _pcd_point(header: dict[str, list[str]]) -> np.dtype[np.void]:
    """A point: each field by its name, several numbers of one field as one."""
    names, kinds = header["FIELDS"], list(zip(header["TYPE"], header["SIZE"], strict=True))
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    fields = [
        (f"_{place}" if name == "_" else name, _PCD_TYPES[kind], (count,) if count > 1 else ())
        for place, (name, kind, count) in enumerate(zip(names, kinds, counts, strict=True))
    ]
    return np.dtype(fields)


def _lzf_unpacked(file: IO[bytes], point: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """Points that are packed by LZF, field by field."""
    sizes = file.read(8)
    if len(sizes) < 8:
        raise CloudFileError("ends within its header")
    packed_size, size = struct.unpack("<II", sizes)
    packed = file.read(packed_size)
    if size < count * point.itemsize or size > _MOST_LZF_RATIO * len(packed):
        raise CloudFileError(
            f"does not unpack: {size} bytes are stated for {count} points, {len(packed)} are there"
        )
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


def read_ply(path: Path) -> NDArray[np.void]:
    """The vertices of a file, ascii or binary in either byte order, fields as they are."""
    with path.open("rb") as file:
        point, count, form = _ply_header(file)
        return ascii_rows(file, point, count) if form == "ascii" else binary_rows(file, point, count)


def _ply_header(file: IO[bytes]) -> tuple[np.dtype[np.void], int, str]:
    """The layout of a vertex, their number, and the form; vertices must come first, as they do."""
    fields: list[tuple[str, str]] = []
    form, element, count = "", "", 0
    for words in _ply_lines(file):
        match words:
            case ["format", form, *_] if form in _PLY_ORDERS:
                pass
            case ["element", element, number, *_]:
                if element == "vertex" and number.isdigit():
                    count = int(number)
                elif not fields:
                    raise CloudFileError(f"has {element} before its vertices, which is not understood")
            case ["property", kind, name] if kind in _PLY_TYPES and element == "vertex":
                fields.append((name, _PLY_ORDERS.get(form, "<") + _PLY_TYPES[kind]))
            case ["property", *_] if element == "vertex":
                raise CloudFileError(f"has the vertex property {' '.join(words[1:])!r}, which is not understood")
    if not form or not fields:
        raise CloudFileError("is no PLY with vertices")
    if len(dict(fields)) < len(fields):
        raise CloudFileError(f"has a vertex property twice among {' '.join(name for name, _ in fields)}")
    return np.dtype(fields), count, form


def _ply_lines(file: IO[bytes]) -> Iterator[list[str]]:
    if file.readline(8).strip() != b"ply":
        raise CloudFileError("is no PLY: its first line is another")
    for _ in range(_MOST_PLY_LINES):
        words = file.readline(4096).decode("ascii", "replace").split()
        if words == ["end_header"]:
            return
        yield words
    raise CloudFileError("is no PLY: its header does not end")
