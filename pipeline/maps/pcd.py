"""Point clouds as PCD files. Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html."""

from __future__ import annotations

from pathlib import Path

from scanchain.data import Points
from scanchain.maps.ply import as_rows

_HEADER = """# .PCD v0.7 - Point Cloud Data file format
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


def write_pcd(path: Path | str, points: Points) -> None:
    """Write points (N, d) as binary PCD of float32; 2D ones lie in the plane z = 0."""
    with Path(path).open("wb") as file:
        file.write(_HEADER.format(count=len(points)).encode("ascii"))
        file.write(as_rows(points).tobytes())
