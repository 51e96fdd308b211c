"""Figures of methods: against ground truth and relations, and times; their columns in tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyarrow.parquet as pq
from msgspec import Struct
from numpy.typing import NDArray

from scanchain.comparison.processes import STEPS_FILE, Outcome, StoredScans
from scanchain.data import Matrix, Pose, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import (
    KittiError,
    RelationError,
    Relations,
    absolute_error_of_any_path,
    pair,
    relation_error,
    relative_errors,
)
from scanchain.runs.step_table import COLUMNS as STEP_COLUMNS
from scanchain.runs.step_table import nees_of_steps
from scanchain.runs.vouching import evidence_of_trajectory, expected_of_run, judge_run
from scanchain.verdict import Judged, Verdict, apart_m, judge

Figures = Mapping[str, float | None]  # by key of COLUMNS; unknown without a reference, or after a failure


class Shown(Struct, frozen=True):
    """A figure as text, – where there is none; True if it is the best of its column."""

    text: str
    is_best: bool


class Column(Struct, frozen=True):
    """Presentation of a figure.

    Attributes
    ----------
    key : of the figure
    head, unit : what stands above it
    scale : from the figure's unit to the shown one
    digits : after the point, at most
    better : which values are marked as the best; none of a figure that is not about accuracy or cost, as the NEES
        of a bad method may be near 1
    table : the summary, which the short tables are, or one of the two that hold the rest
    definition : its meaning, in a sentence
    """

    key: str
    head: str
    unit: str
    scale: float
    digits: int
    better: Literal["low", "high", ""]
    table: Literal["summary", "accuracy", "time"]
    definition: str

    @property
    def heading(self) -> str:
        """Head with its unit."""
        return f"{self.head} [{self.unit}]" if self.unit else self.head

    def of(self, figures: Figures) -> float | None:
        """The shown value of a row."""
        value = figures.get(self.key)
        return None if value is None else self.scale * value

    def cells(self, rows: Sequence[Figures]) -> list[Shown]:
        """The figures of a table's rows; none is the best where all that are known are equal as text."""
        values = [self.of(row) for row in rows]
        digits = self._digits([abs(value) for value in values if value])
        badness = [None if value is None else self._badness(round(value, digits)) for value in values]
        known = {each for each in badness if each is not None}
        is_contest = bool(self.better) and len(known) > 1
        return [
            Shown("–", False) if value is None else Shown(f"{value:.{digits}f}", is_contest and each == min(known))
            for value, each in zip(values, badness, strict=True)
        ]

    def _digits(self, sizes: list[float]) -> int:
        """As many as the smallest needs for three figures."""
        return min(self.digits, max(0, 2 - math.floor(math.log10(min(sizes))))) if sizes else self.digits

    def _badness(self, shown: float) -> float:
        return {"low": shown, "high": -shown, "": 0.0}[self.better]


_DEGREES = 57.29577951308232

COLUMNS = (
    Column("ate_m", "ATE", "m", 1.0, 4, "low", "summary",
        "rmse of positions after rigid alignment, without scale"),
    Column("ate_share", "ATE/path", "%", 100.0, 3, "low", "accuracy", "the same over the length of the path"),
    Column("ate_rotation_rad", "ATE rot.", "deg", _DEGREES, 3, "low", "accuracy",
        "rmse of the angle after alignment"),
    Column("rpe_1_s_m", "RPE 1 s", "mm", 1e3, 1, "low", "summary", "rmse of the motion over 1 s"),
    Column("rpe_10_m_m", "RPE 10 m", "mm", 1e3, 1, "low", "accuracy",
        "rmse of the motion over 10 m of the true path"),
    Column("rpe_100_m_m", "RPE 100 m", "mm", 1e3, 1, "low", "accuracy", "rmse of the motion over 100 m"),
    Column("kitti_share", "KITTI", "%", 100.0, 3, "low", "summary",
        "mean drift over 100 to 800 m, short paths 10 to 40 m"),
    Column("kitti_rad_per_m", "KITTI rot.", "deg/m", _DEGREES, 4, "low", "accuracy",
        "mean turn per meter over the same"),
    Column("paired_share", "paired", "%", 100.0, 1, "", "accuracy",
        "share of the scans that have a true pose, interpolated or not"),
    Column("relations_m", "relations", "m", 1.0, 4, "low", "summary",
        "mean absolute error over manually verified relations"),
    Column("relations_rad", "relations", "deg", _DEGREES, 3, "low", "summary", "the same, of the angle"),
    Column("nees", "NEES", "", 1.0, 2, "", "accuracy",
        "squared error of a motion over its covariance; 1 is exact"),
    Column("thickness_m", "surfaces", "mm", 1e3, 2, "low", "summary",
        "thickness of the map's surfaces; needs no ground truth"),
    Column("entropy", "entropy", "nats", 1.0, 3, "low", "accuracy", "mean map entropy; needs no ground truth"),
    Column("disagreement_m", "to others", "mm", 1e3, 1, "", "summary",
        "median distance of a motion to that of the other methods"),
    Column("median_s", "time", "ms", 1e3, 2, "low", "summary", "median time of a scan, all but the first"),
    Column("p95_s", "p95", "ms", 1e3, 2, "low", "summary", "95th percentile of the same"),
    Column("cpu_s", "CPU", "ms", 1e3, 2, "low", "summary", "median CPU time of a scan, all threads together"),
    Column("first_s", "first", "ms", 1e3, 1, "low", "time",
        "time of the first scan, everything compiled and loaded"),
    Column("scans_per_s", "rate", "scans/s", 1.0, 1, "high", "time", "scans over the sum of their times"),
    Column("preprocess_s", "preprocess", "ms", 1e3, 2, "", "time",
        "median of cropping and downsampling, reported by our methods only"),
    Column("match_s", "match", "ms", 1e3, 2, "", "time", "median of matching"),
    Column("map_s", "map", "ms", 1e3, 2, "", "time", "median of extending the local map"),
    Column("loops_s", "loops", "ms", 1e3, 2, "", "time", "mean of keyframes, loop closures and optimizations"),
    Column("start_s", "start", "s", 1.0, 1, "", "time", "import, loading what is compiled, warming up"),
    Column("finish_s", "finish", "s", 1.0, 2, "", "time", "after the last scan: optimization, tables"),
    Column("peak_mib", "memory", "MiB", 1.0, 0, "low", "summary",
        "peak of the process, interpreter and packages included"),
    Column("repeats_apart_m", "repeats", "m", 1.0, 4, "low", "accuracy",
        "largest distance between runs of the same method"),
)  # fmt: skip


