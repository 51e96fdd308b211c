"""A lidar carried elsewhere while nothing is recorded.

Of a log two stretches of the path are taken, with a gap between them (``--paths``, meters of all three), at random
places; wheels are left out. The reference is the run of the whole log, or the truth of a simulated one.

  right     the second stretch is joined to the first, within 1.5 m (median over pairs of poses) of the reference
  wrong     joined to it elsewhere
  apart     not joined to it
  in sight  path of the second stretch within 3 m of the first one
  after     of that path, what was driven before it was joined
"""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Matrix, Scan
from scanchain.evaluation import path_length
from scanchain.logs import Log, open_log
from scanchain.settings import load_settings
from scanchain.slam import Slam
from tests.benchmarks.harness import options_of, poses_at, table
from tests.support.scenes import DATA

RIGHT_M, IN_SIGHT_M, STEP = 1.5, 3.0, 20
LOGS = [DATA / name for name in ("2d/intel.mcap", "2d/aces.mcap", "2d/mit_csail.mcap")]


def reference_of(log: Log, scans: list[Scan]) -> Matrix:
    """Poses (N, d+1, d+1) of all scans: true ones, or those of the whole log."""
    truth = log.ground_truth()
    if truth is not None:
        return poses_at(truth, np.array([scan.stamp_ns for scan in scans]))
    slam = Slam(load_settings(log.dimension).config, log.T_base_lidar)
    for scan in scans:
        slam.process(scan)
    return slam.finish().trajectory.poses


def outcome(log: Log, scans: list[Scan], T: Matrix, first: range, second: range) -> tuple[str, float, float]:
    """What becomes of the second stretch, its path in sight of the first, and that until it joined."""
    slam = Slam(load_settings(log.dimension).config, log.T_base_lidar)
    positions = T[:, :-1, -1]
    away_m = KDTree(positions[first.start : first.stop]).query(positions)[0]
    in_sight_m, after_m = 0.0, np.nan
    for number in (*first, *second):
        slam.process(replace(scans[number], T_odom_base=None))
        if number > second.start and away_m[number] < IN_SIGHT_M:
            in_sight_m += float(np.linalg.norm(positions[number] - positions[number - 1]))
        components = slam.back_end.closer.segments.components(slam.back_end.graph, with_assumed=False)
        if np.isnan(after_m) and number in second and components[-1] == components[0]:
            after_m = in_sight_m
    result = slam.finish()
    if len(slam.back_end.closer.segments.starts) == 1:
        return "bridged", in_sight_m, after_m
    if result.components[-1] != result.components[0]:
        return "apart", in_sight_m, after_m
    of_scans, poses = np.array([*first, *second])[::STEP], result.trajectory.poses[::STEP]
    moved = T[of_scans] @ lie.inverse(poses)  # T_reference_world by every pose
    is_second = of_scans >= second.start
    placed = moved[~is_second, None] @ poses[is_second]
    error_m = np.median(np.linalg.norm((placed - T[of_scans[is_second]])[..., :-1, -1], axis=-1))
    return ("right" if error_m < RIGHT_M else "wrong"), in_sight_m, after_m


def main() -> None:
    """Print a line a case, and how many ended how."""
    options = options_of(__doc__, "logs", cache=False, logs=LOGS, cases=16, seed=1, paths=[120.0, 40.0, 60.0])
    row = table("log", "case", "second stretch", "in sight", "after")
    for path in options.logs:
        log = open_log([path])
        scans = list(log.scans(load_settings(log.dimension).config.preprocess))
        T = reference_of(log, scans)
        path_m, chosen, ends = path_length(T), random.Random(options.seed), Counter[str]()
        spans_m = np.append(0.0, np.cumsum(options.paths))
        for case in range(options.cases):
            begin_m = chosen.uniform(0.0, max(path_m[-1] - spans_m[-1], 0.0))
            first, gap, second, end = np.searchsorted(path_m, begin_m + spans_m).tolist()
            stretches = range(first, gap), range(second, min(end, len(scans)))
            word, in_sight_m, after_m = outcome(log, scans, T, *stretches)
            ends[word] += 1
            row(path.stem, case, word, f"{in_sight_m:.1f}", f"{after_m:.1f}")
        row(path.stem, "all", ", ".join(f"{count} {word}" for word, count in sorted(ends.items())), "", "")


if __name__ == "__main__":
    main()
