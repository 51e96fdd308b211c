"""One cloud in a file, PCD, PLY or raw float32, as an array of points with named fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.logs.formats.pcd import read_pcd
from pipeline.logs.formats.ply import read_ply
from pipeline.logs.formats.point_rows import CloudFileError

SUFFIXES = (".pcd", ".ply", ".bin")
_XYZI = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])


def read_cloud_file(path: Path) -> NDArray[np.void]:
    """The points (N,) of a file as they are, little endian, in number types that ROS knows.

    Raises CloudFileError, and OSError where the file cannot be read.
    """
    readers = {".pcd": read_pcd, ".ply": read_ply, ".bin": read_xyzi}
    rows = readers[path.suffix.lower()](path)
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise CloudFileError(f"has no x, y and z, but {', '.join(names) or 'nothing'}")
    numbers = [name for name in names if not rows.dtype[name].shape]
    point = np.dtype([(name, _ros_type(rows.dtype[name])) for name in numbers])
    return rows[numbers].astype(point, copy=False)


def read_xyzi(path: Path) -> NDArray[np.void]:
    """The points of a file of float32 x, y, z, intensity, as KITTI and others write them."""
    size = path.stat().st_size
    if size % _XYZI.itemsize:
        raise CloudFileError(f"has {size} bytes, not a multiple of the {_XYZI.itemsize} of x, y, z, intensity")
    return np.fromfile(path, _XYZI)


def _ros_type(kind: np.dtype[np.generic]) -> str:
    """The number type itself, little endian; ROS knows no whole numbers of 64 bits, which become float64."""
    return "<f8" if kind.itemsize == 8 else kind.newbyteorder("<").str.replace("|", "<")
