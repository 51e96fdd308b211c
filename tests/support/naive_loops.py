"""Slow, clear twins of the loop-closure kernels; every kernel test says fast == naive."""

from itertools import pairwise

import numpy as np

from scanchain import lie
from scanchain.kernels.registration.icp import CONVERGED, align, problem_of


def bin_of(point, shape):
    range_m = np.linalg.norm(point)
    row = int((np.arcsin(point[2] / range_m) / np.pi + 0.5) * shape[0])
    column = int((np.arctan2(point[1], point[0]) / (2 * np.pi) + 0.5) * shape[1])
    return (min(row, shape[0] - 1), min(column, shape[1] - 1)), range_m


def agreement(seen, points, T, shape, margin_m, margin_share):
    """Points that lie where the lidar saw something, and points that it looked through."""
    nearest = {}
    for point in seen:
        place, range_m = bin_of(point, shape)
        nearest[place] = min(nearest.get(place, np.inf), range_m)
    yes = no = 0
    for point in lie.transform(T, points):
        place, range_m = bin_of(point, shape)
        if place in nearest:
            margin = margin_m + margin_share * nearest[place]
            yes += abs(range_m - nearest[place]) <= margin
            no += range_m < nearest[place] - margin
    return yes, no


def refine(voxels, points, starts, poses, prior, least_share, settings):
    """Each scan aligned by itself."""
    for k, (first, last) in enumerate(pairwise(starts)):
        T = poses[k].copy()
        scan = points[first:last]
        problem = problem_of(voxels, scan, T, prior, settings)
        fit = align(problem, T, np.zeros(len(prior)), settings.first_scale_m)
        if fit.ending == CONVERGED and fit.pairs >= least_share * (last - first):
            poses[k] = T
