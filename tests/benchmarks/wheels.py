"""Odometry of simulated drives with wheels, with wheels whose distances are not corrected, and without.

ATE in m against the simulator; the last columns are the scale of the distances as found, and the true one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from unittest.mock import patch

import numpy as np

import scanchain
from scanchain import lie
from scanchain.data import Scan, Trajectory
from scanchain.odometry.wheels import Wheels
from tests.benchmarks.harness import LIDARS, PLACES, ate_m, options_of, table
from tests.support import made


def driven(scans: Iterable[Scan], log: scanchain.Log, truth: Trajectory) -> tuple[float, float]:
    """ATE in m, and the scale of the distances by wheels over true ones, as found."""
    odometry = scanchain.Odometry(T_base_lidar=log.stated_mounting, dimension=log.dimension)
    found = np.array([odometry.process(scan).T_odom_lidar for scan in scans])
    true = Trajectory(truth.stamps_ns[: len(found)], truth.poses[: len(found)])
    return ate_m(Trajectory(true.stamps_ns, found), true), 1.0 / odometry.predictor.wheels.scale


def main() -> None:
    options = options_of(
        __doc__,
        worlds=dict.fromkeys(PLACES, 0),
        sensors=dict.fromkeys(LIDARS, 0),
        seconds=20.0,
        seeds=3,
        wheels_delay_s=0.0,
    )
    row = table("world, lidar, seed", "with", "not corrected", "without", "scale", "true")
    for world, sensor, seed in product(options.worlds, options.sensors, range(options.seeds)):
        made_of = {
            "sensor": sensor,
            "seconds": options.seconds,
            "seed": seed,
            "wheels_delay_s": options.wheels_delay_s,
        }
        path = made.log(world, folder=options.cache, **made_of)
        log, truth = scanchain.open_log(path), scanchain.read_tum(path.with_suffix(".tum"))
        scans = list(log)
        ours, scale = driven(scans, log, truth)
        with patch.object(Wheels, "scale", 1.0):
            uncorrected, _ = driven(scans, log, truth)
        without, _ = driven([replace(scan, T_odom_base=None) for scan in scans], log, truth)
        motions = np.array([scan.T_odom_base for scan in scans]), truth.poses @ lie.inverse(log.stated_mounting)
        by_wheels, true = (np.linalg.norm(lie.between(T[:-1], T[1:])[:, :2, 3], axis=1).sum() for T in motions)
        cells = [f"{value:.4f}" for value in (ours, uncorrected, without, scale, by_wheels / true)]
        row(f"{world}, {sensor}, {seed}", *cells)


if __name__ == "__main__":
    main()
