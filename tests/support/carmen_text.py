"""The lines of CARMEN logs."""

import numpy as np

BEGIN_S = 1_000_000_000.25  # exact in binary


def flaser(k, ranges=None, *, stamp_s=None, pose=None, odometry=None):
    ranges = np.linspace(1.0, 5.0, 180).round(2) if ranges is None else ranges
    odometry = (0.1 * k, 0.02 * k, 0.01 * k) if odometry is None else odometry
    values = [*ranges, *(odometry if pose is None else pose), *odometry]
    stamp_s = BEGIN_S + 0.25 * k if stamp_s is None else stamp_s
    words = " ".join(f"{value:.6f}" for value in values)
    return f"FLASER {len(ranges)} {words} {stamp_s:.6f} nohost {0.25 * k:.6f}"


def robotlaser(k, ranges, laser, robot, *, first=-1.0, step=0.25, reach=30.0, remissions=()):
    head = [0, first, step * (len(ranges) - 1), step, reach, 0.01, 0]
    values = [*head, len(ranges), *ranges, len(remissions), *remissions, *laser, *robot, 0, 0, 0, 0, 0]
    return f"ROBOTLASER1 {' '.join(map(str, values))} {BEGIN_S + 0.25 * k:.6f} host {0.25 * k:.6f}"


def odom(k, x):
    return f"ODOM {x:.6f} 0.0 0.0 0.0 0.0 0.0 {BEGIN_S + 0.25 * k:.6f} nohost {0.25 * k:.6f}"
