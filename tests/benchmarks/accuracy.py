"""How far off each matcher is, before and after loop closing; how far the pose of a lidar that stands walks.

Real logs that are absent are named; the simulated ones are made in the cache. Prints a Markdown table.

--standing: twelve people walk around the lidar and four cars drive by; ranges err by 2.5 cm. A row has the
distance of the last pose from the first, the root mean square of all, and the share of scans at which the pose
was held.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from scanchain.data import Trajectory
from scanchain.evaluation import absolute_error, pair, read_relations, relation_error
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.settings import load_settings, overrides_of
from scanchain.slam import Slam, SlamResult
from scanchain.trajectory import read_tum
from tests.benchmarks.harness import options_of, table
from tests.support import made
from tests.support.moving_worlds import standing
from tests.support.scenes import DATA

MATCHERS = ("plicp", "svd")
STANDING = (
    ("town", "hdl-64"), ("town", "vlp-16"), ("forest", "vlp-16"), ("hall", "vlp-16"), ("highway", "os1-32"),
    ("highway", "vlp-16"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Case:
    """A log with its reference (.tum or .relations) beside it, and which of its scans are run and how."""

    name: str
    log: Path
    suffix: str = ".tum"
    prior: str = "auto"
    every: int = 1


def cases(cache: Path) -> Iterator[Case]:
    """The real logs, then the simulated ones."""
    for name in ("Intel", "ACES"):
        log = DATA / f"2d/{name.lower()}.mcap"
        yield Case(f"{name}, wheels", log, ".relations")
        yield Case(f"{name}, no wheels", log, ".relations", "constant-velocity")
    for every in (1, 2, 3, 5):
        yield Case(f"KITTI 0001, every {every} of 54 scans", DATA / "3d/kitti_0001_first54.mcap", every=every)
    for world, seconds in (("office", 240.0), ("town", 30.0)):
        yield Case(f"simulated {world}, {seconds:g} s", made.log(world, folder=cache, seed=1, seconds=seconds))


def run(case: Case, matcher: str) -> tuple[SlamResult, float]:
    """The result, and seconds per scan, reading included."""
    log = open_log([case.log], every=case.every)
    options = {"matching__matcher": matcher, "odometry__prior": case.prior}
    slam = Slam(load_settings(log.dimension, overrides=overrides_of(options)).config, log.T_base_lidar)
    started = perf_counter()
    for scan in log.scans():
        slam.process(scan)
    result = slam.finish()
    return result, (perf_counter() - started) / len(result.trajectory)


def error(trajectory: Trajectory, reference: Path) -> str:
    """ATE rmse after rigid alignment, or the mean absolute errors over relations."""
    if reference.suffix == ".tum":
        ate = absolute_error(pair(trajectory, read_tum(reference)).after_start)
        return f"{ate.translation_m.rmse:.4f} m ({100.0 * ate.share_of_path:.3f} %)"
    relations = relation_error(trajectory, read_relations(reference))
    return f"{relations.translation_m.mean:.4f} m, {np.degrees(relations.rotation_rad.mean):.3f}°"


def moving(options: argparse.Namespace) -> None:
    row = table("log", "matcher", "before loops", "after loops", "ms a scan")
    for case in cases(options.cache):
        if options.only not in case.name:
            continue
        if not case.log.exists():
            row(case.name, "", f"absent: {case.log}", "", "")
            continue
        for matcher in MATCHERS:
            result, seconds = run(case, matcher)
            reference = case.log.with_suffix(case.suffix)
            before, after = (error(each, reference) for each in (result.odometry, result.trajectory))
            row(case.name, matcher, before, after, f"{1e3 * seconds:.2f}")


def standing_still(options: argparse.Namespace) -> None:
    row = table("world", "sensor", "seed", "last", "rms", "held")
    for world, sensor in STANDING:
        for seed in options.seeds:
            odometry = Odometry(dimension=3)
            scans = standing(sensor, options.scans, world, seed, noise_m=0.025, people=12, cars=4)
            places = np.array([odometry.process(scan).T_odom_lidar[:3, 3] for scan in scans])
            off_mm = 1e3 * np.linalg.norm(places, axis=1)
            held = 100.0 * np.mean(np.ptp(np.diff(places, axis=0), axis=1) == 0.0)
            rms_mm = np.sqrt((off_mm**2).mean())
            row(world, sensor, seed, f"{off_mm[-1]:.1f} mm", f"{rms_mm:.1f} mm", f"{held:.0f} %")


def main() -> None:
    options = options_of(__doc__, only="", standing=False, scans=150, seeds=[0, 5])
    (standing_still if options.standing else moving)(options)


if __name__ == "__main__":
    main()
