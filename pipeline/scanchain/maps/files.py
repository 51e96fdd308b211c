"""Files of maps: point clouds as PLY, PCD and LAZ, occupancy grids as the map.pgm and map.yaml of map_server.

PLY: Turk 1994. PCD: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. LAZ by laspy, whose
decoder aborts or hangs on damage and so runs in its own process: ``python -m scanchain.maps.files FILE POINTS``.
2D points are written with z = 0.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from enum import IntEnum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Points
from scanchain.errors import InputError, one_line
from scanchain.maps.occupancy_grid import FREE_PROBABILITY, OCCUPIED_PROBABILITY, OccupancyGrid
from scanchain.processes import KilledFor, die_first, die_with_parent, reading_limits, run_within

if TYPE_CHECKING:
    from pyproj import CRS

_PLY_TYPES = {"f4": "float", "u1": "uchar", "i4": "int"}
_PLY_COMMENT = "scanchain, meters, world frame"
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
STEP_M = 0.001  # of coordinates on disk; of keyframes that reach farther than 33 m it is larger

_PGM = re.compile(rb"P5\n(\d+) (\d+)\n255\n(.*)", re.DOTALL)


class Pixel(IntEnum):
    """Pixels of ROS's map_saver."""

    OCCUPIED = 0
    UNKNOWN = 205
    FREE = 254


