"""Time and memory of SLAM along a long log: ``python -m tests.benchmarks.long_run [--scans N]``.

A laser scanner goes round the simulated office for hours. Every tenth of the way: the mean CPU time of
``Slam.process`` a scan, loops and optimizations included, the memory of this process, and what it keeps
in a file instead.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from time import thread_time

from scanchain import Slam
from scanchain.logs import open_log
from scanchain.processes import resident_mib
from scanchain.settings import load_settings
from scanchain.simulation import SENSORS, simulate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=20_000)
    parser.add_argument("--log", type=Path, help="take the scans of this log instead of simulating one")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.log or Path(folder) / "office.mcap"
        if arguments.log is None:
            simulate("office", path, duration_s=arguments.scans * SENSORS["lms-270"].period_ns * 1e-9)
        _follow(path, arguments.scans)


def _follow(path: Path, scans: int) -> None:
    log = open_log(path)
    slam = Slam(load_settings(log.dimension).config, log.T_base_lidar)
    tenth, spent_s, taken_s = max(scans // 10, 1), [], 0.0
    for scan in log.scans():
        started = thread_time()
        slam.process(scan)
        taken_s += thread_time() - started
        if (scan.index + 1) % tenth == 0:
            spent_s.append(taken_s)
            taken_s = 0.0
            stored_mib = 4 * slam.dimension * slam.points.rows / 2**20
            print(
                f"{scan.index + 1:6} scans {1e3 * spent_s[-1] / tenth:6.2f} ms a scan, "
                f"{resident_mib(os.getpid()):6.1f} MiB, "
                f"{stored_mib:5.1f} in a file; {len(slam.keyframes)} keyframes, "
                f"{len(slam.closures)} closures tried",
                flush=True,
            )
    if len(spent_s) >= 10:
        print(f"last tenth / second tenth: {spent_s[9] / spent_s[1]:.2f}")


if __name__ == "__main__":
    main()
