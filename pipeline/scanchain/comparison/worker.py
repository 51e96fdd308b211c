"""``python -m scanchain.comparison.worker FOLDER``: one method over all scans, in this process alone.

FOLDER holds the task; poses and times are written into it scan by scan: those before a crash are kept. It lies in
the directory of the comparison, which is removed if its process is killed.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterable
from contextlib import suppress
from itertools import islice
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.lib.format import open_memmap

from scanchain import plugins
from scanchain.baselines import InPlane
from scanchain.comparison import processes
from scanchain.comparison.evalio_pipelines import entry_of
from scanchain.comparison.methods import COMMAND, Method
from scanchain.comparison.processes import EndReport, Status, StoredScans
from scanchain.comparison.program import run_program
from scanchain.data import Pose, Scan, Trajectory
from scanchain.errors import MissingExtraError, NotApplicableError, ScanchainError, one_line, shown
from scanchain.processes import MOST_CHARACTERS, die_first, die_with_parent, peak_mib

if TYPE_CHECKING:
    from scanchain.comparison.ours import Ours

_WARM_UP_SCANS = 4  # scans processed before the clock starts: they load the kernels


def start(method: Method, T_base_lidar: Pose, *, is_mounted: bool = True) -> Ours | _Others:
    """The method before its first scan. Raises MissingExtraError where its package is not installed."""
    if not method.is_ours:
        return _Others(method, len(T_base_lidar) - 1)
    from scanchain.comparison.ours import Ours  # much code, which is not to count as memory of the others

    return Ours(method, T_base_lidar, is_mounted=is_mounted)


class _Others:
    """A baseline or a class of the user as ``Ours``: scans in, poses out."""

    def __init__(self, method: Method, dimension: int) -> None:
        entry, self.register = entry_of(method.base), None
        if entry is not None:
            if dimension == 2 and entry.planar is None:
                raise NotApplicableError("is made for 3D clouds, and the log is 2D")
            self.odometry = entry.make(msgspec.convert(method.settings, type(entry.settings)))
            if dimension == 2:
                self.odometry = InPlane(self.odometry, is_raised=entry.is_raised)
        else:
            self.odometry = plugins.load(method.base, "register")(**method.settings)
            self.register = self.odometry.register
        self.description = str(getattr(self.odometry, "description", "")) or method.base
        self.add_inertial = getattr(self.odometry, "add_inertial", None)

    def track(self, scan: Scan) -> Pose:
        if scan.inertial is not None and self.add_inertial is not None:
            self.add_inertial(scan.inertial)
        if self.register is not None:
            return self.register(scan.points, 1e-9 * scan.stamp_ns, scan.times_s)
        return self.odometry.track(scan.points, scan.times_s, scan.stamp_ns)

    def measure_errors(self, scans: StoredScans, folder: Path) -> None:
        """Nothing: its error is bounded by the other trajectories."""

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        optimized = getattr(self.odometry, "final_poses", None)
        return Trajectory(odometry.stamps_ns, optimized()) if optimized is not None else odometry


def work(scans: StoredScans, method: Method, folder: Path) -> EndReport:
    """Track every scan, then finish."""
    if method.base == COMMAND:
        return _run_command(scans, method, folder)
    began = perf_counter()
    warm_up(scans.scans(), method, scans.T_base_lidar)
    runner = start(method, scans.T_base_lidar, is_mounted=scans.is_mounted)
    start_s = perf_counter() - began
    track = open_memmap(folder / processes.TRACK_FILE, "w+", scans.track_type, (len(scans),))
    track[:] = np.nan
    wanted = scans.T_base_lidar.shape
    for scan in scans.scans():
        began_s, cpu_began_s = perf_counter(), process_time()
        pose = runner.track(scan)
        took_s, cpu_took_s = perf_counter() - began_s, process_time() - cpu_began_s
        if np.shape(pose) != wanted:
            raise ValueError(f"it returned {shown(pose)}; wanted a pose {wanted}")
        if not np.isfinite(pose).all():
            raise ValueError("a pose that is not finite")
        track[scan.index] = pose, took_s, cpu_took_s
    ended = perf_counter()
    trajectory = runner.finish(Trajectory(scans.stamps_ns, np.array(track["pose"])), folder)
    np.save(folder / processes.TRAJECTORY_FILE, trajectory.poses)
    report = EndReport(Status.OK, "", runner.description, start_s, perf_counter() - ended)
    runner.measure_errors(scans, folder)
    return report


def _run_command(scans: StoredScans, method: Method, folder: Path) -> EndReport:
    """All scans at once: each is taken to need the same time."""
    command = str(method.settings[COMMAND])
    poses, seconds, cpu_seconds, peak = run_program(command, scans, folder)
    track = open_memmap(folder / processes.TRACK_FILE, "w+", scans.track_type, (len(scans),))
    track["pose"], track["seconds"], track["cpu_seconds"] = poses, seconds, cpu_seconds
    np.save(folder / processes.TRAJECTORY_FILE, poses)
    return EndReport(Status.OK, "", f"{command}; times are means, reading and writing included", peak_mib=peak)


def warm_up(scans: Iterable[Scan], method: Method, T_base_lidar: Pose) -> None:
    """Import and compile with a throwaway instance; errors are ignored here, as they will occur again."""
    entry = entry_of(method.base)
    if entry is not None and not entry.forgets:
        return
    runner = start(method, T_base_lidar)
    with suppress(Exception):
        for scan in islice(scans, _WARM_UP_SCANS):
            runner.track(scan)


def main() -> None:
    """Run the task of a folder as a process of its own."""
    folder = Path(sys.argv[1])
    die_first()
    die_with_parent(leftover=folder.parents[1])
    run(folder)


def run(folder: Path) -> None:
    """Run the task of a folder and write the report."""
    task = (folder / processes.TASK_FILE).read_bytes()
    method, scans = processes.decode(task, tuple[Method, StoredScans])
    report = _report(scans, method, folder)
    report = msgspec.structs.replace(report, peak_mib=report.peak_mib or peak_mib())
    (folder / processes.REPORT_FILE).write_bytes(msgspec.json.encode(report))


def _report(scans: StoredScans, method: Method, folder: Path) -> EndReport:
    try:
        return work(scans, method, folder)
    except MissingExtraError as error:
        return EndReport(Status.MISSING, str(error))
    except NotApplicableError as error:
        return EndReport(Status.NOT_APPLICABLE, str(error))
    except MemoryError as error:
        return EndReport(Status.OUT_OF_MEMORY, _words(error))
    except ScanchainError as error:
        return EndReport(Status.CRASHED, str(error))
    except Exception as error:  # others' code may raise anything
        traceback.print_exc()
        return EndReport(Status.CRASHED, _words(error))


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {one_line(error)[:MOST_CHARACTERS]}"


if __name__ == "__main__":
    main()
