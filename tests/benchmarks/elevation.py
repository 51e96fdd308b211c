"""Error of vertical angles, with and without calibration: ``python -m tests.benchmarks.elevation``.

Simulated sweeps as a lidar would give them whose vertical angles are off, and KITTI, which is as it was recorded.
The errors are those of 20 m against ground truth. Prints a Markdown table.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.odometry.elevation import raised
from scanchain.settings import Override, load_settings
from scanchain.simulation import simulate
from scanchain.trajectory import read_tum
from tests.benchmarks.accuracy import DATA

WORLDS = (  # with the seconds driven
    ("town", "hdl-64", 12.0),
    ("town", "os1-32", 12.0),
    ("town", "vlp-16", 15.0),
    ("highway", "os1-32", 6.0),
    ("hall", "os1-32", 15.0),
    ("forest", "vlp-16", 20.0),
    ("field", "hdl-64", 10.0),
)
OFFSETS_DEG = (0.0, -0.3)
STRETCH_M = 20.0


def tracked(log_file, offset_deg, *, is_calibrated):
    """Poses of the log with its points moved, and the odometry that found them."""
    log = open_log([log_file])
    wanted = Override("preprocess.calibrate_elevation", str(is_calibrated).lower(), "")
    config = load_settings(3, overrides=(wanted,)).config
    odometry = Odometry(config, log.T_base_lidar)
    poses = []
    for scan in log.scans(config.preprocess):
        points = raised(scan.points.astype(float), math.radians(offset_deg)).astype(np.float32)
        poses.append(odometry.process(replace(scan, points=points) if offset_deg else scan).T_odom_lidar)
    return np.array(poses), odometry


def errors(poses, true):
    """Mean share of a stretch by which it is off in z, and mean pitch error per meter, degrees."""
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1))])
    last = np.searchsorted(path_m, path_m + STRETCH_M)
    first = np.flatnonzero(last < len(path_m))
    last = last[first]
    error = lie.log(lie.between(lie.between(true[first], true[last]), lie.between(poses[first], poses[last])))
    z, pitch = np.abs(error[:, [2, 4]]).mean(axis=0) / STRETCH_M
    return z, math.degrees(pitch)


def cases(folder):
    """Name, log and offset in degrees."""
    for name in ("kitti_0001_first54",):
        if (DATA / f"3d/{name}.mcap").exists():
            yield name, DATA / f"3d/{name}.mcap", 0.0
        else:
            print(f"{name}: absent")
    for world, sensor, duration_s in WORLDS:
        log = folder / f"{world}_{sensor}.mcap"
        simulate(world, log, duration_s=duration_s, sensor=sensor)
        for offset_deg in OFFSETS_DEG:
            yield f"{world}, {sensor}, {offset_deg:+.1f}°", log, offset_deg


def main():
    print("| log | corrected by, deg | from scan | z, % | with, % | pitch, deg/m | with, deg/m |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, log, offset_deg in cases(Path(folder)):
            true = read_tum(log.with_suffix(".tum")).poses
            without = errors(tracked(log, offset_deg, is_calibrated=False)[0], true)
            poses, odometry = tracked(log, offset_deg, is_calibrated=True)
            z, pitch_deg = errors(poses, true)
            found = f"{math.degrees(odometry.elevation.offset_rad):+.2f} | {odometry.calibrated_from}"
            shown = f"{100 * without[0]:.3f} | {100 * z:.3f} | {without[1]:.4f} | {pitch_deg:.4f}"
            print(f"| {name} | {found} | {shown} |", flush=True)


if __name__ == "__main__":
    main()
