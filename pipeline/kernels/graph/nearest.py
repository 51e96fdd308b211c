"""The pose nearest to another."""

import numpy as np

from scanchain.kernels.compiling import njit


@njit(nogil=True)
def nearest_position(poses, pose, chosen):
    """Index of the pose (K, d+1, d+1) whose position is nearest, of those chosen (K,), and its distance in meters.

    −1 and infinity where none is chosen.
    """
    d = pose.shape[0] - 1
    best, least = -1, np.inf
    for k in range(poses.shape[0]):
        if not chosen[k]:
            continue
        squared = 0.0
        for axis in range(d):
            squared += (poses[k, axis, d] - pose[axis, d]) ** 2
        if squared < least:
            best, least = k, squared
    return best, np.sqrt(least)
