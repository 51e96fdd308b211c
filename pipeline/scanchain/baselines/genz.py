"""GenZ-ICP (Lee et al. 2025) as a baseline."""

from __future__ import annotations

from typing import Literal

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from scanchain.baselines.baseline import AtStamp, finite, middle
from scanchain.data import Pose, RawPoints
from scanchain.errors import MissingExtraError

Preset = Literal["outdoor", "indoor", "kitti"]

# What its outdoor.yaml, indoor.yaml and kitti.yaml say beside its defaults.
_DATA = {"outdoor": {"min_range": 0.5}, "indoor": {"min_range": 0.3}, "kitti": {"min_range": 5.0}}
_OUTDOOR = {"voxel_size": 0.6, "desired_num_voxelized_points": 3000, "max_points_per_voxel": 3}
_MAPPING = {"outdoor": _OUTDOOR, "indoor": {}, "kitti": _OUTDOOR | {"planarity_threshold": 0.18}}


class GenzSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Preset of its authors, by kind of environment."""

    preset: Preset = "outdoor"


GENZ = GenzSettings()


class GenzIcp:
    """GenZ-ICP with a preset of its authors.

    It lets its voxels grow and shrink until a scan has the desired number of points, and keeps their size in a
    static variable: a second odometry in the same process starts with the voxel size of the first.
    """

    def __init__(self, settings: GenzSettings = GENZ) -> None:
        preset = settings.preset
        try:
            from genz_icp.config import load_config
            from genz_icp.genz_icp import GenZICP
        except ImportError:
            raise MissingExtraError("genz-icp", "baselines") from None
        config = load_config(None)
        config.data = config.data.model_copy(update={"deskew": True} | _DATA[preset])
        config.mapping = config.mapping.model_copy(update=_MAPPING[preset])
        self.description = (
            f"GenZ-ICP, planes and points, scan to map, its {preset}.yaml: {config.data.min_range:g} to "
            f"{config.data.max_range:g} m, voxels of {config.mapping.voxel_size:g} m, about "
            f"{config.mapping.desired_num_voxelized_points} points a scan, all threads; its own deskewing, off in "
            "that file, on where the log has times"
        )
        self.odometry = GenZICP(config)
        self.at_stamp = AtStamp()

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan; GenZ-ICP wants times from 0 to 1 and its pose holds at 0.5, ours at the stamp."""
        frame, times = finite(points, times_s)
        share = (times - times.min()) / np.ptp(times) if len(times) else times
        self.odometry.register_frame(frame, share)
        return self.at_stamp.move(np.array(self.odometry.last_pose, np.float64), stamp_ns, middle(times))
