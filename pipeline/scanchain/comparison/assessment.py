"""Figures of methods: against ground truth and relations, and times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import msgspec
import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from scanchain.comparison.figures import Figures
from scanchain.comparison.outcome import STEPS_FILE, Outcome
from scanchain.comparison.scan_store import StoredScans
from scanchain.data import Matrix, Pose, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import (
    RelationError,
    Relations,
    RelativeError,
    absolute_error_of_any_path,
    kitti_error_of_any_path,
    pair,
    relation_error,
    relative_error_over_distance,
    relative_error_over_time,
)
from scanchain.runs.step_table import COLUMNS, nees_of_steps
from scanchain.runs.vouching import evidence_of_trajectory, expected_of_run, judge_run
from scanchain.verdict import Judged, Verdict, apart_m, judge

Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class Assessed:
    """Figures of a method against the ground truth, scan by scan.

    Attributes
    ----------
    figures : over all scans
    T_reference_estimate : (4, 4) the alignment of the ATE; the true first pose of one that did not come to its
        end; the identity without truth
    errors_m, errors_rad, nees : (N,) NaN where a scan has no true pose beside it
    relations : the error over relations; None without any, or after a failure
    definitions : of the figures, as text
    """

    figures: Figures
    T_reference_estimate: Pose
    errors_m: NDArray[np.float64]
    errors_rad: NDArray[np.float64]
    nees: NDArray[np.float64]
    relations: RelationError | None
    definitions: tuple[str, ...]


def assess(
    outcomes: Sequence[Outcome],
    stamps_ns: NDArray[np.int64],
    truth: Trajectory | None,
    relations: Relations | None,
) -> Assessed:
    """Figures of a method's runs over scans of these stamps: errors of the first whole one, times of all."""
    outcome = representative(outcomes)
    figures = _speed(outcomes)
    blank = np.full(len(outcome.seconds), np.nan)
    if not outcome.is_whole:
        return Assessed(figures, _start(stamps_ns, truth), blank, blank, blank, None, ())
    figures = msgspec.structs.replace(figures, repeats_apart_m=_apart(outcomes))
    error = None if relations is None else relation_error(outcome.trajectory, relations)
    if error is not None:
        figures = msgspec.structs.replace(
            figures, relations_m=error.translation_m.mean, relations_rad=error.rotation_rad.mean
        )
    definitions = () if error is None else (error.definition,)
    assessed = Assessed(figures, np.eye(4), blank, blank, blank, error, definitions)
    return assessed if truth is None else _against(truth, outcome, assessed)


def representative(outcomes: Sequence[Outcome]) -> Outcome:
    """The first whole run, else the first."""
    return next((outcome for outcome in outcomes if outcome.is_whole), outcomes[0])


def observability(outcome: Outcome) -> NDArray[np.float64]:
    """(N,) as in ``Match``; empty if the method does not report it."""
    path = outcome.folder / STEPS_FILE
    if not path.exists():
        return np.empty(0)
    return pq.read_table(path, columns=["observability"])["observability"].to_numpy()


def judged(outcomes: Mapping[str, Outcome], scans: StoredScans) -> dict[str, Judged]:
    """The verdict on each whole run: on ours by all that is known, on others by wheels and constant velocity.

    The error of others is bounded by the wheels, and by each of ours that is trustworthy.
    """
    whole = {name: outcome for name, outcome in outcomes.items() if outcome.is_whole}
    found = {name: judge_run(each.folder) for name, each in whole.items() if (each.folder / STEPS_FILE).exists()}
    expected = {name: expected_of_run(whole[name].folder) for name in found}
    positions = {name: each.trajectory.poses[:, :-1, -1] for name, each in whole.items()}
    wheels = scans.wheels @ scans.T_base_lidar
    for name in [name for name in whole if name not in found]:
        bounds_m = {
            ours: apart_m(positions[name], positions[ours]) + error.high
            for ours, error in expected.items()
            if error is not None and found[ours].verdict is Verdict.TRUSTWORTHY
        }
        trajectory = whole[name].trajectory
        found[name] = judge(evidence_of_trajectory(trajectory, scans.log_times_ns, wheels, scans.points, bounds_m))
    return found


def _start(stamps_ns: NDArray[np.int64], truth: Trajectory | None) -> Pose:
    """True first pose of a method that begins with the identity."""
    if truth is None:
        return np.eye(4)
    try:
        return pair(Trajectory(stamps_ns[:1], np.eye(4)[None]), truth).reference[0]
    except InputError:  # the truth begins later
        return np.eye(4)


