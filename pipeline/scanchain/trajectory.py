"""Trajectories as text: TUM and KITTI files, in and out."""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.checks import RIGID
from scanchain.data import Matrix, Trajectory
from scanchain.errors import InputError, counted, remedy_of

_TUM_ROW, _KITTI_ROW = 7 * " %.9f", " ".join(12 * ["%.9e"]) + "\n"
_TUM_FIELDS = "stamp x y z qx qy qz qw"
_KITTI_FIELDS = "r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z"
LEAST_VARIANCE = 1e-12  # m² or rad², of z, roll and pitch in the plane, and of what else would be singular


def read_tum(path: Path | str) -> Trajectory:
    """SE(3) poses of a TUM file, ``stamp x y z qx qy qz qw`` per line, or of a run directory, in order.

    Stamps are taken from their decimal text, so that nanoseconds stay exact; they need not increase.
    """
    path = Path(path, "trajectory.tum") if Path(path).is_dir() else path
    places, stamps_ns, values = table(path, "TUM line", _TUM_FIELDS, stamps=1)
    norms = np.linalg.norm(values[:, 3:], axis=1)
    for bad in np.flatnonzero(np.abs(norms - 1.0) > 0.01)[:1]:  # may be written with two digits
        raise InputError(
            f"{places[bad]} has a quaternion of length {norms[bad]:.3g}, not 1; a TUM line is {_TUM_FIELDS} "
            "(for a file of relations: scanchain evaluate --relations)"
        )
    return Trajectory(stamps_ns[:, 0], posed(lie.from_quaternion(values[:, 3:]), values[:, :3]))


def write_tum(path: Path | str, trajectory: Trajectory, *, force: bool = False) -> None:
    """Write a TUM file, nine digits after the point; SE(2) poses lie in the plane z = 0.

    force : whether an existing file is replaced; else InputError
    Raises InputError where there is no such folder, and OSError where the disk is full.
    """
    path = checks.path(path, "path")
    checks.instance(trajectory, Trajectory, "trajectory", "Trajectory(stamps_ns, poses), or read_tum(path)")
    with checks.writing(path, force=force), path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{row}\n" for row in _tum_rows(trajectory))


def _tum_rows(trajectory: Trajectory) -> Iterator[str]:
    poses = lie.lift(trajectory.poses)
    rows = np.hstack([poses[:, :3, 3], lie.to_quaternion(poses[:, :3, :3])]).tolist()
    for stamp_ns, row in zip(trajectory.stamps_ns.tolist(), rows, strict=True):
        yield f"{format_stamp(stamp_ns)}{_TUM_ROW % tuple(row)}"


def write_wide_tum(path: Path, trajectory: Trajectory, covariances: Matrix) -> None:
    """Write a TUM file with the covariance (N, k, k) after each pose, 29 numbers per line.

    Of a twist in the pose's own frame, T exp(ξ), (translation, rotation): the lower triangle of (6, 6), by rows.
    Of planar poses, z, roll and pitch have standard deviations of 1e-6 m or rad. OSError if the disk is full.
    """
    lifted = covariances
    if trajectory.dimension == 2:
        lifted = np.tile(LEAST_VARIANCE * np.eye(6), (len(trajectory), 1, 1))
        lifted[:, *np.ix_((0, 1, 5), (0, 1, 5))] = covariances
    lower = np.tril_indices(6)
    with checks.writing(path), path.open("w", encoding="utf-8", newline="\n") as file:
        for row, covariance in zip(_tum_rows(trajectory), lifted, strict=True):
            file.write(f"{row} {' '.join(f'{value:.6e}' for value in covariance[lower].tolist())}\n")


