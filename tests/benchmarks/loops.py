"""Loop closure with drift turned up: revisits that are found, closures that are false, what the trajectory gains.

Every motion of the odometry is made longer by a share of itself and turned left by so much a meter (``--drifts
0.01,0.002 ...``; in space up, too, by a quarter of that) before the rest of the chain sees it. The reference is
the truth of a simulated log in space; of a planar one it is the log as it is, without added drift.

A closure is false where its relative pose is more than 0.5 m, in space 2 m or 3°, from the reference (drift
bends the local maps, too). A keyframe is a revisit where the reference has it within 5 m of an older one that
lies 100 m or more of the way back, and an opposite one where all those were driven the other way (headings 135°
apart or more). It is found where an accepted closure starts within 10 m of the way from it. ATE is over all
scans, after rigid alignment, with drift and after closure. With --false, wrong closures make up so large a share
of those that go into the last optimization; "named" is the share of them that end as rejected.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import compress
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import BACK_END, Closure, ClosureVerdict, Matrix, Pose, Proposal, Trajectory
from scanchain.evaluation import path_length
from scanchain.logs import open_log
from scanchain.runs.closures import final_verdicts
from scanchain.settings import load_settings
from tests.benchmarks.harness import SEQUENCES, ate_m, drive_of, in_fresh_process, options_of, table
from tests.support import made
from tests.support.drifting import MADE_UP, drifting_slam, false_closures, off_by, stretched
from tests.support.scenes import DATA

NEAR_M, BACK_M, OPPOSITE_RAD, ALONG_M = 5.0, 100.0, np.radians(135.0), 10.0
TRUE = {2: (0.5, np.inf), 3: (2.0, np.radians(3.0))}
DRIFTS = {2: ("0.01,0.002", "0.01,-0.005", "-0.03,0.01"), 3: ("0.01,0.0002",)}
HEAD = "log,drift,ATE,accepted,by place,false,overruled,revisits,opposite,named,s,loops"


def drifted(longer: float, turn_rad_m: float, dimension: int) -> Callable[[Pose], Pose]:
    """What becomes of a motion: longer by a share of the way, turned by so many radians a meter."""
    if dimension == 2:
        return stretched(longer, turn_rad_m)
    return off_by(np.array([longer, 0.0, 0.0, 0.0, -0.25 * turn_rad_m, turn_rad_m]))


def undrifted(path: Path) -> Trajectory:
    """The reference of a log: the truth in space, the log as it is in the plane."""
    log = open_log(path)
    if log.dimension == 3:
        return log.ground_truth()
    slam = drifting_slam(load_settings(2).config, log.T_base_lidar, stretched(0.0, 0.0))
    for scan in log.scans():
        slam.process(scan)
    return slam.finish().trajectory


def row(path: Path, drift: tuple[float, float], truth: Trajectory, false_share: float) -> tuple[object, ...]:
    """The cells of a log."""
    log = open_log(path)
    slam = drifting_slam(load_settings(log.dimension).config, log.T_base_lidar, drifted(*drift, log.dimension))
    started = perf_counter()
    loops_s = sum(step.timing.loops_s for step in map(slam.process, log.scans()))
    spent_s = perf_counter() - started
    if false_share:
        slam.back_end.placement.record(false_closures(slam, false_share))
    result = slam.finish()
    everything = final_verdicts(result.closures, result.state)
    is_made_up = [tried.reason == MADE_UP for tried in result.closures]
    made_up = [each.verdict is ClosureVerdict.REJECTED for each in compress(everything, is_made_up)]
    judged = [each for each, is_wrong in zip(everything, is_made_up, strict=True) if not is_wrong]
    accepted = [each for each in judged if each.verdict is ClosureVerdict.ACCEPTED]
    by_place = sum(each.proposed_by is Proposal.PLACE for each in accepted)
    overruled = sum(each.rejected_by == BACK_END for each in judged)
    poses = true_poses(log.dimension, truth, result.keyframes)
    false = sum(not is_true(each, poses) for each in accepted)
    path_m = path_length(poses)
    sources_m = path_m[[each.source for each in accepted]]
    found = np.any(np.abs(path_m[:, None] - sources_m) <= ALONG_M, axis=1)
    shares = [_share(found[which]) for which in revisits(poses, path_m)]
    ate = f"{ate_m(result.odometry, truth):.2f} to {ate_m(result.trajectory, truth):.2f} m"
    counts = len(accepted), by_place, false, overruled
    drift_text = f"{100.0 * drift[0]:g} %, {1e3 * drift[1]:g} mrad/m"
    return path.stem, drift_text, ate, *counts, *shares, _share(made_up), f"{spent_s:.1f}", f"{loops_s:.1f}"


def true_poses(dimension: int, truth: Trajectory, keyframes) -> Matrix:
    """Those of the keyframes; the stamps of real planar logs are not in order."""
    if dimension == 2:
        return truth.poses[[keyframe.scan_index for keyframe in keyframes]]
    return truth.poses[np.searchsorted(truth.stamps_ns, [keyframe.stamp_ns for keyframe in keyframes])]


def revisits(poses: Matrix, path_m: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of the keyframes (K,) return to a place, and which of these only the other way than before."""
    revisit, opposite = np.zeros((2, len(poses)), np.bool_)
    for k, T in enumerate(poses):
        old = poses[: np.searchsorted(path_m, path_m[k] - BACK_M)]
        near = old[np.linalg.norm(old[:, :-1, -1] - T[:-1, -1], axis=1) <= NEAR_M]
        revisit[k] = len(near) > 0
        opposite[k] = revisit[k] and bool(np.all(near[:, :-1, 0] @ T[:-1, 0] <= np.cos(OPPOSITE_RAD)))
    return revisit, opposite


def is_true(closure: Closure, poses: Matrix) -> bool:
    """Whether a closure says what the reference says."""
    off_m, off_rad = lie.apart(
        lie.between(poses[closure.target], poses[closure.source]), closure.match.T_target_source
    )
    largest_m, largest_rad = TRUE[len(poses[0]) - 1]
    return off_m <= largest_m and off_rad <= largest_rad


def _share(chosen) -> str:
    return f"{100.0 * np.mean(chosen):.1f} % of {len(chosen)}" if len(chosen) else "–"


def main() -> None:
    options = options_of(
        __doc__, "kind", kind=("2d", "3d"), logs=["intel", "mit_csail", "identical"], drifts=[], false=0.0,
        **SEQUENCES | {"worlds": "rounds", "scans": 1600},
    )  # fmt: skip
    drifts = [tuple(map(float, each.split(","))) for each in options.drifts or DRIFTS[int(options.kind[0])]]
    line = table(*HEAD.split(","))
    for path in paths(options):
        truth = undrifted(path)
        for drift in drifts:
            line(*in_fresh_process(row, path, drift, truth, options.false))


def paths(options: argparse.Namespace) -> list[Path]:
    if options.kind == "2d":
        real = {name: DATA / "2d" / f"{name}.mcap" for name in options.logs}
        return [path if path.exists() else made.log(name, folder=options.cache) for name, path in real.items()]
    pairs = [(world, sensor) for world in options.worlds.split(",") for sensor in options.sensors.split(",")]
    return [drive_of(*pair, options.scans, options.cache) for pair in pairs]


if __name__ == "__main__":
    main()
