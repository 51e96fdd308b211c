"""Files of landmark problems: npz of the course and folders of MRCLAM in, results out."""

from __future__ import annotations

import csv
import math
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.landmarks.compare import MethodResult
from scanchain.landmarks.problem import Kind, LandmarkData
from scanchain.landmarks.study import Accuracy, Study
from scanchain.trajectory import write_tum
from scanchain.words import counted

_SHAPES = {
    "gt_traj": "(poses, 2)",
    "gt_landmarks": "(landmarks, 2)",
    "odom": "(poses - 1, 2)",
    "observations": "(observations, 4)",
    "sigma_odom": "(2, 2)",
    "sigma_landmark": "(2, 2)",
}
_TRUTH = ("gt_traj", "gt_landmarks")  # what a problem need not have


def read_landmark_data(path: Path) -> LandmarkData:
    """Read a problem; raises InputError for whatever is wrong with the file, pickled objects included.

    The file does not state whether its observations are relative positions or bearings and ranges: the one that
    the true positions fit better is taken, or that agree better with each other where the file has no truth.
    """
    arrays = _read(path)
    odometry, table = arrays["odom"], arrays["observations"]
    poses = arrays.get("gt_traj", np.empty((0, 2)))
    if len(poses) and len(odometry) != len(poses) - 1:
        raise InputError(
            f"{path}: odom has {counted(len(odometry), 'step')} "
            f"between {counted(len(poses), 'pose')} of gt_traj; it must have one less"
        )
    observed = _indices(path, table, len(odometry) + 1, len(arrays.get("gt_landmarks", ())))
    landmarks = arrays.get("gt_landmarks", np.full((int(observed[:, 1].max()) + 1, 2), np.nan))
    _check_observed(path, observed[:, 1], len(landmarks))
    reckoned = np.cumsum(np.vstack([np.zeros(2), odometry]), axis=0)
    return LandmarkData(
        name=path.stem,
        kind=_kind(path, poses if len(poses) else reckoned, landmarks, observed, table[:, 2:]),
        odometry=odometry,
        observed=observed,
        measured=np.ascontiguousarray(table[:, 2:]),
        odometry_covariance=_covariance(path, "sigma_odom", arrays),
        observation_covariance=_covariance(path, "sigma_landmark", arrays),
        true_poses=poses,
        true_landmarks=landmarks,
    )


def _read(path: Path) -> dict[str, Matrix]:
    """Every array by name, (·, c) float64 and finite."""
    try:
        with path.open("rb") as file:
            if file.read(2) != b"PK":
                raise InputError(f"{path}: is no npz file; a problem is one with {', '.join(_SHAPES)}")
        with np.load(path, allow_pickle=False) as file:
            missing = [name for name in _SHAPES if name not in file and name not in _TRUTH]
            if missing:
                raise InputError(f"{path}: has no array {missing[0]}; a problem has {', '.join(_SHAPES)}")
            return {name: _table(path, name, file[name]) for name in _SHAPES if name in file}
    except FileNotFoundError:
        raise InputError(f"{path}: does not exist; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the file") from None
    except (
        ValueError,
        EOFError,
        KeyError,
        zipfile.BadZipFile,
        zipfile.LargeZipFile,
        NotImplementedError,
    ) as error:
        reason = "it holds pickled objects" if "pickle" in str(error) else str(error)
        raise InputError(f"{path}: is no npz of plain arrays ({reason}); write it with numpy.savez") from None


def _table(path: Path, name: str, array: NDArray) -> Matrix:
    width = int(_SHAPES[name][-2])
    is_square = name.startswith("sigma")
    if array.ndim != 2 or array.shape[1] != width or (is_square and len(array) != 2):
        raise InputError(f"{path}: {name} has shape {array.shape}; it must have {_SHAPES[name]}")
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path}: {name} holds {array.dtype}; it must hold real numbers")
    if not len(array):
        raise InputError(f"{path}: {name} is empty; a problem needs at least one of each")
    result = array.astype(np.float64)
    bad = np.argwhere(~np.isfinite(result))
    if len(bad):
        raise InputError(f"{path}: {name}{bad[0].tolist()} is {result[tuple(bad[0])]}; it must be finite")
    return result


