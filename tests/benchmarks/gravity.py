"""Simulated drives without wheels, with and without their IMU: tilt and height of the result.

The tilt is that of the first pose and the root mean square of all, "known to" what the note says. The error of
the height grows from zero at the first pose; without an IMU the trajectory is turned to the true tilt there.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

import scanchain
from scanchain import lie
from scanchain.data import Matrix
from scanchain.slam import SlamResult
from tests.benchmarks.harness import PLACES, options_of, table
from tests.support import made


def solved(log: scanchain.Log) -> SlamResult:
    """SLAM of a log without its wheels."""
    slam = scanchain.Slam(dimension=3)
    for scan in log:
        slam.process(replace(scan, T_odom_base=None))
    return slam.finish()


def height_m(poses: Matrix, true: Matrix) -> float:
    """Largest error of the height above the first pose."""
    errors = poses[:, 2, 3] - true[:, 2, 3]
    return float(np.abs(errors - errors[0]).max())


def main() -> None:
    options = options_of(__doc__, worlds=PLACES, sensor="vlp-16", imu="mems", seeds=1)
    row = table("world, seed", "first deg", "all deg", "known to", "height m", "without", "correction")
    for world, seed in product(options.worlds, range(options.seeds)):
        path = made.log(world, folder=options.cache, sensor=options.sensor, seed=seed, imu=options.imu)
        without, result = solved(scanchain.open_log(path, imu_topic="none")), solved(scanchain.open_log(path))
        true = scanchain.read_tum(path.with_suffix(".tum")).poses[: len(result.trajectory)]
        poses = result.trajectory.poses
        tilts_deg = np.degrees(np.linalg.norm(np.cross(poses[:, 2, :3], true[:, 2, :3]), axis=1))
        note = next((each for each in result.sensor_notes if "levels" in each), "")
        begun = true[0] @ lie.between(without.trajectory.poses[0], without.trajectory.poses)
        row(
            f"{world}, {seed}",
            f"{tilts_deg[0]:.3f}",
            f"{np.sqrt(np.mean(tilts_deg**2)):.3f}",
            note.partition("result to ")[2].partition(",")[0] or "-",
            f"{height_m(poses, true):.3f}",
            f"{height_m(begun, true):.3f}",
            note.partition(", ")[2] or "-",
        )


if __name__ == "__main__":
    main()
