"""Reading of landmark problems: npz files of the course and MRCLAM folders."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.errors import InputError, counted, one_line
from scanchain.landmarks.problem import FIRST_SHARE, Kind, LandmarkData, Measurements, no_calibration

_SHAPES = {
    "gt_traj": "(poses, 2)",
    "gt_landmarks": "(landmarks, 2)",
    "odom": "(poses - 1, 2)",
    "observations": "(observations, 4)",
    "sigma_odom": "(2, 2)",
    "sigma_landmark": "(2, 2)",
}
_LARGEST = 9e9  # seconds above which a time does not fit 64 bits of nanoseconds
_TRUTH = ("gt_traj", "gt_landmarks")  # arrays that a problem may lack


def read_landmark_data(path: Path) -> LandmarkData:
    """Read a problem; raises InputError for anything wrong with the file, including pickled objects.

    The file does not state whether its observations are relative positions or bearings and ranges. The kind that
    fits the true positions better is assumed, or without truth the kind whose observations agree better.
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
    unseen = np.setdiff1d(np.arange(len(landmarks)), observed[:, 1])
    if len(unseen):
        raise InputError(
            f"{path}: {len(unseen)} of {counted(len(landmarks), 'landmark')} are not observed, the first is "
            f"{unseen[0]}; add observations of them, or remove them and renumber the others"
        )
    reckoned = np.cumsum(np.vstack([np.zeros(2), odometry]), axis=0)
    kind = _kind(path, poses if len(poses) else reckoned, landmarks, observed, table[:, 2:])
    covariance = _covariance(path, "sigma_odom", arrays)
    measurements = Measurements(
        first_pose=np.zeros(2),
        first_covariance=FIRST_SHARE**2 * covariance,
        motion=odometry,
        motion_covariance=np.broadcast_to(covariance, (len(odometry), 2, 2)),
        calibration=no_calibration(odometry, table[:, 2:]),
        observed=observed,
        measured=np.ascontiguousarray(table[:, 2:]),
        measured_covariance=np.broadcast_to(_covariance(path, "sigma_landmark", arrays), (len(table), 2, 2)),
        landmarks=np.arange(len(landmarks)),
    )
    true_poses = poses if len(poses) else np.full_like(reckoned, np.nan)
    return LandmarkData(path.stem, kind, measurements, true_poses, landmarks)


def _read(path: Path) -> dict[str, Matrix]:
    """Every array by name, (·, c) float64 and finite."""
    try:
        with path.open("rb") as file:
            if file.read(2) != b"PK":
                raise ValueError("it is no zip archive")
        with np.load(path, allow_pickle=False) as file:
            missing = [name for name in _SHAPES if name not in file and name not in _TRUTH]
            if missing:
                raise InputError(f"{path}: has no array {missing[0]}; a problem has {', '.join(_SHAPES)}")
            return {name: _table(path, name, file[name]) for name in _SHAPES if name in file}
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from None
    except InputError:
        raise
    except Exception as error:  # whatever a damaged file makes NumPy, its parser and the decoders raise
        reason = "it holds pickled objects" if "pickle" in str(error) else one_line(error)
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


def _covariance(path: Path, name: str, arrays: dict[str, Matrix]) -> Matrix:
    matrix = arrays[name]
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0) or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise InputError(f"{path}: {name} is no covariance; it must be symmetric and positive definite")
    return matrix


def _kind(path: Path, poses: Matrix, landmarks: Matrix, observed: NDArray[np.int64], measured: Matrix) -> Kind:
    """Kind of the measurements: least median distance of the measured points from the landmarks.

    An unknown landmark (NaN) is placed at the median of its measured points. Raises InputError if the points fit
    bearings in degrees best, and if the kind cannot be determined.
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
            f"{path}: no landmark is observed twice and there is no gt_landmarks, so that relative positions "
            "and bearings with ranges cannot be distinguished; add observations, or gt_landmarks"
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

    name : of the folder and the robot
    robot : its number
    times_s, velocities : (M,), (M, 2) wheel odometry: forward in m/s, turning in rad/s, whenever either changes,
        and at the end
    seen_s, subjects, measured : (N,), (N,) landmarks, or −n for robot n, (N, 2) bearing in rad and range in m
    of_robots, unknown : observations left out: of other robots, and of barcodes without a subject
    outside : observations left out since no odometry was logged at their time
    true_s, true_poses : (T,), (T, 3) motion capture x, y, heading; empty where the folder has none
    true_subjects, true_landmarks : (L,), (L, 2) surveyed landmarks; empty where the folder has none
    """

    name: str
    robot: int
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

    def seen(self, kept: NDArray[np.bool_], subjects: NDArray[np.int64] | None = None) -> RangeLog:
        """The log with these of its observations (N,), of other subjects (N,) if given."""
        named = self.subjects if subjects is None else subjects
        return replace(self, seen_s=self.seen_s[kept], subjects=named[kept], measured=self.measured[kept])


