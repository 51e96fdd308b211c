"""One program, old or new, on one log: what ``against`` compares. Uses only what both have."""

from __future__ import annotations

import sys
from time import perf_counter, process_time

import numpy as np

from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.preprocess import downsample
from scanchain.registration import VoxelMap
from scanchain.settings import Override, load_settings

REPEATS = 200  # calls of a kernel on the same input
FEW = 10  # of those that build a map


def main() -> None:
    log_file, out, *words = sys.argv[1:]
    overrides = tuple(Override(*word.split("=", 1), "against") for word in words)
    log = open_log(log_file, load_settings(overrides=overrides).config.log)
    config = load_settings(log.dimension, overrides=overrides).config
    odometry = Odometry(config, log.T_base_lidar)
    cpu_s, wall_s, stages_s, poses = [], [], [], []
    for scan in list(log.scans()):  # read before: readers have threads of their own
        began, cpu_began = perf_counter(), process_time()
        tracked = odometry.process(scan)
        cpu_s.append(process_time() - cpu_began)
        wall_s.append(perf_counter() - began)
        stages_s.append((tracked.preprocess_s, tracked.match_s, tracked.map_s))
        poses.append(tracked.T_odom_lidar)
    np.savez(
        out,
        cpu_s=cpu_s,
        wall_s=wall_s,
        stages_s=stages_s,
        poses=poses,
        kernels_s=[_median_s(call, count) for call, count in _kernels(odometry, tracked, config)],
    )


def _kernels(odometry, tracked, config):
    """The match of the last scan, once more; its downsampling; a map of the last scans."""
    points, prior = tracked.matched, tracked.prior
    raw = np.ascontiguousarray(tracked.scan.points)

    def build() -> None:
        built = VoxelMap(odometry.dimension, config.local_map)
        for each in odometry.map.recent:
            built.insert(*each)

    yield lambda: odometry.matcher.align(points, odometry.local_map, prior.T_target_source, prior), REPEATS
    yield lambda: downsample(raw, config.preprocess.map_voxel_m), REPEATS
    yield build, FEW


def _median_s(call, count: int) -> float:
    spent = []
    for _ in range(count):
        began = process_time()
        call()
        spent.append(process_time() - began)
    return float(np.median(spent))


if __name__ == "__main__":
    main()
