"""Loop closure in 3D with drift turned up: how many revisits are found, how many are false, what the map gains.

    python -m tests.benchmarks.loops3d [--sensors hdl-64,...] [--worlds rounds] [--scale 0.01]
        [--turn 0.0002] [--false 0.3]

A world is driven with every sensor; what odometry says of each motion is made longer by ``--scale`` of itself and
turned left by ``--turn`` and up by a quarter of that, radians a meter, before the rest of the chain sees it.

A keyframe is a revisit where the truth has it within 5 m of an older one that lies 100 m or more of the way back,
and an opposite one where all those were driven the other way (headings 135° apart or more). It is found where an
accepted closure starts within 10 m of the way from it. A closure is true where its relative pose is within 2 m
and 3° of the truth (drift bends the local maps, too): precision is the share of true ones among those accepted in
the end. ATE is over all scans, after alignment, with drift and after closure. With ``--false``, wrong closures
make up so large a share of those that go into the last optimization; "named" is the share of them that end as
rejected.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import LogConfig
from scanchain.data import BACK_END, Closure, ClosureVerdict, Keyframe, Matrix, Proposal, Trajectory
from scanchain.evaluation import absolute_error, pair
from scanchain.logs import open_log
from scanchain.runs.closures import final_verdicts
from scanchain.settings import load_settings
from tests.benchmarks.contest import in_fresh_process
from tests.benchmarks.odometry3d_set import CACHE, LIDARS, log_of
from tests.support.drifting import drifting_slam, off_by
from tests.support.false_loops import MADE_UP, false_closures

NEAR_M, BACK_M, OPPOSITE_RAD, ALONG_M = 5.0, 100.0, np.radians(135.0), 10.0
TRUE_M, TRUE_RAD = 2.0, np.radians(3.0)


@dataclass(frozen=True, slots=True)
class Score:
    """What became of one log; shares are NaN where there was nothing to be found or judged."""

    revisits: int
    opposite: int
    recall: float
    opposite_recall: float
    accepted: int
    by_place: int
    precision: float
    rejected_in_the_end: int
    named: float
    ate_before_m: float
    ate_after_m: float
    seconds: float
    loops_s: float


def score(path: Path, error_per_m: NDArray[np.float64], false_share: float) -> Score:
    """One log through the chain."""
    log = open_log([path], LogConfig())
    truth = log.ground_truth()
    if truth is None:
        raise ValueError(f"{path} has no ground truth")
    slam = drifting_slam(load_settings(3).config, log.T_base_lidar, off_by(error_per_m))
    started = perf_counter()
    loops_s = sum(step.timing.loops_s for step in map(slam.process, log.scans()))
    seconds = perf_counter() - started
    wrong = false_closures(slam, false_share) if false_share else ()
    slam.placement.take(wrong)
    result = slam.finish()
    judged, named = [], []
    for tried, item in zip(result.closures, final_verdicts(result.closures, result.state), strict=True):
        if tried.reason == MADE_UP:
            named.append(item.verdict is ClosureVerdict.REJECTED)
        else:
            judged.append(item)
    accepted = [item for item in judged if item.verdict is ClosureVerdict.ACCEPTED]
    true_poses = _true_poses(result.keyframes, truth)
    revisit, opposite = revisits(true_poses, _traveled_m(true_poses))
    found = _found(accepted, _traveled_m(true_poses))
    true = [is_true(item, true_poses) for item in accepted]
    return Score(
        revisits=int(revisit.sum()),
        opposite=int(opposite.sum()),
        recall=_mean(found[revisit]),
        opposite_recall=_mean(found[opposite]),
        accepted=len(accepted),
        by_place=sum(item.proposed_by is Proposal.PLACE for item in accepted),
        precision=_mean(np.array(true)),
        rejected_in_the_end=sum(item.rejected_by == BACK_END for item in judged),
        named=_mean(np.array(named)),
        ate_before_m=_ate_m(result.odometry, truth),
        ate_after_m=_ate_m(result.trajectory, truth),
        seconds=seconds,
        loops_s=loops_s,
    )


def revisits(poses: Matrix, traveled_m: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of the keyframes (K,) return to a place, and which of these only the other way than before."""
    revisit, opposite = np.zeros((2, len(poses)), np.bool_)
    for k, T in enumerate(poses):
        old = poses[: np.searchsorted(traveled_m, traveled_m[k] - BACK_M)]
        near = old[np.linalg.norm(old[:, :3, 3] - T[:3, 3], axis=1) <= NEAR_M]
        revisit[k] = len(near) > 0
        opposite[k] = revisit[k] and bool(np.all(near[:, :3, 0] @ T[:3, 0] <= np.cos(OPPOSITE_RAD)))
    return revisit, opposite


def is_true(closure: Closure, poses: Matrix) -> bool:
    """Whether a closure says what the truth says."""
    truth = lie.inverse(poses[closure.target]) @ poses[closure.source]
    error = lie.inverse(truth) @ closure.match.T_target_source
    return bool(np.linalg.norm(error[:3, 3]) <= TRUE_M) and float(lie.rotation_angle(error)) <= TRUE_RAD


def _found(accepted: list[Closure], traveled_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    sources = traveled_m[[item.source for item in accepted]]
    return np.any(np.abs(traveled_m[:, None] - sources) <= ALONG_M, axis=1)


def _true_poses(keyframes: tuple[Keyframe, ...], truth: Trajectory) -> Matrix:
    places = np.searchsorted(truth.stamps_ns, [keyframe.stamp_ns for keyframe in keyframes])
    return truth.poses[places]


def _traveled_m(poses: Matrix) -> NDArray[np.float64]:
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)))


def _ate_m(trajectory: Trajectory, truth: Trajectory) -> float:
    return absolute_error(pair(trajectory, truth)).translation_m.rmse


def _mean(values: NDArray[np.bool_]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", default=",".join(LIDARS), help="default: %(default)s")
    parser.add_argument("--worlds", default="rounds", help="default: %(default)s")
    parser.add_argument("--scale", type=float, default=0.01, help="default: %(default)s")
    parser.add_argument("--turn", type=float, default=0.0002, help="radians a meter, default: %(default)s")
    parser.add_argument("--false", type=float, default=0.0, help="share of wrong closures, default: %(default)s")
    parser.add_argument("--scans", type=int, default=1600, help="at most, default: %(default)s")
    parser.add_argument("--cache", type=Path, default=CACHE)
    arguments = parser.parse_args()
    error_per_m = np.array([arguments.scale, 0.0, 0.0, 0.0, -0.25 * arguments.turn, arguments.turn])
    print(
        "sequence            revisits opposite  recall opposite  closures by place  precision rejected  named   "
        "ATE before  after m  ratio      s  loops s"
    )
    for world in arguments.worlds.split(","):
        for sensor in arguments.sensors.split(","):
            path = log_of(world, sensor, arguments.scans, arguments.cache)
            s = in_fresh_process(score, path, error_per_m, arguments.false)
            print(
                f"{world + ' ' + sensor:20}{s.revisits:8}{s.opposite:9}{100 * s.recall:7.1f}%"
                f"{100 * s.opposite_recall:8.1f}%{s.accepted:10}{s.by_place:9}{100 * s.precision:10.1f}%"
                f"{s.rejected_in_the_end:9}{100 * s.named:6.0f}%{s.ate_before_m:12.3f}{s.ate_after_m:9.3f}"
                f"{s.ate_after_m / s.ate_before_m:7.3f}{s.seconds:7.1f}{s.loops_s:9.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
