"""Resident memory along a long log: ``python -m tests.benchmarks.long_log [--scans N]``.

A VLP-16 drives round the simulated town; every tenth of the way the memory of this process is printed, which reads
the log and tracks every scan.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np

from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.processes import resident_mib
from scanchain.settings import load_settings
from scanchain.simulation import SENSORS, simulate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=5000)
    scans = parser.parse_args().scans
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "town.mcap"
        simulate("town", path, duration_s=scans * SENSORS["vlp-16"].period_ns * 1e-9, sensor="vlp-16")
        log = open_log(path)
        odometry = Odometry(load_settings(3).config, log.T_base_lidar)
        mebibytes = []
        for scan in log.scans():
            odometry.process(scan)
            if (scan.index + 1) % max(scans // 10, 1) == 0:
                mebibytes.append(resident_mib(os.getpid()))
                print(f"{scan.index + 1:6} scans {mebibytes[-1]:7.1f} MiB", flush=True)
        spread = np.ptp(mebibytes) / mebibytes[0]
        print(f"{path.stat().st_size / 1e9:.2f} GB of log; memory varies by {100.0 * spread:.1f} %")


if __name__ == "__main__":
    main()
