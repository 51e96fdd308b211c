"""Point clouds as PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.data import Points

_HEADER = """ply
format binary_little_endian 1.0
comment scanchain, metres, world frame
element vertex {count}
property float x
property float y
property float z
end_header
"""


def write_ply(path: Path | str, points: Points) -> None:
    """Write points (N, d) as binary little-endian PLY (Turk 1994) of float32; 2D ones lie in the plane z = 0."""
    rows = np.zeros((len(points), 3), "<f4")
    rows[:, : points.shape[1]] = points
    with Path(path).open("wb") as file:
        file.write(_HEADER.format(count=len(points)).encode("ascii"))
        file.write(rows.tobytes())
