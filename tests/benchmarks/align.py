"""How often ``align`` of two scans converges, and is right, without a guess: ``python -m tests.benchmarks.align``.

Pairs of scans are drawn at random from logs in ../shared/data (or SCANCHAIN_DATA), at most so far apart and turned
by at most a radian; where they truly lie is what SLAM makes of the whole log. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
from itertools import islice

import numpy as np

import scanchain
from scanchain import lie
from scanchain.logs import open_log
from scanchain.settings import load_settings
from scanchain.slam import Slam
from tests.benchmarks.accuracy import DATA

LOGS = {  # with the number of scans and the largest distances of a pair, meters
    "2d/intel.mcap": (None, (1.0, 4.0)),
    "2d/aces.mcap": (None, (1.0, 4.0)),
    "3d/kitti_0005_first60.mcap": (60, (1.5,)),
    "3d/kitti_0001_first54.mcap": (54, (3.0,)),
}
LEAST_M, MOST_RAD = 0.2, 1.0  # motion between the scans of a pair
RIGHT_M = 0.2


def solved(name, scans):
    """Points of every scan, and their poses."""
    log = open_log([DATA / name])
    slam = Slam(load_settings(log.dimension).config, log.T_base_lidar)
    points = [slam.process(scan).scan.points.astype(float) for scan in islice(log.scans(), scans)]
    return points, slam.finish().trajectory.poses


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("| log | apart, m | pairs | converged | of these wrong | right, not converged |")
    print("|---|---|---|---|---|---|")
    for name, (scans, distances_m) in LOGS.items():
        if not (DATA / name).exists():
            print(f"| {name}: absent |")
            continue
        points, poses = solved(name, scans)
        for most_m in distances_m:
            rng = np.random.default_rng(arguments.seed)
            result = [outcome(points, poses, most_m, rng) for _ in range(arguments.pairs)]
            error_m, converged = np.array(result).T
            wrong = int((error_m[converged > 0] > RIGHT_M).sum())
            missed = int((error_m[converged == 0] < RIGHT_M).sum())
            counts = f"{len(result)} | {int(converged.sum())} | {wrong} | {missed}"
            print(f"| {name} | {LEAST_M:g} to {most_m:g} | {counts} |")


def outcome(points, poses, most_m, rng):
    """Error in meters of a random pair, and whether its match says that it converged."""
    while True:
        i, j = rng.integers(len(points), size=2)
        motion = lie.between(poses[i], poses[j])
        distance_m, turn_rad = lie.apart(poses[i], poses[j])
        if LEAST_M < distance_m < most_m and turn_rad < MOST_RAD:
            match = scanchain.align(points[i], points[j])
            return lie.apart(motion, match.T_target_source)[0], match.converged


if __name__ == "__main__":
    main()
