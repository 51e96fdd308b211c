"""Results of a comparison: figures of its methods, tables of scans and relations, a folder for each method."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w
from numpy.typing import NDArray

from scanchain import evaluation, lie
from scanchain.comparison.evalio_pipelines import entry_of
from scanchain.comparison.methods import Method
from scanchain.comparison.processes import CLOSURES_FILE, STEPS_FILE, Outcome, Status, StoredScans
from scanchain.comparison.table import COLUMNS, Row, Table
from scanchain.data import Points, Pose, Trajectory
from scanchain.errors import InputError, at_most
from scanchain.evaluation import ExpectedError
from scanchain.logs import Log
from scanchain.maps import write_ply
from scanchain.processes import MIB_PER_GIB, Limits
from scanchain.runs.evidence import evidence_of_trajectory
from scanchain.runs.judging import judge_run, known_of_run
from scanchain.runs.provenance import Provenance, package_version
from scanchain.runs.step_table import COLUMNS as NEES_COLUMNS
from scanchain.runs.step_table import nees_of_steps, pose_columns
from scanchain.trajectory import write_tum
from scanchain.verdict import Judged, Verdict, apart_m, judge

SCANS_FILE, RELATIONS_FILE = "per_scan.parquet", "per_relation.parquet"
SETTINGS_FILE, TRUTH_FILE = "settings.toml", "ground_truth.tum"
METHODS_FOLDER, MAP_FILE, TRAJECTORY_FILE = "methods", "map.ply", "trajectory.tum"
_PICTURE_POINTS = 150_000  # largest number of points of a method's map that is written
_INTERVALS = ((1.0, "s"), (10.0, "m"), (100.0, "m"))  # of the RPE
_NOTES = {
    "x y z qx qy qz qw": "final T_world_lidar of the method",
    "aligned_*": "the same position in the frame of the ground truth, as for the ATE",
    "seconds, cpu_seconds": "wall-clock and CPU time (all threads) of tracking the scan",
    "distance_m": "traveled up to the scan, by the method itself",
    "error_m, error_rad": "relative to the paired true pose, after alignment; null where there is none",
    "nees": "of the motion up to the scan; null where the method reports no covariance",
}


@dataclass(frozen=True, slots=True)
class Reference:
    """Reference of the errors: poses, relations, both or none; ``note`` names what is missing."""

    truth: Trajectory | None
    relations: evaluation.Relations | None
    source: str
    note: str


@dataclass(frozen=True, slots=True)
class Assessed:
    """Figures of a method over the N scans, by key of ``COLUMNS``, and scan by scan.

    T_reference_estimate : (4, 4) the alignment of the ATE; the true first pose of one that did not come to its
        end; the identity without truth
    by_scan : (N,) ``error_m``, ``error_rad`` and ``nees``, NaN where a scan has no paired true pose
    relations : None without any, or after a failure
    """

    figures: dict[str, float | None]
    T_reference_estimate: Pose
    by_scan: dict[str, NDArray[np.float64]]
    relations: evaluation.RelationError | None
    definitions: list[str]


def assess(outcomes: Sequence[Outcome], stamps_ns: NDArray[np.int64], reference: Reference) -> Assessed:
    """Figures of a method's runs over scans of these stamps: errors of the first whole one, times of all."""
    outcome, truth = representative(outcomes), reference.truth
    by_scan = {name: np.full(len(stamps_ns), np.nan) for name in ("error_m", "error_rad", "nees")}
    if not outcome.is_whole:
        return Assessed(_speed(outcomes), _start(stamps_ns, truth), by_scan, None, [])
    first, *others = (each.trajectory.poses[:, :-1, -1] for each in outcomes if each.is_whole)
    apart_m = max((float(np.linalg.norm(each - first, axis=1).max()) for each in others), default=None)
    figures: dict[str, float | None] = _speed(outcomes) | {"repeats_apart_m": apart_m}
    error, definitions = None, []
    if reference.relations is not None:
        error = evaluation.relation_error(outcome.trajectory, reference.relations)
        figures |= {"relations_m": error.translation_m.mean, "relations_rad": error.rotation_rad.mean}
        definitions.append(error.definition)
    pairs = None if truth is None else evaluation.pair(outcome.trajectory, truth)
    if truth is None or pairs is None or len(pairs) < 2:  # one pose has no error after alignment
        return Assessed(figures, np.eye(4), by_scan, error, definitions)
    whole, pairs = pairs, pairs.after_start
    ate = evaluation.absolute_error_of_any_path(pairs)
    aligned = ate.T_reference_estimate @ whole.estimate
    by_scan["error_m"][whole.places] = np.linalg.norm((whole.reference - aligned)[:, :3, 3], axis=1)
    by_scan["error_rad"][pairs.places] = ate.errors_rad
    if (steps := _steps(outcome, *NEES_COLUMNS)) is not None:
        by_scan["nees"] = nees_of_steps(steps, Trajectory(stamps_ns, outcome.odometry), truth)
    nees = by_scan["nees"]
    figures |= {
        "ate_m": ate.translation_m.rmse,
        "start_m": whole.start_error_m,
        "ate_share": ate.share_of_path,
        "ate_rotation_rad": ate.rotation_rad.rmse,
        "paired_share": whole.share,
        "nees": float(np.nanmean(nees)) if np.isfinite(nees).any() else None,
    }
    relative, _ = evaluation.relative_errors(pairs, _INTERVALS)
    for name, each in relative.items():
        if isinstance(each, evaluation.KittiError):
            figures |= {"kitti_share": each.translation_share, "kitti_rad_per_m": each.rotation_rad_per_m}
        else:
            figures[f"{name}_m"] = each.translation_m.rmse
    definitions += [each.definition for each in (ate, *relative.values())]
    return Assessed(
        figures, ate.T_reference_estimate, by_scan, error, [*definitions, f"Paired: {pairs.description}"]
    )


