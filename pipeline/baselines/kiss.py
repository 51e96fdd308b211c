"""KISS-ICP (Vizzo et al. 2023) as a baseline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.baselines.at_stamp import AtStamp
from pipeline.baselines.baseline import finite, middle
from pipeline.data import Pose, RawPoints
from pipeline.errors import MissingExtraError

_DISTORTED = 2  # it deskews by the motion before, and has none for its first two scans


class KissIcp:
    """KISS-ICP with its defaults: voxels of max_range / 100, adaptive threshold, all threads."""

    def __init__(self, max_range_m: float = 100.0) -> None:
        try:
            from kiss_icp.config.parser import load_config
            from kiss_icp.kiss_icp import KissICP
        except ImportError:
            raise MissingExtraError("kiss-icp", "baselines") from None
        config = load_config(None)
        config.data.max_range = max_range_m
        config.mapping.voxel_size = max_range_m / 100.0
        self.description = (
            f"KISS-ICP, point-to-point scan to map, its defaults: max_range {max_range_m:g} m, min_range "
            f"{config.data.min_range:g} m, voxels of {config.mapping.voxel_size:g} m, all threads, its own "
            "deskewing where the log has times"
        )
        self.odometry = KissICP(config)
        self.at_stamp = AtStamp()
        self.scans = 0

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan; KISS-ICP's pose holds at the last point once it deskews, ours at the scan's stamp."""
        frame, times = finite(points, times_s)
        self.odometry.register_frame(frame, times)
        self.scans += 1
        held_s = middle(times) if self.scans <= _DISTORTED or not len(times) else float(times.max())
        return self.at_stamp.move(np.array(self.odometry.last_pose, np.float64), stamp_ns, held_s)
