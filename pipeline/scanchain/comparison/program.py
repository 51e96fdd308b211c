"""A method that is a command: it reads a folder of clouds, and writes a pose for each as a TUM file."""

from __future__ import annotations

import resource
import shlex
import subprocess
from pathlib import Path
from time import perf_counter

import numpy as np

from scanchain import lie
from scanchain.comparison.processes import StoredScans
from scanchain.data import Matrix, Scan, Trajectory
from scanchain.errors import InputError, counted
from scanchain.processes import MOST_CHARACTERS
from scanchain.trajectory import read_tum

COMMAND = "command"  # base of such a method, and the key of its table
_SCANS, _POSES = "{scans}", "{poses}"
_WITHIN_NS = 1_000_000  # largest difference of a pose's stamp from its scan's
_POINT = np.dtype([(name, "<f4") for name in "xyzt"])


def check_command(command: object, where: str) -> None:
    """Raise InputError for a command that is no text with both of its placeholders."""
    if not (isinstance(command, str) and _SCANS in command and _POSES in command):
        raise InputError(
            f"{where} {COMMAND} is {command!r}; wanted a command in which {_SCANS} stands for a folder of PLY files "
            f"and {_POSES} for the TUM file that it writes"
        )


def run_program(command: str, scans: StoredScans, folder: Path) -> tuple[Matrix, float, float, float]:
    """Poses (N, d+1, d+1) of the scans, seconds and CPU seconds per scan, and the peak memory in MiB.

    Raises InputError for a command that fails or does not write a pose for each scan.
    """
    clouds, poses = folder / "clouds", folder / "poses.tum"
    clouds.mkdir()
    for scan in scans.scans():
        _write(clouds / f"{scan.stamp_ns}.ply", scan)
    words = [word.replace(_SCANS, str(clouds)).replace(_POSES, str(poses)) for word in shlex.split(command)]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter()
    try:
        code = subprocess.run(words, check=False).returncode
    except OSError as error:
        raise InputError(f"{words[0]}: cannot be run ({error.strerror}); check the command") from None
    seconds, after = perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if code:
        raise InputError(f"{shlex.join(words)[:MOST_CHARACTERS]} ended with exit code {code}; see its output.txt")
    if not poses.exists():
        raise InputError(f"{words[0]} wrote no poses; it must write them to {_POSES}")
    found = _of_scans(read_tum(poses), scans)
    flat = found if scans.dimension == 3 else np.array([lie.flatten(pose) for pose in found])
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return lie.between(flat[0], flat), seconds / len(scans), cpu_s / len(scans), after.ru_maxrss / 1024.0


def _write(file: Path, scan: Scan) -> None:
    """Points x y z in meters, and t in seconds from the stamp, NaN where it is unknown; binary PLY."""
    cloud = np.zeros(len(scan.points), _POINT)
    for axis, values in zip("xyz", scan.points.T, strict=False):
        cloud[axis] = values
    cloud["t"] = scan.times_s if len(scan.times_s) else np.nan
    properties = "".join(f"property float {name}\n" for name in "xyzt")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    file.write_bytes(header.encode() + cloud.tobytes())


def _of_scans(trajectory: Trajectory, scans: StoredScans) -> Matrix:
    """A pose for each scan, by its stamp, or by its order where there are as many of other stamps."""
    order = np.argsort(trajectory.stamps_ns, kind="stable")
    stamps_ns, poses = trajectory.stamps_ns[order], trajectory.poses[order]
    after = np.clip(np.searchsorted(stamps_ns, scans.stamps_ns), 1, max(len(stamps_ns) - 1, 1))
    choices = np.minimum(np.stack([after - 1, after]), len(stamps_ns) - 1)
    away_ns = np.abs(stamps_ns[choices] - scans.stamps_ns)
    nearest = np.where(away_ns[0] <= away_ns[1], *choices)
    if (away_ns.min(axis=0) <= _WITHIN_NS).all():
        return poses[nearest]
    if len(poses) == len(scans):
        return trajectory.poses
    raise InputError(
        f"it wrote {counted(len(poses), 'pose')} for {counted(len(scans), 'scan')}; a pose is wanted for each, of its stamp"
    )
