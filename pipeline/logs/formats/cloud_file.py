"""One cloud in a file, PCD, PLY or raw float32, as an array of points with named fields."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

_XYZI = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_MOST_HEADER_LINES = 1000


class CloudFileError(Exception):
    """A file that does not hold what its header says; the message says what is wrong."""


def read_cloud_file(path: Path) -> NDArray[np.void]:
    """The points (N,) of a file as they are, little endian, in number types that ROS knows.

    Raises CloudFileError, and OSError where the file cannot be read.
    """
    readers = {".pcd": _read_pcd, ".ply": _read_ply, ".bin": read_xyzi}
    rows = readers[path.suffix.lower()](path)
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise CloudFileError(f"has no x, y and z, but {', '.join(names) or 'nothing'}")
    wanted = np.dtype([(name, _ros_type(rows.dtype[name])) for name in names])
    return rows.astype(wanted, copy=False)


def read_xyzi(path: Path) -> NDArray[np.void]:
    """The points of a file of float32 x, y, z, intensity, as KITTI and others write them."""
    size = path.stat().st_size
    if size % _XYZI.itemsize:
        raise CloudFileError(f"has {size} bytes, not a multiple of the {_XYZI.itemsize} of x, y, z, intensity")
    return np.fromfile(path, _XYZI)


def _read_pcd(path: Path) -> NDArray[np.void]:
    """Points of a PCD file, ascii, binary or binary_compressed."""
    from pypcd4.pypcd4 import PointCloud

    try:
        return np.atleast_1d(PointCloud.from_path(path).pc_data)
    except OSError:
        raise
    except Exception as error:  # whatever a damaged file makes the library raise
        raise CloudFileError(f"is no PCD ({' '.join(str(error).split())[:200]})") from error


def _read_ply(path: Path) -> NDArray[np.void]:
    """The vertices of a PLY file, ascii or binary in either byte order. Format: Turk 1994."""
    with path.open("rb") as file:
        point, count, form = _ply_header(file)
        if form == "ascii":
            try:
                return np.loadtxt(file, point, max_rows=count, ndmin=1) if count else np.empty(0, point)
            except ValueError as error:
                raise CloudFileError(f"is no PLY of {count} vertices ({error})") from error
        rows = np.frombuffer(file.read(count * point.itemsize), np.uint8)
    if len(rows) < count * point.itemsize:
        raise CloudFileError(f"ends within its {count} vertices of {point.itemsize} bytes")
    return rows.view(point)


def _ply_header(file: IO[bytes]) -> tuple[np.dtype[np.void], int, str]:
    """The layout of a vertex, how many there are, and the form; vertices must come first, as they do."""
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
    return np.dtype(fields), count, form


def _ply_lines(file: IO[bytes]) -> Iterator[list[str]]:
    if file.readline(8).strip() != b"ply":
        raise CloudFileError("is no PLY: its first line is another")
    for _ in range(_MOST_HEADER_LINES):
        words = file.readline(4096).decode("ascii", "replace").split()
        if words == ["end_header"]:
            return
        yield words
    raise CloudFileError("is no PLY: its header does not end")


def _ros_type(kind: np.dtype[np.generic]) -> str:
    """The number type itself, little endian; ROS knows no whole numbers of 64 bits, which become float64."""
    return "<f8" if kind.itemsize == 8 else kind.newbyteorder("<").str.replace("|", "<")
