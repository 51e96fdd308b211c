"""Odometry of laser scans played forward and backward: ``python -m tests.benchmarks.windows [LOG ...]``.

From each of many scans on, odometry follows 500 scans in a map of its own. Its motions over 40 scans are compared
with those of the whole log after loop closing.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from scanchain import Odometry, Slam, lie
from scanchain.data import Matrix, Scan
from scanchain.logs import open_log
from scanchain.settings import load_settings
from tests.benchmarks.vouching_logs import DATA
from tests.support.back_and_forth import BackAndForth

_SCANS, _WINDOW, _EVERY = 500, 40, 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ("mit_csail", "aces", "intel")
    parser.add_argument("logs", nargs="*", type=Path, default=[DATA / f"2d/{name}.mcap" for name in names])
    parser.add_argument("--starts", type=int, default=40)
    parser.add_argument("--no-wheels", action="store_true")
    arguments = parser.parse_args()
    print("| log | played | windows | over 0.2 m | over 0.5 m | median | wrong by 0.5 m and all ok |")
    print("|---|---|---|---|---|---|---|")
    for path in arguments.logs:
        log = open_log(path)
        slam = Slam(load_settings(2).config, log.T_base_lidar)
        count = sum(1 for _ in map(slam.process, log.scans()))
        poses = slam.finish().trajectory.poses
        scans = list(BackAndForth(log).scans(2 * count))
        if arguments.no_wheels:
            scans = [replace(scan, T_odom_base=None) for scan in scans]
        for played, part, reference in (
            ("forward", scans[:count], poses),
            ("backward", scans[count:], poses[::-1]),
        ):
            errors_m, are_ok = _errors(part, reference, log.T_base_lidar, arguments.starts)
            share = [100.0 * np.mean(errors_m > limit_m) for limit_m in (0.2, 0.5)]
            silent = int(np.sum(are_ok & (errors_m > 0.5)))
            print(
                f"| {path.stem} | {played} | {len(errors_m)} | {share[0]:.1f} % | {share[1]:.1f} % | "
                f"{np.median(errors_m):.3f} m | {silent} |",
                flush=True,
            )


def _errors(scans: list[Scan], reference: Matrix, T_base_lidar: Matrix, starts: int) -> tuple[Matrix, Matrix]:
    """Distance of every window's motion from that of the reference, and whether all its scans were ok."""
    errors_m, are_ok = [], []
    for start in np.linspace(0, max(len(scans) - _SCANS, 0), starts).astype(int):
        odometry = Odometry(load_settings(2).config, T_base_lidar)
        tracked = [odometry.process(scan) for scan in scans[start : start + _SCANS]]
        for first in range(0, len(tracked) - _WINDOW, _EVERY):
            window = tracked[first : first + _WINDOW + 1]
            motion = T_base_lidar @ lie.between(window[0].T_odom_lidar, window[-1].T_odom_lidar)
            true = lie.between(reference[start + first], reference[start + first + _WINDOW])
            errors_m.append(lie.apart(true, motion @ lie.inverse(T_base_lidar))[0])
            are_ok.append(all(each.state == "ok" for each in window))
    return np.array(errors_m), np.array(are_ok)


if __name__ == "__main__":
    main()