def read_kitti(path: Path | str) -> Trajectory:
    """SE(3) poses of a KITTI file, the upper 3 × 4 of one matrix per line, row by row.

    The format has no time: the stamp of a pose is its line's number, from 0, so that two files pair by line.
    """
    places, _, values = table(path, "KITTI line", _KITTI_FIELDS)
    rows = values.reshape(-1, 3, 4)
    error = np.abs(np.swapaxes(rows[:, :, :3], 1, 2) @ rows[:, :, :3] - np.eye(3)).max(axis=(1, 2))
    for bad in np.flatnonzero((error > RIGID) | (np.linalg.det(rows[:, :, :3]) < 0.0))[:1]:
        raise InputError(f"{places[bad]} is not a rotation: RᵀR is not the identity within {RIGID:g}")
    U, _, Vt = np.linalg.svd(rows[:, :, :3])
    return Trajectory(np.arange(len(rows), dtype=np.int64), posed(U @ Vt, rows[:, :, 3]))


def write_kitti(path: Path | str, trajectory: Trajectory) -> None:
    """Write a KITTI file: the poses without their stamps."""
    rows = lie.lift(trajectory.poses)[:, :3].reshape(-1, 12)
    with Path(path).open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(_KITTI_ROW % tuple(row) for row in rows.tolist())


def format_stamp(stamp_ns: int) -> str:
    """Seconds with nine digits after the point, exact."""
    seconds, rest_ns = divmod(abs(stamp_ns), 10**9)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{rest_ns:09d}"


def parse_stamp_ns(text: str, place: str) -> int:
    """Nanoseconds of a decimal number of seconds, rounded to the nearest; ``place`` is named in the error."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise InputError(
            f"{place} has the stamp {text!r}; it must be a number of seconds (begin a line of column names with #)"
        ) from None
    if not seconds.is_finite() or not -(2**63) <= seconds * 10**9 < 2**63:
        raise InputError(
            f"{place} has the stamp {text} s, which does not fit 64 bits of nanoseconds; give it in seconds"
        )
    return int(seconds.scaleb(9).to_integral_value())


def table(
    path: Path | str, kind: str, fields: str, *, stamps: int = 0
) -> tuple[list[str], NDArray[np.int64], Matrix]:
    """Place (file:line), stamps (N, S) in nanoseconds and numbers (N, M) of the lines of a file, one at least.

    kind : of the line in errors, and its ``fields``, of which the first are ``stamps``
    """
    places: list[str] = []
    times_ns: list[list[int]] = []
    rows: list[list[float]] = []
    width = len(fields.split())
    for place, words in text_lines(path):
        if len(words) != width:
            raise InputError(f"{place} has {counted(len(words), 'field')}, a {kind} has {width}: {fields}")
        places.append(place)
        times_ns.append([parse_stamp_ns(word, place) for word in words[:stamps]])
        rows.append(numbers(words[stamps:], place))
    if not rows:
        raise InputError(f"{path} has no {kind}; expected one per line: {fields}")
    return places, np.array(times_ns, np.int64), np.array(rows)


def text_lines(path: Path | str) -> Iterator[tuple[str, list[str]]]:
    """Place (file:line) and words of every line that is neither empty nor a comment.

    Words are separated by spaces, commas or semicolons.
    """
    path = checks.path(path, "path")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not text; expected a trajectory with one pose per line") from None
    except OSError as error:
        reason = remedy_of(error) or f"{path} cannot be read ({error.strerror}); check the path"
        raise InputError(reason) from None
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.replace(",", " ").replace(";", " ").split()
        if words and not words[0].startswith("#"):
            yield f"{path}:{number}", words


def numbers(words: list[str], place: str) -> list[float]:
    """The words as finite numbers; ``place`` is named in the error."""
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{place}: {error}; wanted numbers, separated by spaces") from None
    if not np.isfinite(values).all():
        raise InputError(f"{place} has a number that is not finite; a pose must be")
    return values


def posed(R: Matrix, t: Matrix) -> Matrix:
    """Poses (N, 4, 4) of rotations (N, 3, 3) and positions (N, 3)."""
    poses = np.zeros((len(R), 4, 4))
    poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = R, t, 1.0
    return poses