def _against(truth: Trajectory, outcome: Outcome, assessed: Assessed) -> Assessed:
    pairs = pair(outcome.trajectory, truth)
    if len(pairs) < 2:  # of a method that failed early
        return assessed
    ate = absolute_error_of_any_path(pairs)
    kitti = _or_none(lambda: kitti_error_of_any_path(pairs))
    second = _or_none(lambda: relative_error_over_time(pairs, 1.0))
    over_10_m = _or_none(lambda: relative_error_over_distance(pairs, 10.0))
    over_100_m = _or_none(lambda: relative_error_over_distance(pairs, 100.0))
    nees = _nees(outcome, truth)
    place = pairs.places
    errors_m, errors_rad = assessed.errors_m.copy(), assessed.errors_rad.copy()
    errors_m[place], errors_rad[place] = ate.errors_m, ate.errors_rad
    figures = msgspec.structs.replace(
        assessed.figures,
        ate_m=ate.translation_m.rmse,
        ate_share=ate.share_of_path,
        ate_rotation_rad=ate.rotation_rad.rmse,
        rpe_1_s_m=_rmse_m(second),
        rpe_10_m_m=_rmse_m(over_10_m),
        rpe_100_m_m=_rmse_m(over_100_m),
        kitti_share=None if kitti is None else kitti.translation_share,
        kitti_rad_per_m=None if kitti is None else kitti.rotation_rad_per_m,
        paired_share=pairs.share,
        nees=float(np.nanmean(nees)) if np.isfinite(nees).any() else None,
    )
    found = (each.definition for each in (ate, second, over_10_m, over_100_m, kitti) if each is not None)
    definitions = (*assessed.definitions, *found, f"Paired: {pairs.description}")
    return Assessed(figures, ate.T_reference_estimate, errors_m, errors_rad, nees, assessed.relations, definitions)


def _rmse_m(error: RelativeError | None) -> float | None:
    return None if error is None else error.translation_m.rmse


def _nees(outcome: Outcome, truth: Trajectory) -> NDArray[np.float64]:
    """(N,) of the motion up to each scan; NaN if the method does not report covariances."""
    path = outcome.folder / STEPS_FILE
    if not path.exists():
        return np.full(len(outcome.seconds), np.nan)
    odometry = Trajectory(outcome.trajectory.stamps_ns, outcome.odometry)
    return nees_of_steps(pq.read_table(path, columns=list(COLUMNS)), odometry, truth)


def _speed(outcomes: Sequence[Outcome]) -> Figures:
    """From all runs that came to their end; the first scan of each stands apart."""
    whole = [outcome for outcome in outcomes if outcome.is_whole]
    if not whole:
        peak = max(outcome.report.peak_mib for outcome in outcomes)
        return Figures(peak_mib=peak if outcomes[0].report.status.is_failure and peak else None)
    first = min(1, len(whole[0].seconds) - 1)
    rest = np.concatenate([outcome.seconds[first:] for outcome in whole])
    cpu = np.concatenate([outcome.cpu_seconds[first:] for outcome in whole])
    stages = _stages(whole[0])
    return Figures(
        median_s=float(np.median(rest)),
        p95_s=float(np.percentile(rest, 95.0)),
        cpu_s=float(np.median(cpu)),
        first_s=float(np.median([outcome.seconds[0] for outcome in whole])),
        scans_per_s=float(len(rest) / rest.sum()),
        preprocess_s=stages[0],
        match_s=stages[1],
        map_s=stages[2],
        loops_s=stages[3],
        start_s=float(np.median([outcome.report.start_s for outcome in whole])),
        finish_s=float(np.median([outcome.report.finish_s for outcome in whole])),
        peak_mib=max(outcome.report.peak_mib for outcome in whole),
    )


def _stages(outcome: Outcome) -> tuple[float | None, float | None, float | None, float | None]:
    """Seconds by stage of a method that reports them; the mean for loops, most scans of which take nothing."""
    path = outcome.folder / STEPS_FILE
    if not path.exists():
        return None, None, None, None
    table = pq.read_table(path, columns=["preprocess_s", "match_s", "map_s", "loops_s"])
    preprocess, match, extend, loops = (column.to_numpy()[1:] for column in table.itercolumns())
    if not len(loops):
        return None, None, None, None
    closing = float(loops.mean()) if loops.any() else None
    return float(np.median(preprocess)), float(np.median(match)), float(np.median(extend)), closing


def _apart(outcomes: Sequence[Outcome]) -> float | None:
    """Largest distance between the positions of a scan in two runs."""
    whole: list[Matrix] = [outcome.trajectory.poses for outcome in outcomes if outcome.is_whole]
    if len(whole) < 2:
        return None
    first = whole[0][:, :-1, -1]
    return max(float(np.linalg.norm(poses[:, :-1, -1] - first, axis=1).max()) for poses in whole[1:])


def _or_none(metric: Callable[[], Answer]) -> Answer | None:
    """The metric, or None where the path is too short for it."""
    try:
        return metric()
    except InputError:
        return None