def robots_of(folder: Path) -> tuple[int, ...]:
    """Numbers of the robots of an MRCLAM folder; raises InputError if it is none."""
    if not (folder / "Barcodes.dat").is_file():
        raise InputError(
            f"{folder}: is no MRCLAM folder (Barcodes.dat is missing); name an npz file or such a folder"
        )
    names = (re.findall(r"^Robot(\d+)_Odometry\.dat$", file.name) for file in folder.iterdir())
    return tuple(sorted(int(name[0]) for name in names if name))


def read_mrclams(folder: Path, robots: Sequence[int]) -> list[RangeLog]:
    """Logs of several robots with their observations of each other; raises InputError as ``read_mrclam`` does."""
    logs, result = [read_mrclam(folder, robot, robots) for robot in robots], list[RangeLog]()
    for log in logs:
        is_lost = np.zeros(len(log.seen_s), np.bool_)
        for other in logs:
            is_out = (log.seen_s < other.times_s[0]) | (log.seen_s > other.times_s[-1])
            is_lost |= (log.subjects == -other.robot) & is_out
        result.append(replace(log.seen(~is_lost), outside=log.outside + int(is_lost.sum())))
    return result


def read_mrclam(folder: Path, robot: int, together: Sequence[int] = ()) -> RangeLog:
    """Log of robot ``robot``; raises InputError for anything missing or wrong.

    together : robots whose observations by this one are kept
    """
    name = f"Robot{robot}_Odometry.dat"
    if robot not in (there := robots_of(folder)):
        listed = ", ".join(map(str, there)) or "none"
        raise InputError(f"{folder}: has no {name}; --robot must be one of those logged there: {listed}")
    odometry = _by_time(_numbers(folder / name, 3))
    measurements = folder / f"Robot{robot}_Measurement.dat"
    seen = _by_time(_numbers(measurements, 4))
    if (largest := float(np.abs(seen[:, 3]).max())) > 2.0 * np.pi:
        raise InputError(f"{measurements}: bearings reach {largest:.6g}: degrees? give radians")
    subjects, codes = _numbers(folder / "Barcodes.dat", 2).T.tolist()
    subject_of = dict(zip(codes, subjects, strict=True))
    subject = np.array([subject_of.get(code, 0) for code in seen[:, 1].tolist()], np.int64)
    timely = (seen[:, 0] >= odometry[0, 0]) & (seen[:, 0] <= odometry[-1, 0])
    is_met = np.isin(subject, [each for each in together if each != robot])
    used = ((subject > _ROBOTS) | is_met) & timely
    if not (used & ~is_met).any():
        raise InputError(
            f"{folder}: robot {robot} saw no landmark while its odometry was logged; choose another robot"
        )
    is_change = np.append(True, (np.diff(odometry[:, 1:], axis=0) != 0.0).any(axis=1))
    is_change[-1] = True
    changes = odometry[is_change]
    truth = folder / f"Robot{robot}_Groundtruth.dat"
    true = _by_time(_numbers(truth, 4)) if truth.is_file() else np.empty((0, 4))
    survey = folder / "Landmark_Groundtruth.dat"
    landmarks = _numbers(survey, 5) if survey.is_file() else np.empty((0, 5))
    return RangeLog(
        name=f"{folder.resolve().name} robot {robot}",
        robot=robot,
        times_s=changes[:, 0],
        velocities=np.ascontiguousarray(changes[:, 1:]),
        seen_s=seen[used, 0],
        subjects=np.where(is_met, -subject, subject)[used],
        measured=np.ascontiguousarray(seen[used][:, [3, 2]]),
        of_robots=int(((subject >= 1) & (subject <= _ROBOTS) & ~is_met).sum()),
        unknown=int((subject < 1).sum()),
        outside=int((((subject > _ROBOTS) | is_met) & ~timely).sum()),
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
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); an MRCLAM folder needs it") from None
    except ValueError as error:
        raise InputError(f"{path}: is no table of {columns} numbers per line ({error}); check the file") from None
    if not table.size or table.shape[1] != columns:
        raise InputError(f"{path}: is empty or does not have {columns} numbers per line; check the file")
    if not (np.abs(table) < _LARGEST).all():
        row = int(np.flatnonzero(~(np.abs(table) < _LARGEST).all(axis=1))[0])
        raise InputError(f"{path}: row {row + 1} is not finite, or reaches {_LARGEST:g}; correct or remove it")
    return table


def _by_time(table: Matrix) -> Matrix:
    return table[np.argsort(table[:, 0], kind="stable")]
