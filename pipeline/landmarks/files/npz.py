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


def read_landmark_data(path: Path) -> LandmarkData:
    """Read a problem; raises InputError for whatever is wrong with the file, pickled objects included.

    The file does not state whether its observations are relative positions or bearings and ranges: the one that
    the true positions fit better is taken.
    """
    arrays = _read(path)
    poses, landmarks, odometry, table = (
        arrays[name] for name in ("gt_traj", "gt_landmarks", "odom", "observations")
    )
    if len(odometry) != len(poses) - 1:
        raise InputError(
            f"{path}: odom has {counted(len(odometry), 'step')} "
            f"between {counted(len(poses), 'pose')} of gt_traj; it must have one less"
        )
    observed = _indices(path, table, len(poses), len(landmarks))
    return LandmarkData(
        name=path.stem,
        kind=_kind(path, poses, landmarks, observed, table[:, 2:]),
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
            missing = [name for name in _SHAPES if name not in file]
            if missing:
                raise InputError(f"{path}: has no array {missing[0]}; a problem has {', '.join(_SHAPES)}")
            return {name: _table(path, name, file[name]) for name in _SHAPES}
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
    """Pose and landmark of every observation, (N, 2)."""
    for column, name, count in ((0, "pose", poses), (1, "landmark", landmarks)):
        wrong = (
            (table[:, column] != np.floor(table[:, column])) | (table[:, column] < 0) | (table[:, column] >= count)
        )
        for row in np.flatnonzero(wrong)[:1]:
            raise InputError(
                f"{path}: observations[{row}] is of {name} {table[row, column]:g};"
                f" it must be a whole number from 0 to {count - 1}"
            )
    return table[:, :2].astype(np.int64)


def _covariance(path: Path, name: str, arrays: dict[str, Matrix]) -> Matrix:
    matrix = arrays[name]
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0) or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise InputError(f"{path}: {name} is no covariance; it must be symmetric and positive definite")
    return matrix


def _kind(path: Path, poses: Matrix, landmarks: Matrix, observed: NDArray[np.int64], measured: Matrix) -> Kind:
    """Kind of the measurements: least median distance of the measured point from the true position.

    Raises InputError where they fit bearings in degrees best.
    """
    true = landmarks[observed[:, 1]] - poses[observed[:, 0]]
    bearing, reach = measured.T
    polar, by_degrees = (
        np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
        for angle in (bearing, np.radians(bearing))
    )
    as_linear, as_polar, as_degrees = (
        np.median(np.linalg.norm(guess - true, axis=1)) for guess in (measured, polar, by_degrees)
    )
    largest = float(np.abs(bearing).max())
    if largest > 2.0 * np.pi and 2.0 * as_degrees < min(as_linear, as_polar):
        raise InputError(f"{path}: bearings of observations reach {largest:.6g}: degrees? give radians")
    return "linear" if as_linear <= as_polar else "bearing-range"