def _indices(path: Path, table: Matrix, poses: int, landmarks: int) -> NDArray[np.int64]:
    """Pose and landmark of every observation, (N, 2); ``landmarks`` is 0 where their number is not stated."""
    for column, name, count in ((0, "pose", poses), (1, "landmark", landmarks or len(table))):
        wrong = (
            (table[:, column] != np.floor(table[:, column])) | (table[:, column] < 0) | (table[:, column] >= count)
        )
        for row in np.flatnonzero(wrong)[:1]:
            raise InputError(
                f"{path}: observations[{row}] is of {name} {table[row, column]:g};"
                f" it must be a whole number from 0 to {count - 1}"
            )
    return table[:, :2].astype(np.int64)


def _check_observed(path: Path, seen: NDArray[np.int64], landmarks: int) -> None:
    """Refuse landmarks without an observation, which leaves them open."""
    open_ones = np.setdiff1d(np.arange(landmarks), seen)
    if len(open_ones):
        raise InputError(
            f"{path}: {len(open_ones)} of {counted(landmarks, 'landmark')} are not observed, the first is "
            f"{open_ones[0]}; add observations of them, or leave them out and number the others on"
        )


def _covariance(path: Path, name: str, arrays: dict[str, Matrix]) -> Matrix:
    matrix = arrays[name]
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0) or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise InputError(f"{path}: {name} is no covariance; it must be symmetric and positive definite")
    return matrix


def _kind(path: Path, poses: Matrix, landmarks: Matrix, observed: NDArray[np.int64], measured: Matrix) -> Kind:
    """Kind of the measurements: least median distance of the measured points from the landmarks.

    A landmark that is not known (NaN) lies at the median of its measured points. Raises InputError where the
    points fit bearings in degrees best, and where nothing tells.
    """
    bearing, reach = measured.T
    polar, by_degrees = (
        np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
        for angle in (bearing, np.radians(bearing))
    )
    as_linear, as_polar, as_degrees = (
        _spread(poses[observed[:, 0]] + relative, landmarks, observed[:, 1])
        for relative in (measured, polar, by_degrees)
    )
    largest = float(np.abs(bearing).max())
    if largest > 2.0 * np.pi and 2.0 * as_degrees < min(as_linear, as_polar):
        raise InputError(f"{path}: bearings of observations reach {largest:.6g}: degrees? give radians")
    if not np.isfinite(landmarks).all() and len(np.unique(observed[:, 1])) == len(observed):
        raise InputError(
            f"{path}: no landmark is observed twice and there is no gt_landmarks, so that nothing tells relative "
            "positions from bearings and ranges; add observations, or gt_landmarks"
        )
    return "linear" if as_linear <= as_polar else "bearing-range"


def _spread(points: Matrix, landmarks: Matrix, seen: NDArray[np.int64]) -> float:
    """Median distance of points (N, 2) from the landmarks that they are measurements of."""
    order = np.argsort(seen, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(seen[order])) + 1)
    middle = np.array([np.median(points[group], axis=0) for group in groups])  # every landmark is observed
    at = np.where(np.isfinite(landmarks), landmarks, middle)
    return float(np.median(np.linalg.norm(points - at[seen], axis=1)))


_ROBOTS = 5  # subjects 1 to 5 are robots, the others landmarks (Leung et al. 2011)


@dataclass(frozen=True, slots=True)
class RangeLog:
    """Log of one robot, in order of time.

    Attributes
    ----------
    name : of the folder and the robot
    times_s, velocities : (M,), (M, 2) wheel odometry: forward in m/s, turning in rad/s, whenever either changes
    seen_s, subjects, measured : (N,), (N,) landmark subjects, (N, 2) bearing in rad and range in m
    of_robots, unknown : observations left out: of other robots, and of barcodes that no subject has
    outside : observations left out since no odometry was logged at their time
    true_s, true_poses : (T,), (T, 3) motion capture x, y, heading; empty where the folder has none
    true_subjects, true_landmarks : (L,), (L, 2) surveyed landmarks; empty where the folder has none
    """

    name: str
    times_s: NDArray[np.float64]
    velocities: Matrix
    seen_s: NDArray[np.float64]
    subjects: NDArray[np.int64]
    measured: Matrix
    of_robots: int
    unknown: int
    outside: int
    true_s: NDArray[np.float64]
    true_poses: Matrix
    true_subjects: NDArray[np.int64]
    true_landmarks: Matrix