def representative(outcomes: Sequence[Outcome]) -> Outcome:
    """The first whole run, else the first."""
    return next((outcome for outcome in outcomes if outcome.is_whole), outcomes[0])


def _steps(outcome: Outcome, *columns: str) -> pa.Table | None:
    """Columns of the table that only our methods write."""
    path = outcome.folder / STEPS_FILE
    return pq.read_table(path, columns=list(columns)) if path.exists() else None


def _start(stamps_ns: NDArray[np.int64], truth: Trajectory | None) -> Pose:
    """True first pose of a method that begins with the identity."""
    with suppress(InputError):  # the truth begins later
        if truth is not None:
            return evaluation.pair(Trajectory(stamps_ns[:1], np.eye(4)[None]), truth).reference[0]
    return np.eye(4)


def _speed(outcomes: Sequence[Outcome]) -> dict[str, float | None]:
    """Times over all finished runs; the first scan of each is reported separately."""
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
    """Seconds by stage of a method that reports them; the mean for loops, on which most scans spend no time."""
    table = _steps(outcome, "preprocess_s", "match_s", "map_s", "loops_s")
    if table is None or len(table) < 2:
        return {}
    seconds = {name: table[name].to_numpy()[1:] for name in table.column_names}
    loops = seconds.pop("loops_s")
    medians = {name: float(np.median(each)) for name, each in seconds.items()}
    return medians | ({"loops_s": float(loops.mean())} if loops.any() else {})


@dataclass(frozen=True, slots=True)
class Results:
    """All runs of all methods by name, the figures of each, and the map (M, d) of each finished one."""

    methods: Sequence[Method]
    scans: StoredScans
    outcomes: Mapping[str, list[Outcome]]
    assessed: Mapping[str, Assessed]
    maps: Mapping[str, Points]
    reference: Reference


def results_of(
    methods: Sequence[Method], scans: StoredScans, outcomes: Mapping[str, list[Outcome]], reference: Reference
) -> Results:
    """Figures and maps of all methods."""
    assessed = {name: assess(runs, scans.stamps_ns, reference) for name, runs in outcomes.items()}
    step, chosen = evaluation.sampling_step(int(scans.points.sum())), map(representative, outcomes.values())
    maps = {
        name: evaluation.sampled_map(scans.scans(), outcome.trajectory, step)
        for name, outcome in zip(outcomes, chosen, strict=True)
        if outcome.is_whole
    }
    return Results(methods, scans, outcomes, assessed, maps, reference)


def write_results(folder: Path, results: Results) -> None:
    """Write the per-scan tables, and a folder per method with trajectory, map, tables, and its output."""
    scans, relations = _scans(results).replace_schema_metadata(_NOTES), _relations(results.assessed)
    pq.write_table(scans, folder / SCANS_FILE, compression="zstd")
    if relations:
        pq.write_table(pa.concat_tables(relations), folder / RELATIONS_FILE, compression="zstd")
    if results.reference.truth is not None:
        write_tum(folder / TRUTH_FILE, evaluation.during(results.reference.truth, results.scans.stamps_ns))
    settings = {method.name: {"method": method.base} | method.settings for method in results.methods}
    (folder / SETTINGS_FILE).write_text(tomli_w.dumps(settings), encoding="utf-8")
    for method in results.methods:
        _write_method(method_folder(folder, method.name), results, method.name)


def method_folder(folder: Path, name: str) -> Path:
    """Folder of a method's files."""
    return folder / METHODS_FOLDER / quote(name, safe="+ ")


