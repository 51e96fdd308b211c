"""Odometry of simulated drives with and without their IMU, sound ones and such that lie.

Without wheels. ATE and mean errors from scan to scan against the simulator; "used" is the share of scans whose
rotation the gyro predicted. The ratio of times is that of CPU time in odometry, without reading the log.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from time import process_time
from typing import NamedTuple

import numpy as np

import scanchain
from scanchain import lie
from scanchain.data import Trajectory
from scanchain.simulation.imu import IMUS
from tests.benchmarks.harness import LIDARS, PLACES, ate_m, options_of, table
from tests.support import made


class Driven(NamedTuple):
    """ATE in m, errors from scan to scan in m and degrees (root mean squares), CPU ms per scan, use, words."""

    ate_m: float
    step_m: float
    step_deg: float
    scan_ms: float
    used: float
    words: str


def driven(log: scanchain.Log, truth: Trajectory) -> Driven:
    """Odometry of a log without its wheels."""
    odometry = scanchain.Odometry(dimension=log.dimension)
    poses, spent_s = [], 0.0
    for scan in log:
        scan = replace(scan, T_odom_base=None)
        began_s = process_time()
        poses.append(odometry.process(scan).T_odom_lidar)
        spent_s += process_time() - began_s
    count, gyro = len(poses), odometry.predictor.gyro
    found, true = np.array(poses), truth.poses[:count] if log.dimension == 3 else lie.flatten(truth.poses[:count])
    steps = [lie.between(each[:-1], each[1:]) for each in (true, found)]
    errors, d = lie.log(lie.between(*steps)), log.dimension
    step_m, step_rad = (
        float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) for part in (errors[:, :d], errors[:, d:])
    )
    away_m = ate_m(Trajectory(truth.stamps_ns[:count], found), Trajectory(truth.stamps_ns[:count], true))
    used = gyro.used / count
    return Driven(
        away_m, step_m, np.degrees(step_rad), 1e3 * spent_s / count, used, "; ".join(odometry.predictor.warnings())
    )


def main() -> None:
    options = options_of(
        __doc__,
        worlds=PLACES,
        sensors=LIDARS,
        imus={"mems": 0} | dict.fromkeys(IMUS, 0),
        seconds=15.0,
        pace=1.0,
        seeds=1,
    )
    row = table(
        "world, lidar, IMU",
        "ATE m",
        "without",
        "step m",
        "without",
        "step deg",
        "without",
        "used",
        "time",
        "words",
    )
    for world, sensor, imu, seed in product(options.worlds, options.sensors, options.imus, range(options.seeds)):
        made_of = {"sensor": sensor, "seconds": options.seconds, "pace": options.pace, "seed": seed, "imu": imu}
        path = made.log(world, folder=options.cache, **made_of)
        truth = scanchain.read_tum(path.with_suffix(".tum"))
        without = driven(scanchain.open_log(path, imu_topic="none"), truth)
        ours = driven(scanchain.open_log(path), truth)
        pairs = zip(ours[:3], without[:3], strict=True)
        cells = [f"{value:.4f}" for pair in pairs for value in pair]
        ratio = f"{ours.scan_ms / without.scan_ms:.2f}"
        row(f"{world}, {sensor}, {imu}", *cells, f"{100 * ours.used:.0f} %", ratio, ours.words)


if __name__ == "__main__":
    main()