def read_mrclam(folder: Path, robot: int) -> RangeLog:
    """Log of robot ``robot``; raises InputError for whatever is missing or wrong."""
    if not (folder / "Barcodes.dat").is_file():
        raise InputError(
            f"{folder}: is no MRCLAM folder (Barcodes.dat is missing); name an npz file or such a folder"
        )
    name = f"Robot{robot}_Odometry.dat"
    if not (folder / name).is_file():
        there = sorted(
            int(found[0]) for file in folder.iterdir() if (found := re.findall(r"^Robot(\d+)_Odo", file.name))
        )
        listed = ", ".join(map(str, there)) or "none"
        raise InputError(f"{folder}: has no {name}; --robot must be one of those logged there: {listed}")
    odometry = _by_time(_numbers(folder / name, 3))
    measurements = folder / f"Robot{robot}_Measurement.dat"
    seen = _by_time(_numbers(measurements, 4))
    if (largest := float(np.abs(seen[:, 3]).max())) > 2.0 * np.pi:
        raise InputError(f"{measurements}: bearings reach {largest:.6g}: degrees? give radians")
    subject = _subjects(_numbers(folder / "Barcodes.dat", 2), seen[:, 1])
    timely = (seen[:, 0] >= odometry[0, 0]) & (seen[:, 0] <= odometry[-1, 0])
    used = (subject > _ROBOTS) & timely
    if not used.any():
        raise InputError(
            f"{folder}: robot {robot} saw no landmark while its odometry was logged; choose another robot"
        )
    changes = odometry[np.append(True, (np.diff(odometry[:, 1:], axis=0) != 0.0).any(axis=1))]
    truth = folder / f"Robot{robot}_Groundtruth.dat"
    true = _by_time(_numbers(truth, 4)) if truth.is_file() else np.empty((0, 4))
    survey = folder / "Landmark_Groundtruth.dat"
    landmarks = _numbers(survey, 5) if survey.is_file() else np.empty((0, 5))
    return RangeLog(
        name=f"{folder.resolve().name} robot {robot}",
        times_s=changes[:, 0],
        velocities=np.ascontiguousarray(changes[:, 1:]),
        seen_s=seen[used, 0],
        subjects=subject[used],
        measured=np.ascontiguousarray(seen[used][:, [3, 2]]),
        of_robots=int(((subject >= 1) & (subject <= _ROBOTS)).sum()),
        unknown=int((subject < 1).sum()),
        outside=int(((subject > _ROBOTS) & ~timely).sum()),
        true_s=true[:, 0],
        true_poses=true[:, 1:],
        true_subjects=landmarks[:, 0].astype(np.int64),
        true_landmarks=landmarks[:, 1:3],
    )


def _numbers(path: Path, columns: int) -> Matrix:
    """The numbers of a file, (rows, columns); what follows a # is a comment."""
    try:
        rows = [line for line in path.read_text(encoding="utf-8").splitlines() if line.partition("#")[0].strip()]
        table = np.loadtxt(rows, ndmin=2) if rows else np.empty((0, columns))
    except FileNotFoundError:
        raise InputError(f"{path}: does not exist; an MRCLAM folder needs it") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    except ValueError as error:
        raise InputError(f"{path}: is no table of {columns} numbers a line ({error}); check the file") from None
    if not table.size:
        raise InputError(f"{path}: is empty; it must have {columns} numbers a line")
    if table.shape[1] != columns:
        raise InputError(f"{path}: has {counted(table.shape[1], 'number')} a line; it must have {columns}")
    if not np.isfinite(table).all():
        row = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])
        raise InputError(f"{path}: row {row + 1} is not finite; correct or remove it")
    return table


def _by_time(table: Matrix) -> Matrix:
    return table[np.argsort(table[:, 0], kind="stable")]


def _subjects(barcodes: Matrix, seen: NDArray[np.float64]) -> NDArray[np.int64]:
    """Subject of each barcode seen, 0 where no subject has it."""
    subjects, codes = barcodes.astype(np.int64).T
    order = np.argsort(codes, kind="stable")
    at = np.minimum(np.searchsorted(codes[order], seen), len(codes) - 1)
    return np.where(codes[order][at] == seen, subjects[order][at], 0)


_HEADINGS = (
    "method",
    "build ms",
    "factor ms",
    "solve ms",
    "total ms",
    "again ms",
    "solves",
    "nnz factor",
    "differs by",
)


