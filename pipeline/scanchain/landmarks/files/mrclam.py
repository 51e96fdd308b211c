"""Reads UTIAS MRCLAM folders: velocities, ranges and bearings to barcodes, motion capture (Leung et al. 2011)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.words import counted

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
    odometry = _by_time(_table(folder / name, 3))
    measurements = folder / f"Robot{robot}_Measurement.dat"
    seen = _by_time(_table(measurements, 4))
    if (largest := float(np.abs(seen[:, 3]).max())) > 2.0 * np.pi:
        raise InputError(f"{measurements}: bearings reach {largest:.6g}: degrees? give radians")
    subject = _subjects(_table(folder / "Barcodes.dat", 2), seen[:, 1])
    timely = (seen[:, 0] >= odometry[0, 0]) & (seen[:, 0] <= odometry[-1, 0])
    used = (subject > _ROBOTS) & timely
    if not used.any():
        raise InputError(
            f"{folder}: robot {robot} saw no landmark while its odometry was logged; choose another robot"
        )
    changes = odometry[np.append(True, (np.diff(odometry[:, 1:], axis=0) != 0.0).any(axis=1))]
    truth = folder / f"Robot{robot}_Groundtruth.dat"
    true = _by_time(_table(truth, 4)) if truth.is_file() else np.empty((0, 4))
    survey = folder / "Landmark_Groundtruth.dat"
    landmarks = _table(survey, 5) if survey.is_file() else np.empty((0, 5))
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


def _table(path: Path, columns: int) -> Matrix:
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
