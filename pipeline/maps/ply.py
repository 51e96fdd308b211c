"""Point clouds as PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Points
from scanchain.errors import InputError

_HEADER = """ply
format binary_little_endian 1.0
comment scanchain, meters, world frame
element vertex {count}
property float x
property float y
property float z
end_header
"""


def write_ply(path: Path | str, points: Points) -> None:
    """Write points (N, d) as binary little-endian PLY (Turk 1994) of float32; 2D ones lie in the plane z = 0."""
    with Path(path).open("wb") as file:
        file.write(_HEADER.format(count=len(points)).encode("ascii"))
        file.write(as_rows(points).tobytes())


def as_rows(points: Points) -> NDArray[np.float32]:
    """Points (N, d) as (N, 3) little-endian float32, 2D ones at height 0."""
    rows = np.zeros((len(points), 3), "<f4")
    rows[:, : points.shape[1]] = points
    return rows


def read_ply(path: Path | str) -> Points:
    """Points (N, 3) of a file that ``write_ply`` wrote. Raises InputError for one that is not."""
    try:
        header, found, body = Path(path).read_bytes().partition(b"end_header\n")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); scanchain run writes it") from error
    count = len(body) // 12
    if not found or (header + found).decode("latin-1") != _HEADER.format(count=count) or len(body) % 12:
        raise InputError(f"{path}: is not a PLY file as scanchain writes it; run it again")
    return np.frombuffer(body, "<f4").reshape(-1, 3).astype(np.float64)
