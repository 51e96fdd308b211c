"""A method that is a command: it reads a folder of clouds, and writes a pose for each as a TUM file."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path
from time import perf_counter

import numpy as np

from scanchain import lie
from scanchain.comparison.methods import POSES, SCANS
from scanchain.comparison.processes import StoredScans
from scanchain.data import Matrix, Trajectory
from scanchain.errors import InputError, counted
from scanchain.evaluation.pairing import nearest
from scanchain.maps import write_ply
from scanchain.processes import MOST_CHARACTERS
from scanchain.trajectory import read_tum

_WITHIN_NS = 1_000_000  # largest difference of a pose's stamp from its scan's
_COMMENT = "meters, frame of the lidar; t in seconds from the stamp, NaN where unknown"


def run_program(command: str, scans: StoredScans, folder: Path) -> tuple[Matrix, float, float, float]:
    """Poses (N, d+1, d+1) of the scans, seconds and CPU seconds per scan, and the peak memory in MiB.

    Raises InputError for a command that fails or does not write a pose for each scan.
    """
    import resource  # of POSIX only

    clouds, poses = folder / "clouds", folder / "poses.tum"
    clouds.mkdir()
    for scan in scans.scans():
        times_s = scan.times_s if len(scan.times_s) else np.full(len(scan.points), np.nan, np.float32)
        write_ply(clouds / f"{scan.stamp_ns}.ply", scan.points.astype(np.float64), {"t": times_s}, _COMMENT)
    words = [word.replace(SCANS, str(clouds)).replace(POSES, str(poses)) for word in shlex.split(command)]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter()
    try:
        code = subprocess.run(words, check=False).returncode
    except OSError as error:
        raise InputError(f"{words[0]}: cannot be run ({error.strerror}); check the command") from None
    seconds, after = perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if code:
        raise InputError(f"{shlex.join(words)[:MOST_CHARACTERS]} ended with exit code {code}; see its output.txt")
    if not poses.exists():
        raise InputError(f"{words[0]} wrote no poses; it must write them to {POSES}")
    found = _of_scans(read_tum(poses), scans)
    flat = found if scans.dimension == 3 else np.array([lie.flatten(pose) for pose in found])
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return lie.between(flat[0], flat), seconds / len(scans), cpu_s / len(scans), after.ru_maxrss / 1024.0


def _of_scans(trajectory: Trajectory, scans: StoredScans) -> Matrix:
    """A pose for each scan, by its stamp, or by its order where there are as many of other stamps."""
    poses = trajectory.poses
    rows, away_ns = nearest(scans.stamps_ns, trajectory.stamps_ns)
    if (away_ns <= _WITHIN_NS).all():
        return poses[rows]
    if len(poses) == len(scans):
        return poses
    raise InputError(
        f"it wrote {counted(len(poses), 'pose')} for {counted(len(scans), 'scan')}; each needs one, of its stamp"
    )