def columns_of(rows: Sequence[Figures], table: str) -> list[Column]:
    """The columns of a table with a figure in at least one row."""
    return [
        column for column in COLUMNS if column.table == table and any(column.of(row) is not None for row in rows)
    ]


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
    figures["repeats_apart_m"] = _apart(outcomes)
    error = None if relations is None else relation_error(outcome.trajectory, relations)
    if error is not None:
        figures |= {"relations_m": error.translation_m.mean, "relations_rad": error.rotation_rad.mean}
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
    others = relative_errors(pairs, ((1.0, "s"), (10.0, "m"), (100.0, "m")))[0]
    nees = _nees(outcome, truth)
    errors_m, errors_rad = assessed.errors_m.copy(), assessed.errors_rad.copy()
    errors_m[pairs.places], errors_rad[pairs.places] = ate.errors_m, ate.errors_rad
    figures = {
        **assessed.figures,
        "ate_m": ate.translation_m.rmse,
        "ate_share": ate.share_of_path,
        "ate_rotation_rad": ate.rotation_rad.rmse,
        "paired_share": pairs.share,
        "nees": float(np.nanmean(nees)) if np.isfinite(nees).any() else None,
    }
    for name, error in others.items():
        if isinstance(error, KittiError):
            figures |= {"kitti_share": error.translation_share, "kitti_rad_per_m": error.rotation_rad_per_m}
        else:
            figures[f"{name}_m"] = error.translation_m.rmse
    found = (each.definition for each in (ate, *others.values()))
    definitions = (*assessed.definitions, *found, f"Paired: {pairs.description}")
    return Assessed(figures, ate.T_reference_estimate, errors_m, errors_rad, nees, assessed.relations, definitions)


def _nees(outcome: Outcome, truth: Trajectory) -> NDArray[np.float64]:
    """(N,) of the motion up to each scan; NaN if the method does not report covariances."""
    path = outcome.folder / STEPS_FILE
    if not path.exists():
        return np.full(len(outcome.seconds), np.nan)
    odometry = Trajectory(outcome.trajectory.stamps_ns, outcome.odometry)
    return nees_of_steps(pq.read_table(path, columns=list(STEP_COLUMNS)), odometry, truth)


def _speed(outcomes: Sequence[Outcome]) -> dict[str, float | None]:
    """From all runs that came to their end; the first scan of each stands apart."""
    whole = [outcome for outcome in outcomes if outcome.is_whole]
    if not whole:
        peak = max(outcome.report.peak_mib for outcome in outcomes)
        return {"peak_mib": peak} if outcomes[0].report.status.is_failure and peak else {}
    first = min(1, len(whole[0].seconds) - 1)
    rest = np.concatenate([outcome.seconds[first:] for outcome in whole])
    cpu = np.concatenate([outcome.cpu_seconds[first:] for outcome in whole])
    return {
        "median_s": float(np.median(rest)),
        "p95_s": float(np.percentile(rest, 95.0)),
        "cpu_s": float(np.median(cpu)),
        "first_s": float(np.median([outcome.seconds[0] for outcome in whole])),
        "scans_per_s": float(len(rest) / rest.sum()),
        **_stages(whole[0]),
        "start_s": float(np.median([outcome.report.start_s for outcome in whole])),
        "finish_s": float(np.median([outcome.report.finish_s for outcome in whole])),
        "peak_mib": max(outcome.report.peak_mib for outcome in whole),
    }


def _stages(outcome: Outcome) -> dict[str, float]:
    """Seconds by stage of a method that reports them; the mean for loops, most scans of which take nothing."""
    path = outcome.folder / STEPS_FILE
    if not path.exists():
        return {}
    table = pq.read_table(path, columns=["preprocess_s", "match_s", "map_s", "loops_s"])
    seconds = {name: table[name].to_numpy()[1:] for name in table.column_names}
    loops = seconds.pop("loops_s")
    if not len(loops):
        return {}
    medians = {name: float(np.median(each)) for name, each in seconds.items()}
    return medians | ({"loops_s": float(loops.mean())} if loops.any() else {})


def _apart(outcomes: Sequence[Outcome]) -> float | None:
    """Largest distance between the positions of a scan in two runs."""
    whole: list[Matrix] = [outcome.trajectory.poses for outcome in outcomes if outcome.is_whole]
    if len(whole) < 2:
        return None
    first = whole[0][:, :-1, -1]
    return max(float(np.linalg.norm(poses[:, :-1, -1] - first, axis=1).max()) for poses in whole[1:])
