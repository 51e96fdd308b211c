"""Occupancy grids as files that navigation stacks read: map.pgm with map.yaml, and PNG."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.maps.occupancy_grid import FREE_PROBABILITY, OCCUPIED_PROBABILITY, OccupancyGrid

OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # pixels of ROS's map_saver

# Thresholds that sort exactly these three pixels, p = (255 − pixel) / 255, as nav2's own saver writes them: with
# the common free_thresh 0.25 the unknown pixel, p = 0.196, would be read as free.
_YAML = """image: {image}
mode: trinary
resolution: {resolution_m!r}
origin: [{x_m:.9g}, {y_m:.9g}, 0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def grid_image(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """(rows, columns) pixels, the row of largest y first: black occupied, white free, grey unknown."""
    probability = grid.probability()
    image = np.full(probability.shape, UNKNOWN, np.uint8)
    image[probability > OCCUPIED_PROBABILITY] = OCCUPIED
    image[probability < FREE_PROBABILITY] = FREE
    return np.ascontiguousarray(image[::-1])


def write_map(folder: Path | str, grid: OccupancyGrid) -> None:
    """Write ``map.pgm`` and ``map.yaml`` as nav2's map_server and ROS 1's read them.

    ``origin`` is the pose (x, y, yaw) of the outer corner of the image's lower left pixel. An empty grid becomes
    a single unknown pixel.
    """
    folder = Path(folder)
    image = grid_image(grid) if grid.log_odds.size else np.full((1, 1), UNKNOWN, np.uint8)
    rows, columns = image.shape
    (folder / "map.pgm").write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + image.tobytes())
    text = _YAML.format(
        image="map.pgm",
        resolution_m=float(grid.resolution_m),
        x_m=float(grid.origin_m[0]),
        y_m=float(grid.origin_m[1]),
    )
    (folder / "map.yaml").write_text(text, encoding="utf-8", newline="\n")


def write_png(path: Path | str, image: NDArray[np.uint8]) -> None:
    """Write a grey image (rows, columns) as PNG (ISO/IEC 15948), filter 0 on every row."""
    rows, columns = image.shape
    filtered = np.zeros((rows, columns + 1), np.uint8)
    filtered[:, 1:] = image
    header = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 6)), (b"IEND", b""))
    Path(path).write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(name, body) for name, body in chunks))


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
