"""Point clouds as LAZ files, by laspy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanchain.data import Points

_SCALE_M = 0.001  # LAZ holds whole multiples of it


def write_laz(path: Path | str, points: Points) -> None:
    """Write points (N, d) as LAZ 1.4, to the millimeter; 2D ones lie in the plane z = 0."""
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
