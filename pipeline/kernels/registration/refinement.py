"""Many scans aligned to one map, each from where it is and held there where the map tells nothing."""

import numpy as np
from numba import njit

from scanchain.kernels.registration.icp import CONVERGED, align
from scanchain.kernels.registration.match import root_mean_square_range


@njit(cache=True, nogil=True)
def refine(voxels, points, starts, poses, prior, least_share, terms):
    """Move every pose, in place, to where its scan fits the map; where it does not fit, the pose stays.

    points : (N, d) meters of all scans, each in its own lidar frame; starts : (K + 1,) scan k is points[starts[k]
    : starts[k + 1]]; poses : (K, d+1, d+1)
    prior : (k, k) information of each pose as it is, twists along the map's axes, times the variance of a residual
    least_share : of a scan's points that find a partner, below which it does not fit
    """
    away = np.zeros(prior.shape[0])
    for k in range(poses.shape[0]):
        scan = points[starts[k] : starts[k + 1]]
        T = poses[k].copy()
        range_m = root_mean_square_range(scan)
        outcome = align(voxels, scan, T, away, prior, range_m, terms.first_scale_m, terms)
        if outcome.ending == CONVERGED and outcome.pairs >= least_share * scan.shape[0]:
            for i in range(T.shape[0]):
                for j in range(T.shape[0]):
                    poses[k, i, j] = T[i, j]
