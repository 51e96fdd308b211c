"""Point clouds as PLY, PCD and LAZ; 2D ones lie in the plane z = 0.

PLY: Turk 1994. PCD: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. LAZ by laspy.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Points
from scanchain.errors import InputError

_PLY = """ply
format binary_little_endian 1.0
comment scanchain, meters, world frame
element vertex {count}
property float x
property float y
property float z
end_header
"""

_PCD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""
_SCALE_M = 0.001  # LAZ holds whole multiples of it


def write_ply(path: Path | str, points: Points) -> None:
    """Write points (N, d) as binary little-endian PLY of float32."""
    Path(path).write_bytes(_PLY.format(count=len(points)).encode("ascii") + as_rows(points).tobytes())


def write_pcd(path: Path | str, points: Points) -> None:
    """Write points (N, d) as binary PCD of float32."""
    Path(path).write_bytes(_PCD.format(count=len(points)).encode("ascii") + as_rows(points).tobytes())


def write_laz(path: Path | str, points: Points) -> None:
    """Write points (N, d) as LAZ 1.4, to the millimeter."""
    import laspy

    rows = np.zeros((len(points), 3))
    rows[:, : points.shape[1]] = points
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.generating_software = "scanchain"
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(rows.min(axis=0)) if len(rows) else np.zeros(3)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = rows.T
    cloud.write(str(path))


def read_ply(path: Path | str) -> Points:
    """Points (N, 3) of a file that ``write_ply`` wrote. Raises InputError for one that is not."""
    try:
        header, found, body = Path(path).read_bytes().partition(b"end_header\n")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); scanchain run writes it") from error
    count = len(body) // 12
    if not found or (header + found).decode("latin-1") != _PLY.format(count=count) or len(body) % 12:
        raise InputError(f"{path}: is not a PLY file as scanchain writes it; run it again")
    return np.frombuffer(body, "<f4").reshape(-1, 3).astype(np.float64)


def as_rows(points: Points) -> NDArray[np.float32]:
    """Points (N, d) as (N, 3) little-endian float32, 2D ones at height 0."""
    rows = np.zeros((len(points), 3), "<f4")
    rows[:, : points.shape[1]] = points
    return rows
