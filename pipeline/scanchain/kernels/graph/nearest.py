"""The pose nearest to another, of all or of the first pass near it."""

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


@njit(nogil=True)
def on_first_pass(poses, pose, chosen, reach_m, turned_rad):
    """Index of the pose where the first pass that came near another was nearest, and its distance in meters.

    poses (K, 3, 3) in the order of the path, chosen (K,); near is within ``reach_m`` and turned by at most
    ``turned_rad``. −1 and infinity where none is.
    """
    best, least = -1, reach_m**2
    for k in range(poses.shape[0]):
        squared = (poses[k, 0, 2] - pose[0, 2]) ** 2 + (poses[k, 1, 2] - pose[1, 2]) ** 2
        turned = poses[k, 0, 0] * pose[0, 0] + poses[k, 1, 0] * pose[1, 0]
        if chosen[k] and squared <= least and turned >= np.cos(turned_rad):
            best, least = k, squared
        elif best >= 0:
            break
    return best, np.sqrt(least) if best >= 0 else np.inf
