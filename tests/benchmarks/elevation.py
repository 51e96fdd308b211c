"""Elevation offsets: found or not, in any world, by any lidar, at any voxel size.

    python -m tests.benchmarks.elevation [--quick] [--worlds town,...] [--sensors vlp-16,...]
        [--voxels 0.3,1,2] [--offsets=-0.3,0,0.3]

Simulated sweeps as a lidar would give them whose vertical angles are off, and KITTI, which is as it was recorded
(readers made for it correct it by +0.205°): whole, its halves, and every second sweep. Voxels of the map and those
of scans go together. Prints a Markdown table: a row for each log and voxel size, in each cell what was found, in
degrees, "none" where nothing was corrected; then the largest error, the mean σ, and the pitch error over 20 m at
the first offset, without and with the correction.
"""

from __future__ import annotations

import argparse
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

SECONDS = {"town": 12.0, "highway": 6.0, "hall": 15.0, "field": 10.0, "forest": 20.0}
SENSORS = ("hdl-64", "os1-32", "vlp-16")
QUICK = (("town", "os1-32"), ("highway", "vlp-16"), ("forest", "os1-32"))
KITTI_DEG = 0.205
STRETCH_M = 20.0


def tracked(log, scans, voxel_m, offset_deg, *, is_calibrated=True):
    """Poses of scans with their points moved, and the odometry that found them."""
    settings = {
        "preprocess.calibrate_elevation": str(is_calibrated).lower(),
        "local_map.voxel_size_m": voxel_m,
        "preprocess.map_voxel_m": 0.5 * voxel_m,
        "preprocess.match_voxel_m": 1.5 * voxel_m,
    }
    config = load_settings(
        3, overrides=tuple(Override(key, str(value), "") for key, value in settings.items())
    ).config
    odometry = Odometry(config, log.T_base_lidar)
    poses = []
    for scan in scans:
        points = raised(scan.points.astype(float), -math.radians(offset_deg)).astype(np.float32)
        poses.append(odometry.process(replace(scan, points=points) if offset_deg else scan).T_odom_lidar)
    return np.array(poses), odometry


def pitch_deg_per_m(poses, true):
    """Mean pitch error over 20 m, degrees a meter."""
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1))])
    last = np.searchsorted(path_m, path_m + STRETCH_M)
    first = np.flatnonzero(last < len(path_m))
    last = last[first]
    error = lie.log(lie.between(lie.between(true[first], true[last]), lie.between(poses[first], poses[last])))
    return math.degrees(np.abs(error[:, 4]).mean()) / STRETCH_M


def row(name, log, scans, voxel_m, offsets_deg, true=None, wanted_deg=None):
    """Print what was found at each offset."""
    cells, errors, sigmas = [], [], []
    for offset_deg in offsets_deg:
        if wanted_deg is not None and offset_deg:
            cells.append("")
            continue
        poses, odometry = tracked(log, scans, voxel_m, offset_deg)
        found_deg = math.degrees(odometry.elevation.offset_rad)
        cells.append(f"{found_deg:+.3f}" if found_deg else "none")
        errors.append(abs(found_deg - (offset_deg if wanted_deg is None else wanted_deg)))
        sigmas.append(math.degrees(odometry.elevation.sigma_rad))
        if true is not None and len(errors) == 1:
            without, _ = tracked(log, scans, voxel_m, offset_deg, is_calibrated=False)
            pitch = f"{pitch_deg_per_m(without, true):.4f} | {pitch_deg_per_m(poses, true):.4f}"
    shown = f"{max(errors):.3f} | {np.mean(sigmas):.3f} | {pitch if true is not None else '– | –'}"
    print(f"| {name} | {voxel_m:g} | {' | '.join(cells)} | {shown} |", flush=True)


def recorded(voxels_m, offsets_deg):
    """Rows of the given drives of KITTI, whole and in parts; what is found stands in the column of 0°."""
    for name in ("kitti_0001_first54", "kitti_0005_first60"):
        path = DATA / f"3d/{name}.mcap"
        if not path.exists():
            print(f"{name}: absent")
            continue
        log = open_log([path])
        scans = list(log.scans())
        half = len(scans) // 2
        parts = {
            "": scans,
            ", first half": scans[:half],
            ", second half": scans[half:],
            ", every second": scans[::2],
        }
        for part, some in parts.items():
            for voxel_m in voxels_m:
                has_truth = name.startswith("kitti_0001") and not part
                true = read_tum(path.with_suffix(".tum")).poses if has_truth else None
                row(name + part, log, some, voxel_m, offsets_deg, true, KITTI_DEG)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three worlds, one voxel size, KITTI at two")
    parser.add_argument("--worlds", default=",".join(SECONDS), help="default: %(default)s")
    parser.add_argument("--sensors", default=",".join(SENSORS), help="default: %(default)s")
    parser.add_argument("--voxels", default="0.3,1,2", help="meters, default: %(default)s")
    parser.add_argument("--offsets", default="-0.3,0,0.1,0.3", help="degrees, default: %(default)s")
    arguments = parser.parse_args()
    offsets_deg = tuple(map(float, arguments.offsets.split(",")))
    voxels_m = (1.0,) if arguments.quick else tuple(map(float, arguments.voxels.split(",")))
    names = arguments.worlds.split(","), arguments.sensors.split(",")
    cases = QUICK if arguments.quick else [(world, sensor) for world in names[0] for sensor in names[1]]
    columns = [f"{offset_deg:+g}°" for offset_deg in offsets_deg]
    print(f"| log | voxel, m | {' | '.join(columns)} | error | σ | pitch, deg/m | with |")
    print("|---" * (len(columns) + 6) + "|")
    recorded((0.5, 1.0) if arguments.quick else (0.5, 0.7, 1.0), offsets_deg)
    with tempfile.TemporaryDirectory() as folder:
        for world, sensor in cases:
            path = Path(folder) / f"{world}_{sensor}.mcap"
            simulate(world, path, duration_s=SECONDS[world], sensor=sensor)
            log, true = open_log([path]), read_tum(path.with_suffix(".tum")).poses
            for voxel_m in voxels_m:
                row(f"{world}, {sensor}", log, list(log.scans()), voxel_m, offsets_deg, true)
            path.unlink()


if __name__ == "__main__":
    main()