# Thresholds that select exactly these three pixels, p = (255 − pixel) / 255, as nav2's own saver writes them: with
# the common free_thresh 0.25 the unknown pixel, p = 0.196, would be read as free.
_YAML = """image: map.pgm
mode: trinary
resolution: {resolution_m!r}
origin: [{x_m:.9g}, {y_m:.9g}, 0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
_NUMBER = r"(-?\d{1,15}(?:\.\d+)?(?:e[+-]\d\d)?)"
_YAML_NUMBERS = re.compile(rf"resolution: {_NUMBER}\norigin: \[{_NUMBER}, {_NUMBER}, 0\]")


def write_ply(
    path: Path | str, points: Points, columns: Mapping[str, NDArray] | None = None, comment: str = _PLY_COMMENT
) -> None:
    """Write points (N, d) as binary little-endian PLY of float32, with further columns (N,) of u1 or i4."""
    named = dict(zip("xyz", _in_space(points).T, strict=True)) | dict(columns or {})
    rows = np.empty(len(points), [(name, values.dtype) for name, values in named.items()])
    for name, values in named.items():
        rows[name] = values
    Path(path).write_bytes(_ply_header(len(rows), rows.dtype, comment).encode("ascii") + rows.tobytes())


def read_ply(path: Path | str) -> Points:
    """Points (N, 3) of a file that ``write_ply`` wrote. Raises InputError for one that is not."""
    try:
        header, found, body = Path(path).read_bytes().partition(b"end_header\n")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); scanchain run writes it") from error
    dtype = np.dtype([(axis, "<f4") for axis in "xyz"])
    count, rest = divmod(len(body), dtype.itemsize)
    if not found or rest or (header + found).decode("latin-1") != _ply_header(count, dtype, _PLY_COMMENT):
        raise InputError(f"{path}: is not a PLY file as scanchain writes it; run it again")
    return np.frombuffer(body, "<f4").reshape(-1, 3).astype(np.float64)


def write_pcd(path: Path | str, points: Points) -> None:
    """Write points (N, d) as binary PCD of float32."""
    Path(path).write_bytes(_PCD.format(count=len(points)).encode("ascii") + _in_space(points).tobytes())


def write_laz(path: Path | str, points: Points, crs: CRS | None = None) -> None:
    """Write points (N, d) as LAZ 1.4, to the millimeter, in a coordinate reference system."""
    import laspy

    rows = lie.lift_points(points)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.generating_software = "scanchain"
    header.scales = np.full(3, STEP_M)
    header.offsets = np.floor(rows.min(axis=0)) if len(rows) else np.zeros(3)
    if crs is not None:
        header.add_crs(crs)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = rows.T
    cloud.write(str(path))


def read_las(path: Path) -> Points:
    """Points (N, 3) of a LAS or LAZ file. Raises InputError for a damaged one, OSError where it is absent."""
    limits = reading_limits(path)
    with TemporaryDirectory(prefix="scanchain-") as folder:
        points, output = Path(folder) / "points.npy", Path(folder) / "output.txt"
        words = [str(path.resolve()), str(points)]
        ending = run_within(limits, "scanchain.maps.files", words, os.environ, output=output)
        if ending.killed_for is KilledFor.NOTHING and ending.code == 0:
            return np.load(points)
        lines = output.read_text("utf-8", "replace").splitlines()
        last = next((line for line in reversed(lines) if not line.startswith("note:")), "")
        reason = ending.reason(limits, last)
        if ending.killed_for is not KilledFor.NOTHING:
            reason = f"decoding it takes over {limits.time_s:.0f} s or {limits.memory_mib:,.0f} MiB"
    raise InputError(f"{path}: is no LAS or LAZ file that can be read ({reason}); copy or write it again")


def _decode_las(path: Path, points: Path) -> None:
    """Write the points of a LAS or LAZ file to a .npy file: the work of the decoding process."""
    import laspy

    die_first()
    die_with_parent()
    try:
        np.save(points, np.asarray(laspy.read(path).xyz, np.float64))
    except Exception as error:  # whatever a damaged file makes laspy and its decoder raise
        sys.exit(f"{type(error).__name__}: {one_line(error)}")


def write_map(folder: Path | str, grid: OccupancyGrid) -> None:
    """Write ``map.pgm`` and ``map.yaml`` as nav2's map_server and ROS 1's read them.

    ``origin`` is the pose (x, y, yaw) of the outer corner of the image's lower left pixel. Black pixels are
    occupied, white ones free, gray ones unknown; an empty grid becomes a single unknown pixel.
    """
    probability = grid.probability() if grid.log_odds.size else np.full((1, 1), 0.5)
    image = np.full(probability.shape, Pixel.UNKNOWN, np.uint8)
    image[probability > OCCUPIED_PROBABILITY] = Pixel.OCCUPIED
    image[probability < FREE_PROBABILITY] = Pixel.FREE
    rows, columns = image.shape
    (Path(folder) / "map.pgm").write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + image[::-1].tobytes())
    x_m, y_m = grid.origin_m.tolist()
    text = _YAML.format(resolution_m=float(grid.resolution_m), x_m=x_m, y_m=y_m)
    (Path(folder) / "map.yaml").write_text(text, encoding="utf-8", newline="\n")


def read_map(folder: Path | str) -> tuple[NDArray[np.int8], float, tuple[float, float]]:
    """Cells (rows, columns) of a map that ``write_map`` wrote, the resolution in meters and the origin's x, y.

    Cells are 0 free, 100 occupied, −1 unknown; row 0 has the lowest y. Raises InputError where a file is missing
    or was not written by ``write_map``.
    """
    folder = Path(folder)
    try:
        image = _PGM.fullmatch((folder / "map.pgm").read_bytes())
        header = _YAML_NUMBERS.search((folder / "map.yaml").read_text("utf-8", "replace"))
    except OSError as error:
        raise InputError(
            f"{error.filename}: cannot be read ({error.strerror}); scanchain run writes it"
        ) from error
    if image is None or header is None or float(header[1]) <= 0.0:
        raise InputError(f"{folder}: map.pgm or map.yaml is not as scanchain writes them; run it again")
    columns, rows = int(image[1]), int(image[2])
    pixels = np.frombuffer(image[3], np.uint8)
    if len(pixels) != rows * columns:
        raise InputError(f"{folder / 'map.pgm'}: has {len(pixels)} pixels instead of {rows} × {columns}")
    cells = (
        np.select([pixels == Pixel.FREE, pixels == Pixel.OCCUPIED], [0, 100], -1)
        .astype(np.int8)
        .reshape(rows, columns)
    )
    resolution_m, x_m, y_m = (float(number) for number in header.groups())
    return np.ascontiguousarray(cells[::-1]), resolution_m, (x_m, y_m)


def _ply_header(count: int, dtype: np.dtype, comment: str) -> str:
    properties = "".join(f"property {_PLY_TYPES[dtype[name].str[1:]]} {name}\n" for name in dtype.names or ())
    comments = "".join(f"comment {line}\n" for line in comment.split("\n"))
    return f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {count}\n{properties}end_header\n"


def _in_space(points: Points) -> NDArray[np.float32]:
    """Points (N, d) as (N, 3) little-endian float32."""
    return lie.lift_points(points).astype("<f4")


if __name__ == "__main__":
    _decode_las(*map(Path, sys.argv[1:]))
