"""Where the time of a 3D scan goes, and how far that is from what the memory of this machine allows.

    python -m tests.benchmarks.stages [LOG ...]

Median microseconds a scan, over two passes of which the second counts; the share is that of the whole. *reading
once* is a sum over all coordinates of the raw scan, which no method can do without.

Limit: the bytes that a scan must move at the rate at which this machine sums a large array, and its look-ups of
voxels at the rate at which it gathers 64-bit keys at random out of a table as large as the map's, both in one
thread. Look-ups: of downsampling, the points that do not share a voxel with the one before; of matching, the
voxels around each point, times associations; of the map, one a point and 27 for each voxel that is fitted.
Bytes: the raw points once, the table of downsampling, the points that remain, the shapes of corresponding
voxels (128 bytes) each time that residuals are summed, and the moments (80 bytes) of voxels that are filled and
fitted.
"""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path
from time import perf_counter

import numpy as np

from scanchain.config import LogConfig
from scanchain.data import Pose, Scan
from scanchain.kernels.voxels import SEEN
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.settings import load_settings
from tests.benchmarks.odometry3d import DATA, DEFAULT_LOGS


def seconds_by_stage(log_scans: list[Scan], T_base_lidar: Pose) -> dict[str, float]:
    """Median seconds a scan by stage."""
    rows: list[tuple[float, ...]] = []
    for _ in range(2):
        rows = []
        odometry = Odometry(load_settings(3).config, T_base_lidar)
        for scan in log_scans:
            started = perf_counter()
            float(scan.points.sum())
            read = perf_counter() - started
            started = perf_counter()
            step = odometry.process(scan)
            whole = perf_counter() - started
            stages = step.preprocess_s, step.match_s, step.map_s
            rows.append((read, *stages, whole - sum(stages), whole))
    names = ("reading once", "downsampling", "matching", "extending the map", "the rest", "whole scan")
    return dict(zip(names, np.median(rows, axis=0).tolist(), strict=True))


def work_of(log_scans: list[Scan], T_base_lidar: Pose) -> tuple[float, float]:
    """Mean bytes moved and voxels looked up a scan, by the counts that its stages go through."""
    config = load_settings(3).config
    odometry = Odometry(config, T_base_lidar)
    rows: list[tuple[float, float]] = []
    for scan in log_scans:
        tracked = odometry.process(scan)
        size_m = odometry.local_map.scale * config.preprocess.map_voxel_m
        cells = np.floor(scan.points / size_m).astype(np.int32)
        tried = 1 + int((cells[1:] != cells[:-1]).any(axis=1).sum())
        match, dense, sparse = tracked.match, len(tracked.points), len(tracked.matched)
        table = 8.0 * max(4.0 ** np.ceil(np.log(2 * dense) / np.log(4)), 1024)  # it grows fourfold
        history = odometry.local_map.voxels.history[: len(odometry.local_map)]
        filled = int((history[:, SEEN] == odometry.local_map.insertions).sum())
        fitted = filled / 4.0  # measured on KITTI 0005: 1,066 of 4,279
        lookups = tried + 8.0 * sparse * match.iterations + dense + 27.0 * fitted
        moved = 12.0 * len(scan.points) + table + 24.0 * (2 * dense + sparse)
        moved += 128.0 * sparse * (match.iterations + 3) + 80.0 * (2 * filled + 27.0 * fitted)
        rows.append((moved, lookups))
    return tuple(np.mean(rows[1:], axis=0).tolist())


def rates() -> tuple[float, float]:
    """Bytes a second of a sum over a large array, and random look-ups a second in two megabytes of keys."""
    large, keys = np.ones(32_000_000), np.arange(1 << 18)
    where = np.random.default_rng(0).integers(0, len(keys), 4_000_000)
    seconds = [np.inf, np.inf]
    for _ in range(5):
        for k, work in enumerate((large.sum, lambda: keys.take(where))):
            began = perf_counter()
            work()
            seconds[k] = min(seconds[k], perf_counter() - began)
    return large.nbytes / seconds[0], len(where) / seconds[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path, default=[DATA / name for name in DEFAULT_LOGS])
    parser.add_argument("--scans", type=int, default=100)
    arguments = parser.parse_args()
    for path in arguments.logs:
        log = open_log(path, LogConfig())
        scans = list(islice(log.scans(), arguments.scans))
        stages = seconds_by_stage(scans, log.T_base_lidar)
        points = np.mean([len(scan.points) for scan in scans])
        print(f"\n{path.name}: {len(scans)} scans of {points:.0f} points")
        for name, seconds in stages.items():
            print(f"  {name:18}{1e6 * seconds:8.0f} us{100.0 * seconds / stages['whole scan']:7.1f} %")
        (moved, lookups), (bytes_s, lookups_s) = work_of(scans, log.T_base_lidar), rates()
        limit_s = moved / bytes_s + lookups / lookups_s
        print(f"  {moved / points:.0f} bytes and {lookups / points:.2f} look-ups a raw point")
        print(f"  this machine: {bytes_s / 1e9:.1f} GB/s, {lookups_s / 1e6:.0f} million random look-ups/s")
        print(f"  limit {1e6 * limit_s:.0f} us: the scan takes {stages['whole scan'] / limit_s:.1f} times as long")


if __name__ == "__main__":
    main()
