"""A matcher of your own: point-to-point ICP, named on the command line as my_matcher:PointToPoint."""

import numpy as np
from scipy.spatial import KDTree

from scanchain import Match, rigid_transform


class PointToPoint:
    """Point-to-point ICP to the means of the map's voxels (Besl & McKay 1992)."""

    def __init__(self, config):
        self.config = config

    def align(self, points, target, T_first, prior=None, *, wide=False):
        limit_m = self.config.wide_max_distance_m if wide else self.config.max_distance_m
        means, T, d = target.points(), T_first, points.shape[1]
        tree, paired, distance_m = KDTree(means), np.zeros(0, bool), np.zeros(0)
        for _ in range(self.config.max_iterations):
            moved = points @ T[:d, :d].T + T[:d, d]
            distance_m, nearest = map(np.asarray, tree.query(moved, distance_upper_bound=limit_m))
            paired = np.isfinite(distance_m)
            if paired.sum() < 10:
                break
            correction = rigid_transform(moved[paired], means[nearest[paired]])
            T = correction @ T
            if np.abs(correction - np.eye(d + 1)).max() < self.config.tolerance_m:
                break
        inliers, k = int(paired.sum()), 3 * (d - 1)
        is_good = inliers > self.config.min_inlier_share * len(points)
        return Match(
            T_target_source=T,
            information=np.eye(k) * inliers / self.config.sensor_noise_m**2,
            cost=float(np.square(np.minimum(distance_m, limit_m)).sum()),
            inliers=inliers,
            points=len(points),
            residual_m=float(np.sqrt(np.mean(distance_m[paired] ** 2))),
            at_minimum=is_good,
            converged=is_good,
            reason="converged" if is_good else "few correspondences",
        )