def file_stem(name: str) -> str:
    """A name as the beginning of a file's name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "problem"


def table_of(study: Study) -> list[tuple[str, ...]]:
    """Headings, then a row a method; a single one differs from none."""
    rows = [_HEADINGS, *(_row(method) for method in study.methods)]
    return rows if len(study.methods) > 1 else [row[:-1] for row in rows]


def _row(method: MethodResult) -> tuple[str, ...]:
    times = (method.build_s, method.factor_s, method.solve_s, method.total_s, method.again_s)
    return (
        method.method,
        *(f"{1e3 * seconds:.2f}" for seconds in times),
        str(method.iterations),
        f"{method.factor.nnz:,}",
        f"{method.difference:.1e}",
    )


def text_of(study: Study) -> str:
    """The whole study for a terminal."""
    lines = [study.name, *(f"  {fact.label:<15}{fact.value}" for fact in study.facts)]
    lines += [f"  {label:<15}{value}" for label, value in accuracy_lines(study)]
    lines.append(f"  {'A':<15}{size_of(study)}")
    rows = table_of(study)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (
            f"{cell:<{width}}" if k == 0 else f"{cell:>{width}}"
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  " + "  ".join(cells))
    return "\n".join(lines)


def size_of(study: Study) -> str:
    """Size of A as text."""
    rows, columns = study.system.pattern.shape
    entries = counted(len(study.system.values), "entry", "entries")
    build = f"put together in {1e3 * study.build_s:.1f} ms"
    return f"{counted(rows, 'row')}, {counted(columns, 'column')}, {entries}, {build}"


def accuracy_lines(study: Study) -> list[tuple[str, str]]:
    """Label and value of the accuracy before and after, and how it is defined."""
    return [
        ("before", _accuracy(study.before.accuracy)),
        ("after", _accuracy(study.after.accuracy)),
        ("accuracy", study.after.accuracy.definition),
    ]


def tree_of(study: Study) -> dict[str, object]:
    """The figures for JSON."""
    rows, columns = study.system.pattern.shape
    return {
        "name": study.name,
        "facts": {fact.label: fact.value for fact in study.facts},
        "converged": study.converged,
        "before": _figures(study.before.accuracy),
        "after": _figures(study.after.accuracy),
        "A": {"rows": rows, "columns": columns, "entries": len(study.system.values), "build_s": study.build_s},
        "methods": [
            {
                "method": method.method,
                "build_s": method.build_s,
                "factor_s": method.factor_s,
                "solve_s": method.solve_s,
                "again_s": method.again_s,
                "iterations": method.iterations,
                "factor": method.factor.name,
                "factor_entries": method.factor.nnz,
                "difference": method.difference,
            }
            for method in study.methods
        ],
    }


def write_estimate(directory: Path, study: Study) -> None:
    """Poses and landmarks with their covariances as CSV, and the poses as TUM where they have stamps."""
    stem, state = file_stem(study.name), study.after.state
    names = ["x_m", "y_m", "heading_rad"][: state.poses.shape[1]]
    _write_csv(
        directory / f"{stem}_poses.csv",
        "pose",
        np.arange(len(state.poses)),
        names,
        state.poses,
        study.pose_covariance,
    )
    numbers = study.system.pattern.layout.landmarks
    file = directory / f"{stem}_landmarks.csv"
    _write_csv(file, "landmark", numbers, ["x_m", "y_m"], state.landmarks, study.landmark_covariance)
    if study.trajectory is not None:
        write_tum(directory / f"{stem}.tum", study.trajectory, force=True)


def _write_csv(
    path: Path, kind: str, numbers: np.ndarray, names: list[str], values: Matrix, covariance: Matrix
) -> None:
    """One line each: number, values, upper triangle of the covariance."""
    rows, columns = np.triu_indices(len(names))
    header = [kind, *names, *(f"cov_{names[i]}_{names[j]}" for i, j in zip(rows, columns, strict=True))]
    table = np.concatenate([values, covariance[:, rows, columns]], axis=1)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for number, row in zip(numbers.tolist(), table.tolist(), strict=True):
            writer.writerow([number, *(f"{value:.9g}" for value in row)])


def _accuracy(accuracy: Accuracy) -> str:
    poses, landmarks = (
        "unknown" if math.isnan(error_m) else f"{error_m:.4f} m off"
        for error_m in (accuracy.poses_m, accuracy.landmarks_m)
    )
    return "unknown" if poses == landmarks == "unknown" else f"poses {poses}, landmarks {landmarks}"


def _figures(accuracy: Accuracy) -> dict[str, float | str | None]:
    return {
        "poses_m": None if math.isnan(accuracy.poses_m) else accuracy.poses_m,
        "landmarks_m": None if math.isnan(accuracy.landmarks_m) else accuracy.landmarks_m,
        "definition": accuracy.definition,
    }
