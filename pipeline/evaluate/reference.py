"""Ground truth from a file, in either of the formats that it comes in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Trajectory
from pipeline.errors import InputError
from pipeline.trajectory import read_kitti, read_tum, text_lines

_KITTI_FIELDS = 12


def read_reference(path: Path, stamps_ns: NDArray[np.int64]) -> Trajectory:
    """Poses of the lidar from a TUM file, or from a KITTI file, whose k-th line is the k-th scan's.

    stamps_ns : (N,) of the scans, which a KITTI file does not know
    """
    first = next(iter(text_lines(path)), None)
    if first is None or len(first[1]) != _KITTI_FIELDS:
        return read_tum(path)
    reference = read_kitti(path)
    if len(reference) != len(stamps_ns):
        raise InputError(
            f"{path}: has {len(reference)} lines, the log {len(stamps_ns)} scans; a KITTI file has one a scan, or "
            "give a TUM file, which has stamps"
        )
    return Trajectory(stamps_ns, reference.poses)