def _write_method(own: Path, results: Results, name: str) -> None:
    outcome, T = representative(results.outcomes[name]), results.assessed[name].T_reference_estimate
    own.mkdir(parents=True)
    if outcome.is_whole:
        write_tum(own / TRAJECTORY_FILE, outcome.trajectory)
    if name in results.maps:
        points = results.maps[name]
        some = points[:: max(1, -(-len(points) // _PICTURE_POINTS))]
        write_ply(own / MAP_FILE, lie.transform(lie.flatten(T) if points.shape[1] == 2 else T, some))
    for file in (STEPS_FILE, CLOSURES_FILE, "output.txt"):
        source = outcome.folder / file
        if source.exists() and source.stat().st_size:
            shutil.copy(source, own / file)


def _relations(assessed: Mapping[str, Assessed]) -> list[pa.Table]:
    tables = []
    for name, each in assessed.items():
        if (error := each.relations) is not None:
            columns = {"relation": error.used, "error_m": error.errors_m, "error_rad": error.errors_rad}
            tables.append(pa.table({"method": pa.array([name] * len(error.used), pa.string())} | columns))
    return tables


def _scans(results: Results) -> pa.Table:
    """The scans of all runs, each run with its own errors; failed runs up to the failure."""
    tables = []
    for name, outcomes in results.outcomes.items():
        for repeat, outcome in enumerate(outcomes):
            assessed = results.assessed[name]
            if outcome is not representative(outcomes):
                assessed = assess([outcome], results.scans.stamps_ns, results.reference)
            tables.append(_table(name, repeat, outcome, assessed, results.scans.stamps_ns))
    return pa.concat_tables(tables)


def _table(name: str, repeat: int, outcome: Outcome, assessed: Assessed, stamps_ns: NDArray[np.int64]) -> pa.Table:
    """The scans of a run with their final poses, or with what there is of one that failed."""
    poses = outcome.trajectory.poses if len(outcome.trajectory) else outcome.odometry
    broken = np.flatnonzero(~np.isfinite(poses).reshape(len(poses), -1).all(axis=1))
    poses = lie.lift(poses[: broken[0]] if len(broken) else poses)
    count = len(poses)
    aligned = (assessed.T_reference_estimate @ poses)[:, :3, 3]
    steps = _steps(outcome, "observability")
    observability = np.full(count, np.nan) if steps is None else steps["observability"].to_numpy()
    numbers = {
        "seconds": outcome.seconds,
        "cpu_seconds": outcome.cpu_seconds,
        **pose_columns(poses),
        **{f"aligned_{axis}": aligned[:, place] for place, axis in enumerate("xyz")},
        "distance_m": evaluation.path_length(poses) if count else np.empty(0),
        **assessed.by_scan,
        "observability": observability,
    }
    columns = {
        "method": pa.array([name] * count, pa.string()),
        "repeat": pa.array([repeat] * count, pa.int64()),
        "index": pa.array(np.arange(count)),
        "stamp_ns": pa.array(stamps_ns[:count]),
        **{key: pa.array(values[:count], pa.float64(), from_pandas=True) for key, values in numbers.items()},
    }
    return pa.table(columns)


Apart = Mapping[str, Mapping[str, float]]  # by the names of two methods, meters between their trajectories


def _apart(whole: Mapping[str, Outcome]) -> Apart:
    """From the second scan on, as for the ATE."""
    positions = {
        name: each.trajectory.poses[min(1, len(each.trajectory) - 1) :, :-1, -1] for name, each in whole.items()
    }
    return {
        name: {other: apart_m(each, positions[other]) for other in whole if other != name}
        for name, each in positions.items()
    }


def judged(whole: Mapping[str, Outcome], scans: StoredScans, away_m: Apart) -> dict[str, Judged]:
    """The verdict on each whole run: on ours by all that is known, on others by wheels and constant velocity.

    The error of others is bounded by the wheels, or by the distance to one of ours plus its error bar, and is no
    less than the median distance to all others. Where the other trajectories contradict an error bar of ours, the
    verdict is to check it.
    """
    found = {name: judge_run(each.folder) for name, each in whole.items() if (each.folder / STEPS_FILE).exists()}
    expected = {
        name: error for name in found if (error := known_of_run(whole[name].folder).expected_ate_m) is not None
    }
    for name, error in expected.items():
        if found[name].verdict is Verdict.TRUSTWORTHY and (why := _contradiction(name, error, expected, away_m)):
            found[name] = replace(found[name], verdict=Verdict.CHECK, reason=why)
    wheels = scans.wheels @ scans.T_base_lidar
    for name in [name for name in whole if name not in found]:
        usual_m = float(np.median(list(away_m[name].values()))) if away_m[name] else 0.0
        bounds_m = {
            ours: max(away_m[name][ours] + error.high, usual_m)
            for ours, error in expected.items()
            if found[ours].verdict is Verdict.TRUSTWORTHY
        }
        trajectory = whole[name].trajectory
        found[name] = judge(evidence_of_trajectory(trajectory, scans.log_times_ns, wheels, scans.points, bounds_m))
    return found


def _contradiction(name: str, error: ExpectedError, expected: Mapping[str, ExpectedError], away_m: Apart) -> str:
    """Why the other trajectories contradict an error bar: another's that excludes it, or several that agree."""
    for other, bar in expected.items():
        if other != name and away_m[name][other] > error.high + bar.high:
            return (
                f"{at_most(away_m[name][other])} m from {other}, more than the error bars of both "
                f"({at_most(error.high)} and {at_most(bar.high)} m)"
            )
    others = list(away_m[name])
    among_m = [away_m[a][b] for a, b in combinations(others, 2)]
    usual_m = float(np.median(list(away_m[name].values()))) if others else 0.0
    if not among_m or usual_m <= error.high + np.median(among_m):
        return ""
    return (
        f"{at_most(usual_m)} m from the other {len(others)} methods, which are "
        f"{at_most(float(np.median(among_m)))} m from each other (medians)"
    )


def summarize(results: Results, log: Log, limits: Limits, provenance: Provenance) -> Table:
    """Every method's row, with figures that depend on all of them: sharpness and disagreement."""
    scans, maps = results.scans, results.maps
    chosen = {method.name: representative(results.outcomes[method.name]) for method in results.methods}
    apart_m = evaluation.disagreement([each.trajectory.poses for each in chosen.values()])
    more: dict[str, dict[str, float | None]] = {name: {} for name in chosen}
    for name, sharp in zip(maps, evaluation.sharpness(list(maps.values())) if maps else (), strict=True):
        if sharp is not None:
            more[name] |= {"thickness_m": sharp.thickness_m, "entropy": sharp.mean_map_entropy}
    for place, name in enumerate(chosen):
        others_m = np.delete(apart_m[place], place)
        if np.isfinite(others_m).any():
            more[name]["disagreement_m"] = float(np.nanmedian(others_m))
    whole = {name: outcome for name, outcome in chosen.items() if outcome.is_whole}
    away_m = _apart(whole)
    for name, others in away_m.items():
        more[name]["apart_m"] = float(np.median(list(others.values()))) if others else None
    judgments = judged(whole, scans, away_m)
    for name, judgment in judgments.items():
        ate_m = results.assessed[name].figures.get("ate_m")
        if judgment.verdict is Verdict.TRUSTWORTHY and ate_m is not None and ate_m > judgment.bound_m:
            why = f"the ground truth refutes {judgment.error}: ATE {ate_m:.4f} m"
            judgments[name] = replace(judgment, verdict=Verdict.CHECK, reason=why, error="")
    rows = [_row(results, method, more[method.name], judgments.get(method.name)) for method in results.methods]
    entries = [entry_of(method.base) for method in results.methods]
    packages = sorted({entry.package for entry in entries if entry is not None})
    return Table(
        log=", ".join(str(path) for path in log.paths),
        topic=log.topic,
        dimension=scans.dimension,
        scans=len(scans),
        points_per_scan=float(scans.points.mean()),
        repeats=max(len(runs) for runs in results.outcomes.values()),
        truth=results.reference.source,
        truth_note=results.reference.note,
        rows=rows,
        disagreement_m=[[value if np.isfinite(value) else None for value in row] for row in apart_m.tolist()],
        notes=[
            f"a run is stopped at its limits: {limits.time_s:,.0f} s, {limits.memory_mib / MIB_PER_GIB:.1f} GiB",
            *log.notes,
            *log.damage,
        ],
        provenance=provenance,
        baselines={  # a package may be installed as its variant without CUDA
            name: package_version(name) or package_version(f"{name}-cpu") for name in packages
        },
    )


def _row(results: Results, method: Method, more: dict[str, float | None], judgment: Judged | None) -> Row:
    outcomes, assessed = results.outcomes[method.name], results.assessed[method.name]
    ended = [outcome.report for outcome in outcomes]
    end = next((report for report in ended if report.status is not Status.OK), ended[0])
    figures = assessed.figures | more
    return Row(
        name=method.name,
        base=method.base,
        status=end.status,
        reason=end.reason,
        description=representative(outcomes).report.description,
        settings=method.settings,
        figures={column.key: figures.get(column.key) for column in COLUMNS},
        definitions=assessed.definitions,
        verdict="" if judgment is None else str(judgment.verdict),
        verdict_reason="" if judgment is None else judgment.reason,
        verdict_error="" if judgment is None else judgment.error,
    )
