"""Which way is up around a keyframe: the ground says so, whatever the lidar's tilt."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.data import Keyframe, Pose
from scanchain.kernels.voxels.voxel_shapes import DIRECTION, PLANE, SHAPE
from scanchain.registration import VoxelMap

_CONES = (0.85, 0.97)  # cosines: normals nearer to the axis than this are the ground's, roughly and finally
_ENOUGH = 10  # voxels with such a normal


def level_frame(keyframe: Keyframe, config: LocalMapConfig) -> Pose:
    """T_keyframe_level (4, 4), the frame at the same place whose z axis is normal to the ground.

    The ground is what is flat and lies at less than 32° to the lidar's own horizon; where there is too little of
    it, the lidar is taken to stand upright. The x axis is as near to the lidar's as it can be.
    """
    voxels = VoxelMap(3, config, keyframe.scale)
    voxels.insert(keyframe.points, lie.identity(3))
    cells = voxels.voxels.cells[: len(voxels)]
    normals = cells[cells[:, SHAPE] == PLANE, DIRECTION : DIRECTION + 3]
    up = np.array([0.0, 0.0, 1.0])
    for cosine in _CONES:
        along = normals @ up
        chosen = np.abs(along) > cosine
        if chosen.sum() < _ENOUGH:
            break
        up = _unit((normals[chosen] * np.sign(along[chosen])[:, None]).sum(axis=0))
    T = lie.identity(3)
    forward = _unit(np.array([1.0, 0.0, 0.0]) - up[0] * up)
    T[:3, 0], T[:3, 1], T[:3, 2] = forward, np.cross(up, forward), up
    return T


def _unit(v: NDArray[np.float64]) -> NDArray[np.float64]:
    return v / np.linalg.norm(v)
