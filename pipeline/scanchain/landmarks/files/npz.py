"""Reads the landmark problems of the course: one npz file of plain arrays each."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.landmarks.problem import Kind, LandmarkData
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
