"""Slow, clear twins of the trajectory metrics."""

import math
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp


def nearest(wanted, stamps):
    """First index of the nearest stamp; of two equally far ones the earlier in time."""
    return [min(range(len(stamps)), key=lambda i: (abs(stamps[i] - w), stamps[i], i)) for w in wanted]


def interpolated(stamp, stamps, poses, gap):
    """The pose at a stamp, or None where there is none: exact, or between its neighbors by quaternions."""
    if stamp in stamps:
        return poses[list(stamps).index(stamp)]
    earlier, later = [s for s in stamps if s < stamp], [s for s in stamps if s > stamp]
    if not earlier or not later or min(later) - max(earlier) > gap:
        return None
    a, b = list(stamps).index(max(earlier)), list(stamps).index(min(later))
    share = float(stamp - stamps[a]) / float(stamps[b] - stamps[a])
    pose = np.eye(4)
    turns = Slerp([0.0, 1.0], Rotation.from_matrix([poses[a][:3, :3], poses[b][:3, :3]]))
    pose[:3, :3] = turns(share).as_matrix()
    pose[:3, 3] = (1.0 - share) * poses[a][:3, 3] + share * poses[b][:3, 3]
    return pose


def traveled(poses):
    lengths = [0.0]
    for a, b in pairwise(poses):
        lengths.append(lengths[-1] + math.dist(a[:3, 3], b[:3, 3]))
    return lengths


def angle(R):
    return math.acos(max(-1.0, min(1.0, 0.5 * (np.trace(R) - 1.0))))


def kitti(reference, estimate, lengths_m, every):
    """Translational share and rad/m of every stretch, as the benchmark's description has it."""
    path = traveled(reference)
    shares, turns = [], []
    for length in lengths_m:
        for first in range(0, len(reference), every):
            last = next((i for i in range(first, len(path)) if path[i] > path[first] + length), None)
            if last is None:
                continue
            truth = np.linalg.inv(reference[first]) @ reference[last]
            result = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(result) @ truth
            shares.append(np.linalg.norm(error[:3, 3]) / length)
            turns.append(angle(error[:3, :3]) / length)
    return shares, turns


def relation_2d(first, second, relation):
    """Translational and rotational error of planar poses (x, y, yaw) against a relation (x, y, yaw)."""
    dx, dy = second[0] - first[0], second[1] - first[1]
    c, s = math.cos(first[2]), math.sin(first[2])
    x, y = c * dx + s * dy, -s * dx + c * dy
    turn = second[2] - first[2] - relation[2]
    return math.hypot(x - relation[0], y - relation[1]), abs(math.atan2(math.sin(turn), math.cos(turn)))
