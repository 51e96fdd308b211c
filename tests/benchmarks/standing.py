"""Lidars that stand: how far the pose walks, in mm.

    python -m tests.benchmarks.standing [--scans 150] [--seeds 0,5]

Twelve people walk around the lidar and four cars drive by; ranges err by 2.5 cm. A line has the distance of the
last pose from the first, the root mean square of all, and the share of scans at which the pose was held.
"""

import argparse

import numpy as np

from scanchain.odometry import Odometry
from tests.support.standing import standing

CASES = [
    ("town", "hdl-64"),
    ("town", "vlp-16"),
    ("forest", "vlp-16"),
    ("hall", "vlp-16"),
    ("highway", "os1-32"),
    ("highway", "vlp-16"),
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=150)
    parser.add_argument("--seeds", default="0,5")
    arguments = parser.parse_args()
    print(f"{'world':10}{'sensor':8}{'seed':>5}{'last':>8}{'rms':>8}{'held':>8}")
    for world, sensor in CASES:
        for seed in map(int, arguments.seeds.split(",")):
            odometry = Odometry(dimension=3)
            scans = standing(sensor, arguments.scans, world, seed, noise_m=0.025, people=12, cars=4)
            poses = np.array([odometry.process(scan).T_odom_lidar for scan in scans])
            off_mm = 1e3 * np.linalg.norm(poses[:, :3, 3], axis=1)
            held = np.mean(np.ptp(poses[1:, :3, 3] - poses[:-1, :3, 3], axis=1) == 0.0)
            rms = np.sqrt((off_mm**2).mean())
            print(f"{world:10}{sensor:8}{seed:5}{off_mm[-1]:8.1f}{rms:8.1f}{100.0 * held:7.0f}%", flush=True)


if __name__ == "__main__":
    main()
