"""per_scan.parquet, one row a scan, a method and a run of it; per_relation.parquet, one a relation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.comparison.judging import Judged, observability
from scanchain.comparison.outcome import Outcome
from scanchain.data import Matrix
from scanchain.evaluation.absolute import path_length
from scanchain.runs.step_table import pose_columns

_NOTES = {
    "x y z qx qy qz qw": "T_world_lidar as the method has it in the end",
    "aligned_*": "the same position in the frame of the ground truth, as for the ATE",
    "seconds, cpu_seconds": "tracking the scan, on the clock and by all threads together",
    "distance_m": "traveled up to the scan, by the method itself",
    "error_m, error_rad": "against the true pose beside it, after alignment; null where there is none",
    "nees": "of the motion up to the scan; null where the method does not tell its covariance",
}


@dataclass(frozen=True, slots=True)
class RunOfMethod:
    """A run of a method, and what was found of it."""

    name: str
    repeat: int
    outcome: Outcome
    judged: Judged


def write_scans(path: Path, runs: Sequence[RunOfMethod], stamps_ns: NDArray[np.int64]) -> None:
    """Write the scans of all runs, those that failed up to where they came."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables = [pa.table(_columns(run, stamps_ns)) for run in runs]
    pq.write_table(pa.concat_tables(tables).replace_schema_metadata(_NOTES), path, compression="zstd")


def write_relations(path: Path, judged: Mapping[str, Judged]) -> None:
    """Write the errors over relations, where there are any."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    errors = {name: each.relations for name, each in judged.items() if each.relations is not None}
    tables = [
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
    if tables:
        pq.write_table(pa.concat_tables(tables), path, compression="zstd")


def final_poses(outcome: Outcome) -> Matrix:
    """(M, 4, 4) the last word, or what there is of a run that failed."""
    poses = outcome.trajectory.poses if len(outcome.trajectory) else outcome.odometry
    broken = np.flatnonzero(~np.isfinite(poses).reshape(len(poses), -1).all(axis=1))
    return lie.lift(poses[: broken[0]] if len(broken) else poses)


def _columns(run: RunOfMethod, stamps_ns: NDArray[np.int64]) -> dict[str, object]:
    import pyarrow as pa

    poses = final_poses(run.outcome)
    count = len(poses)
    aligned = (run.judged.T_reference_estimate @ poses)[:, :3, 3]
    known = observability(run.outcome)
    known = known[:count] if len(known) else np.full(count, np.nan)
    traveled_m = path_length(poses) if count else np.empty(0)
    numbers = {
        "seconds": run.outcome.seconds[:count],
        "cpu_seconds": run.outcome.cpu_seconds[:count],
        **pose_columns(poses),
        **{f"aligned_{axis}": aligned[:, place] for place, axis in enumerate("xyz")},
        "distance_m": traveled_m,
        "error_m": run.judged.errors_m[:count],
        "error_rad": run.judged.errors_rad[:count],
        "nees": run.judged.nees[:count],
        "observability": known,
    }
    return {
        "method": pa.array([run.name] * count, pa.string()),
        "repeat": pa.array([run.repeat] * count, pa.int64()),
        "index": pa.array(np.arange(count)),
        "stamp_ns": pa.array(stamps_ns[:count]),
        **{name: pa.array(values, pa.float64(), from_pandas=True) for name, values in numbers.items()},
    }
