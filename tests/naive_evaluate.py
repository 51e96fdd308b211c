"""Slow, clear twins of the trajectory metrics."""

import math
from itertools import pairwise

import numpy as np


def nearest(wanted, stamps):
    """First index of the nearest stamp; of two equally far ones the earlier in time."""
    return [min(range(len(stamps)), key=lambda i: (abs(stamps[i] - w), stamps[i], i)) for w in wanted]


def travelled(poses):
    lengths = [0.0]
    for a, b in pairwise(poses):
        lengths.append(lengths[-1] + math.dist(a[:3, 3], b[:3, 3]))
    return lengths


def angle(R):
    return math.acos(max(-1.0, min(1.0, 0.5 * (np.trace(R) - 1.0))))


def kitti(reference, estimate, lengths_m, every):
    """Translational share and rad/m of every stretch, as the benchmark's description has it."""
    path = travelled(reference)
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
