"""How far off each matcher is, before and after loop closing: ``python -m tests.benchmarks.accuracy``.

Real logs come from ../shared/data (or SCANCHAIN_DATA) and are named where they are absent; the simulated ones are
made in a temporary folder. Prints a Markdown table.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from scanchain.data import Trajectory
from scanchain.evaluation import absolute_error, pair, read_relations, relation_error
from scanchain.logs import open_log
from scanchain.settings import Override, load_settings
from scanchain.simulation import simulate
from scanchain.slam import Slam, SlamResult
from scanchain.trajectory import read_tum

DATA = Path(os.environ.get("SCANCHAIN_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
MATCHERS = ("plicp", "svd")


@dataclass(frozen=True, slots=True)
class Case:
    """A log, which of its scans are run and how, and its reference (a .tum or a .relations file)."""

    name: str
    log: Path
    reference: Path
    overrides: tuple[Override, ...] = ()
    every: int = 1


def cases(folder: Path) -> Iterator[Case]:
    """The real logs that are there, then the simulated ones, made in the folder."""
    no_wheels = (Override("odometry.prior", "constant-velocity", "--odometry.prior"),)
    for name in ("Intel", "ACES"):
        log = DATA / f"2d/{name.lower()}.mcap"
        yield Case(f"{name}, wheels", log, log.with_suffix(".relations"))
        yield Case(f"{name}, no wheels", log, log.with_suffix(".relations"), no_wheels)
    kitti = DATA / "3d/kitti_0001_first54.mcap"
    for every in (1, 2, 3, 5):
        yield Case(f"KITTI 0001, every {every} of 54 scans", kitti, kitti.with_suffix(".tum"), every=every)
    for world, duration_s in (("office", 240.0), ("town", 30.0)):
        log = folder / f"{world}.mcap"
        simulate(world, log, duration_s=duration_s, seed=1)
        yield Case(f"simulated {world}, {duration_s:g} s", log, log.with_suffix(".tum"))


def run(case: Case, matcher: str) -> tuple[SlamResult, float]:
    """The result, and seconds per scan, reading included."""
    overrides = (*case.overrides, Override("matching.matcher", matcher, "--matching.matcher"))
    log = open_log([case.log], every=case.every)
    slam = Slam(load_settings(log.dimension, overrides=overrides).config, log.T_base_lidar)
    started = perf_counter()
    for scan in log.scans():
        slam.process(scan)
    result = slam.finish()
    return result, (perf_counter() - started) / len(result.trajectory)


def error(trajectory: Trajectory, reference: Path) -> str:
    """ATE rmse after rigid alignment, or the mean absolute errors over relations."""
    if reference.suffix == ".tum":
        ate = absolute_error(pair(trajectory, read_tum(reference)))
        return f"{ate.translation_m.rmse:.4f} m ({100.0 * ate.share_of_path:.3f} %)"
    relations = relation_error(trajectory, read_relations(reference))
    return f"{relations.translation_m.mean:.4f} m, {np.degrees(relations.rotation_rad.mean):.3f}°"


def main() -> None:
    print("| log | matcher | before loops | after loops | ms a scan |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for case in cases(Path(folder)):
            if not case.log.exists():
                print(f"| {case.name} | | absent: {case.log} | | |")
                continue
            for matcher in MATCHERS:
                result, seconds = run(case, matcher)
                before, after = (error(t, case.reference) for t in (result.odometry, result.trajectory))
                print(f"| {case.name} | {matcher} | {before} | {after} | {1e3 * seconds:.2f} |", flush=True)


if __name__ == "__main__":
    main()
