"""Whether two local maps agree about what is free: no surface of one where the other looked through."""

from __future__ import annotations

import numpy as np

from scanchain import lie
from scanchain.data import Points, Pose
from scanchain.kernels.raycast.free_space import compare_ranges, nearest_ranges
from scanchain.loops.local_map import LocalMap

_VIEWS = 8  # of each map that are held against the other
_BINS = (90, 180)  # of elevation and azimuth: 2°
_MARGIN_SHARE = 0.05  # of a range, by which it may differ in any case


def free_space_agreement(surroundings: LocalMap, points: Points, T_target_source: Pose, margin_m: float) -> float:
    """Share, of the source's points that the target's lidar could see, that lie where it did see a surface.

    points : (N, 3) meters, source's frame; margin_m : by which ranges may differ. 1 where nothing was in sight.
    """
    ranges_m = np.empty(_BINS)
    agreeing = contradicting = 0
    for T_target_lidar, seen in surroundings.views(_VIEWS):
        nearest_ranges(seen, ranges_m)
        T_lidar_source = lie.between(T_target_lidar, T_target_source)
        yes, no = compare_ranges(points, T_lidar_source, ranges_m, margin_m, _MARGIN_SHARE)
        agreeing, contradicting = agreeing + yes, contradicting + no
    return agreeing / max(agreeing + contradicting, 1) if agreeing + contradicting else 1.0
