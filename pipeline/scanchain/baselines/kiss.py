"""KISS-ICP (Vizzo et al. 2023) as a baseline."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from scanchain.baselines.baseline import AtStamp, finite, middle
from scanchain.config import Count, NonNegative, Positive
from scanchain.data import Pose, RawPoints
from scanchain.errors import MissingExtraError

_DISTORTED = 2  # it deskews by the motion before, and has none for its first two scans


class KissSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Its defaults; its own rule for voxels is a hundredth of the largest range. Threads: 0 are all."""

    min_range_m: NonNegative = 0.0
    max_range_m: Positive = 100.0
    voxel_size_m: Positive = 1.0
    max_points_per_voxel: Count = 20
    max_iterations: Count = 500
    threads: Annotated[int, Meta(ge=0)] = 0


KISS = KissSettings()
PLANAR_KISS = KissSettings(max_range_m=40.0, voxel_size_m=0.4)


class KissIcp:
    """KISS-ICP: point-to-point, scan to map, adaptive threshold."""

    def __init__(self, settings: KissSettings = KISS) -> None:
        try:
            from kiss_icp.config.parser import load_config
            from kiss_icp.kiss_icp import KissICP
        except ImportError:
            raise MissingExtraError("kiss-icp", "baselines") from None
        config = load_config(None)
        config.data.min_range, config.data.max_range = settings.min_range_m, settings.max_range_m
        config.mapping.voxel_size = settings.voxel_size_m
        config.mapping.max_points_per_voxel = settings.max_points_per_voxel
        config.registration.max_num_iterations = settings.max_iterations
        config.registration.max_num_threads = settings.threads
        self.description = (
            f"KISS-ICP, point-to-point scan to map, {settings.min_range_m:g} to {settings.max_range_m:g} m, "
            f"voxels of {settings.voxel_size_m:g} m, {settings.threads or 'all'} threads, its own deskewing where "
            "the log has times"
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
