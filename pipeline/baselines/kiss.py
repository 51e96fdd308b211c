"""KISS-ICP (Vizzo et al. 2023) as a baseline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.baselines.baseline import finite
from pipeline.data import Pose, RawPoints
from pipeline.errors import MissingExtraError


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
        self.max_range_m = max_range_m
        self.odometry = KissICP(config)

    @property
    def description(self) -> str:
        """What it does and with which parameters."""
        return (
            f"KISS-ICP, point-to-point scan to map, max_range {self.max_range_m:g} m, its defaults, "
            "its own deskewing where the log has times"
        )

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan; KISS-ICP's pose holds at the last point, ours at the scan's stamp."""
        frame, times = finite(points, times_s)
        self.odometry.register_frame(frame, times)
        T_odom_end = np.array(self.odometry.last_pose, np.float64)
        if not len(times):
            return T_odom_end
        share = float(times.max() / np.ptp(times))
        T_previous_current = np.asarray(self.odometry.last_delta, np.float64)
        return T_odom_end @ lie.exp(-share * lie.log(T_previous_current))
