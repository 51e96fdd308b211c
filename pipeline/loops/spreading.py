"""Corrections of keyframes spread over all scans."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix


def spread(T_world_keyframes: Matrix, numbers: NDArray[np.int64], odometry: Matrix) -> Matrix:
    """World poses (N, d+1, d+1) of all scans: each keyframe's correction, blended between it and the next.

    numbers : (K,) of the scans that are keyframes, the first of them 0; odometry : (N, d+1, d+1) T_odom_lidar
    """
    following = np.append(np.arange(1, len(numbers)), -1)
    relative = lie.between(odometry[numbers], odometry[numbers[following]])
    target = lie.between(T_world_keyframes, T_world_keyframes[following])
    correction = lie.log(target @ lie.inverse(relative))
    before = np.searchsorted(numbers, np.arange(len(odometry)), side="right") - 1
    span = np.append(np.diff(numbers), 1)[before]
    share = np.clip((np.arange(len(odometry)) - numbers[before]) / span, 0.0, 1.0)
    within = lie.between(odometry[numbers[before]], odometry)
    return T_world_keyframes[before] @ lie.exp(share[:, None] * correction[before]) @ within
