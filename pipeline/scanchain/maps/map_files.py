"""Occupancy grids as files that navigation stacks read: map.pgm with map.yaml."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.errors import InputError
from scanchain.maps.occupancy_grid import FREE_PROBABILITY, OCCUPIED_PROBABILITY, OccupancyGrid

_PGM = re.compile(rb"P5\n(\d+) (\d+)\n255\n(.*)", re.DOTALL)
_YAML_NUMBERS = re.compile(r"resolution: (\S+)\norigin: \[(\S+), (\S+), 0\]")
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
    """(rows, columns) pixels, the row of largest y first: black occupied, white free, gray unknown."""
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


def read_map(folder: Path | str) -> tuple[NDArray[np.int8], float, tuple[float, float]]:
    """Cells (rows, columns) of a map that ``write_map`` wrote, the resolution in meters and the origin's x, y.

    Cells are 0 free, 100 occupied, −1 unknown; row 0 has the lowest y. Raises InputError where a file is missing
    or of another make.
    """
    folder = Path(folder)
    try:
        image = _PGM.fullmatch((folder / "map.pgm").read_bytes())
        header = _YAML_NUMBERS.search((folder / "map.yaml").read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{error.filename}: cannot be read ({error.strerror}); scanchain run writes it"
        ) from error
    if image is None or header is None:
        raise InputError(f"{folder}: map.pgm or map.yaml is not as scanchain writes them; run it again")
    columns, rows = int(image[1]), int(image[2])
    pixels = np.frombuffer(image[3], np.uint8)
    if len(pixels) != rows * columns:
        raise InputError(f"{folder / 'map.pgm'}: has {len(pixels)} pixels instead of {rows} × {columns}")
    cells = np.select([pixels == FREE, pixels == OCCUPIED], [0, 100], -1).astype(np.int8).reshape(rows, columns)
    resolution_m, x_m, y_m = (float(number) for number in header.groups())
    return np.ascontiguousarray(cells[::-1]), resolution_m, (x_m, y_m)
