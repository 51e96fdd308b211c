"""Front end: odometry and the choice of keyframes, independent of the pose graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Points, Pose, Scan, State
from scanchain.odometry.odometry import Odometry
from scanchain.odometry.tracked import Tracked


@dataclass(frozen=True, slots=True)
class Located:
    """A scan as odometry placed it, with the state of odometry that the back end needs.

    ``scale`` is that of its voxels, ``local_map`` (L, d) its map, odom frame, empty unless ``is_keyframe``;
    ``first_points`` (M, d) are those of the first scan, which the second may have deskewed again.
    """

    tracked: Tracked
    is_keyframe: bool
    scale: float
    local_map: Points
    first_points: Points


class FrontEnd:
    """Odometry and keyframe selection, fed scan by scan; shares nothing with the back end."""

    def __init__(self, config: Config, T_base_lidar: Pose) -> None:
        self.config = config.odometry
        self.odometry = Odometry(config, T_base_lidar)
        self.T_odom_keyframe = lie.identity(self.odometry.dimension)
        self.scans = 0

    def locate(self, scan: Scan) -> Located:
        """Place one scan by odometry; it becomes a keyframe where it moved far enough from the last one."""
        tracked = self.odometry.process(scan)
        is_keyframe = not self.scans or tracked.elsewhere_m > 0.0 or self._moved_enough(tracked)
        self.scans += 1
        if is_keyframe:
            self.T_odom_keyframe = tracked.T_odom_lidar
        local_map = self.odometry.local_map
        return Located(
            tracked=tracked,
            is_keyframe=is_keyframe,
            scale=local_map.scale,
            local_map=local_map.points() if is_keyframe else np.empty((0, local_map.dimension)),
            first_points=self.odometry.first_points,
        )

    def _moved_enough(self, tracked: Tracked) -> bool:
        distance_m, angle_rad = lie.apart(self.T_odom_keyframe, tracked.T_odom_lidar)
        is_far = distance_m > self.config.keyframe_distance_m or angle_rad > self.config.keyframe_angle_rad
        return is_far and tracked.state is not State.LOST
