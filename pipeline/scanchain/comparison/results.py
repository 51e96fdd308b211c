"""Results of a comparison, and its files beside the table: tables of scans and relations, a folder a method."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w
from numpy.typing import NDArray

from scanchain import lie
from scanchain.comparison.figures import Assessed, assess, observability, representative
from scanchain.comparison.methods import Method
from scanchain.comparison.processes import CLOSURES_FILE, STEPS_FILE, Outcome, StoredScans
from scanchain.data import Matrix, Points, Trajectory
from scanchain.evaluation import Relations, during
from scanchain.evaluation.absolute import path_length
from scanchain.maps import write_ply
from scanchain.runs.step_table import pose_columns
from scanchain.trajectory import write_tum

SCANS_FILE, RELATIONS_FILE = "per_scan.parquet", "per_relation.parquet"
SETTINGS_FILE, TRUTH_FILE = "settings.toml", "ground_truth.tum"
_PICTURE_POINTS = 150_000
METHODS_FOLDER, MAP_FILE, TRAJECTORY_FILE = "methods", "map.ply", "trajectory.tum"
_NOTES = {
    "x y z qx qy qz qw": "final T_world_lidar of the method",
    "aligned_*": "the same position in the frame of the ground truth, as for the ATE",
    "seconds, cpu_seconds": "tracking the scan, on the clock and by all threads together",
    "distance_m": "traveled up to the scan, by the method itself",
    "error_m, error_rad": "against the true pose beside it, after alignment; null where there is none",
    "nees": "of the motion up to the scan; null where the method reports no covariance",
}


@dataclass(frozen=True, slots=True)
class Reference:
    """Reference of the errors: poses, relations, both or none; ``note`` names what is missing."""

    truth: Trajectory | None
    relations: Relations | None
    source: str
    note: str


@dataclass(frozen=True, slots=True)
class Results:
    """All runs of all methods by name, the figures of each, and the map (M, d) of each finished one."""

    methods: Sequence[Method]
    scans: StoredScans
    outcomes: Mapping[str, list[Outcome]]
    assessed: Mapping[str, Assessed]
    maps: Mapping[str, Points]
    reference: Reference


def write_results(folder: Path, results: Results) -> None:
    """Everything scan by scan, and a folder a method with trajectory, map, tables, and what it printed."""
    _write_tables(folder / SCANS_FILE, _scans(results), _NOTES)
    _write_tables(folder / RELATIONS_FILE, _relations(results.assessed))
    if results.reference.truth is not None:
        write_tum(folder / TRUTH_FILE, during(results.reference.truth, results.scans.stamps_ns))
    settings = {method.name: {"method": method.base} | method.settings for method in results.methods}
    (folder / SETTINGS_FILE).write_text(tomli_w.dumps(settings), encoding="utf-8")
    for method in results.methods:
        _write_method(method_folder(folder, method.name), results, method.name)


def method_folder(folder: Path, name: str) -> Path:
    """Folder of a method's files."""
    return folder / METHODS_FOLDER / quote(name, safe="+ ")


def _write_method(own: Path, results: Results, name: str) -> None:
    outcome, assessed = representative(results.outcomes[name]), results.assessed[name]
    own.mkdir(parents=True)
    if outcome.is_whole:
        write_tum(own / TRAJECTORY_FILE, outcome.trajectory)
    if name in results.maps:
        write_ply(own / MAP_FILE, _picture_points(results.maps[name], assessed))
    for file in (STEPS_FILE, CLOSURES_FILE, "output.txt"):
        source = outcome.folder / file
        if source.exists() and source.stat().st_size:
            shutil.copy(source, own / file)


def _write_tables(path: Path, tables: Sequence[pa.Table], notes: Mapping[str, str] | None = None) -> None:
    """Write tables one below the other, where there are any."""
    if tables:
        pq.write_table(pa.concat_tables(tables).replace_schema_metadata(notes), path, compression="zstd")


def _scans(results: Results) -> list[pa.Table]:
    """The scans of all runs, each with its own errors, those that failed up to where they came."""
    stamps_ns, truth = results.scans.stamps_ns, results.reference.truth
    tables = []
    for name, outcomes in results.outcomes.items():
        for repeat, outcome in enumerate(outcomes):
            is_representative = outcome is representative(outcomes)
            assessed = results.assessed[name] if is_representative else assess([outcome], stamps_ns, truth, None)
            tables.append(_table(name, repeat, outcome, assessed, stamps_ns))
    return tables


def _relations(assessed: Mapping[str, Assessed]) -> list[pa.Table]:
    """The errors over relations, method by method."""
    errors = {name: each.relations for name, each in assessed.items() if each.relations is not None}
    return [
        pa.table(
            {
                "method": pa.array([name] * len(error.used), pa.string()),
                "relation": error.used,
                "error_m": error.errors_m,
                "error_rad": error.errors_rad,
            }
        )
        for name, error in errors.items()
    ]


def _final_poses(outcome: Outcome) -> Matrix:
    """(M, 4, 4) the final poses, or what there is of a run that failed."""
    poses = outcome.trajectory.poses if len(outcome.trajectory) else outcome.odometry
    broken = np.flatnonzero(~np.isfinite(poses).reshape(len(poses), -1).all(axis=1))
    return lie.lift(poses[: broken[0]] if len(broken) else poses)


def _table(name: str, repeat: int, outcome: Outcome, assessed: Assessed, stamps_ns: NDArray[np.int64]) -> pa.Table:
    poses = _final_poses(outcome)
    count = len(poses)
    aligned = (assessed.T_reference_estimate @ poses)[:, :3, 3]
    known = observability(outcome)
    known = known[:count] if len(known) else np.full(count, np.nan)
    traveled_m = path_length(poses) if count else np.empty(0)
    numbers = {
        "seconds": outcome.seconds[:count],
        "cpu_seconds": outcome.cpu_seconds[:count],
        **pose_columns(poses),
        **{f"aligned_{axis}": aligned[:, place] for place, axis in enumerate("xyz")},
        "distance_m": traveled_m,
        "error_m": assessed.errors_m[:count],
        "error_rad": assessed.errors_rad[:count],
        "nees": assessed.nees[:count],
        "observability": known,
    }
    columns = {
        "method": pa.array([name] * count, pa.string()),
        "repeat": pa.array([repeat] * count, pa.int64()),
        "index": pa.array(np.arange(count)),
        "stamp_ns": pa.array(stamps_ns[:count]),
        **{name: pa.array(values, pa.float64(), from_pandas=True) for name, values in numbers.items()},
    }
    return pa.table(columns)


def _picture_points(points: Points, assessed: Assessed) -> Points:
    """Some of a map's points (M, 3), in the frame of the ground truth where there is one."""
    downsampled = points[:: max(1, -(-len(points) // _PICTURE_POINTS))]
    T = assessed.T_reference_estimate
    if points.shape[1] == 2:
        T = lie.flatten(T)
    return lie.transform(T, downsampled)
