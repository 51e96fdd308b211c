"""Where the time of a 3D scan goes, and how far that is from merely reading its points once.

    python -m tests.benchmarks.stages [LOG ...]

Median microseconds a scan, over two passes of which the second counts; the share is that of the whole. *reading
once* is a sum over all coordinates of the raw scan, which no method can do without.
"""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path
from time import perf_counter

import numpy as np

from scanchain.config import LogConfig
from scanchain.data import Pose, Scan
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
    names = ("reading once", "thinning out", "matching", "extending the map", "the rest", "whole scan")
    return dict(zip(names, np.median(rows, axis=0).tolist(), strict=True))


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


if __name__ == "__main__":
    main()
