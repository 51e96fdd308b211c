"""``python -m scanchain.comparison.worker SCANS FOLDER``: one method over all scans, in this process alone.

FOLDER holds method.msgpack; poses and times are written into it scan by scan: those until a crash are there. SCANS
lies in the directory of the comparison, which is removed where its process is killed.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterable
from contextlib import nullcontext, suppress
from itertools import islice
from pathlib import Path
from time import perf_counter, process_time
from typing import Protocol

import msgspec
import numpy as np
from numpy.lib.format import open_memmap

from scanchain import plugins
from scanchain.baselines import BASELINES, Baseline, InPlane
from scanchain.clock import announcing_compilation
from scanchain.comparison.methods import Method
from scanchain.comparison.processes import (
    CLOSURES_FILE,
    CPU_FILE,
    METHOD_FILE,
    POSES_FILE,
    REPORT_FILE,
    SECONDS_FILE,
    STEPS_FILE,
    TRAJECTORY_FILE,
    EndReport,
    Status,
    StoredScans,
    open_store,
)
from scanchain.config import Config
from scanchain.data import Pose, Scan, Trajectory
from scanchain.errors import MissingExtraError, ScanchainError, shown
from scanchain.processes import die_first, die_with_parent, peak_mib
from scanchain.runs.job import Unwatched


class Runner(Protocol):
    """Scans in, poses out."""

    @property
    def description(self) -> str:
        """Method and settings."""
        ...

    def track(self, scan: Scan) -> Pose:
        """T_odom_lidar (d+1, d+1) at the scan's stamp."""
        ...

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        """The final trajectory; other results go into files of the folder."""
        ...


def start(method: Method, T_base_lidar: Pose) -> Runner:
    """The method before its first scan. Raises MissingExtraError where its package is not installed."""
    return _Ours(method, T_base_lidar) if method.is_ours else _Others(method, len(T_base_lidar) - 1)


def can_start_again(method: Method) -> bool:
    """True if instances are independent, so that one may be discarded after warming up."""
    return method.base not in BASELINES or BASELINES[method.base].forgets


class _Ours:
    """Odometry, with loop closures and pose graph where the method closes loops.

    Imports here what is much code, and is not to count as memory of the others.
    """

    def __init__(self, method: Method, T_base_lidar: Pose) -> None:
        from scanchain.runs.step_table import StepTable
        from scanchain.slam import Slam

        self.config = config = msgspec.convert(method.settings, Config)
        self.has_loops = config.loops.enabled
        closing = "; loops closed, pose graph optimized at the end" if self.has_loops else ""
        self.description = f"{_description(config)}{closing}"
        self.slam = Slam(config, T_base_lidar)
        self.T_base_lidar = T_base_lidar
        self.steps = StepTable()

    def track(self, scan: Scan) -> Pose:
        """T_odom_lidar (d+1, d+1)."""
        step = self.slam.process(scan)
        self.steps.append(step)
        return step.T_odom_lidar

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        """The final poses; tables and the expected ATE go into the folder."""
        from scanchain.runs.closures import final_verdicts, write_closures
        from scanchain.runs.metrics import METRICS_FILE
        from scanchain.runs.results import expected_of

        result = self.slam.finish()
        trajectory = result.trajectory if self.has_loops else odometry
        self.steps.write(folder / STEPS_FILE, trajectory, self.T_base_lidar)
        expected = expected_of(result, self.config)
        known = {"expected_ate_m": expected and expected.ate}
        (folder / METRICS_FILE).write_bytes(msgspec.json.encode(known))
        if self.has_loops:
            final = final_verdicts(result.closures, result.state)
            write_closures(folder / CLOSURES_FILE, final, result.keyframes, odometry.dimension)
        return trajectory


def _description(config: Config) -> str:
    wheels = "wheels where the log has them" if config.odometry.prior != "constant-velocity" else "no wheels"
    deskewing = "deskewing where the log has times" if config.preprocess.deskew else "no deskewing"
    steps = f" by {config.matching.optimizer}" if config.matching.matcher == "plicp" else ""
    size_m = np.format_float_positional(config.local_map.voxel_size_m, trim="-")
    return (
        f"ours, {config.matching.matcher}{steps}, scan to map, voxels of {size_m} m, "
        f"one thread, {wheels}, {deskewing}"
    )


class _Others:
    def __init__(self, method: Method, dimension: int) -> None:
        self.baseline = _baseline(method, dimension)
        self.description = str(getattr(self.baseline, "description", "")) or method.base

    def track(self, scan: Scan) -> Pose:
        return self.baseline.track(scan.points, scan.times_s, scan.stamp_ns)

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        return odometry


def _baseline(method: Method, dimension: int) -> Baseline:
    if method.base not in BASELINES:
        return plugins.load(method.base, "track")(**method.settings)
    entry = BASELINES[method.base]
    baseline = entry.make(msgspec.convert(method.settings, type(entry.settings)))
    return baseline if dimension == 3 else InPlane(baseline, is_raised=entry.is_raised)


_WARM_UP_SCANS = 4
_MAX_CHARACTERS = 300  # largest length of the message of an error raised by other code


def work(scans: StoredScans, method: Method, folder: Path) -> EndReport:
    """Track every scan, then finish."""
    began = perf_counter()
    warm_up(scans.scans(), method, scans.T_base_lidar)
    runner = start(method, scans.T_base_lidar)
    start_s = perf_counter() - began
    size = scans.dimension + 1
    poses = open_memmap(folder / POSES_FILE, "w+", np.float64, (len(scans), size, size))
    seconds = open_memmap(folder / SECONDS_FILE, "w+", np.float64, (len(scans),))
    cpu_seconds = open_memmap(folder / CPU_FILE, "w+", np.float64, (len(scans),))
    poses[:], seconds[:], cpu_seconds[:] = np.nan, np.nan, np.nan
    for scan in scans.scans():
        began_s, cpu_began_s = perf_counter(), process_time()
        pose = runner.track(scan)
        took_s, cpu_took_s = perf_counter() - began_s, process_time() - cpu_began_s
        if np.shape(pose) != (size, size):
            raise ValueError(f"track returned {shown(pose)}; wanted a pose ({size}, {size})")
        if not np.isfinite(pose).all():
            raise ValueError("a pose that is not finite")
        seconds[scan.index], cpu_seconds[scan.index], poses[scan.index] = took_s, cpu_took_s, pose
    ended = perf_counter()
    trajectory = runner.finish(Trajectory(scans.stamps_ns, np.array(poses)), folder)
    np.save(folder / TRAJECTORY_FILE, trajectory.poses)
    return EndReport(Status.OK, "", runner.description, start_s, perf_counter() - ended)


def warm_up(scans: Iterable[Scan], method: Method, T_base_lidar: Pose) -> None:
    """Import and compile with an instance that is thrown away; what goes wrong will go wrong again."""
    if not can_start_again(method):
        return
    runner = start(method, T_base_lidar)
    with suppress(Exception):
        for scan in islice(scans, _WARM_UP_SCANS):
            runner.track(scan)


def main() -> None:
    """Run the method and write the report."""
    store, folder = Path(sys.argv[1]), Path(sys.argv[2])
    die_first()
    die_with_parent(leftover=store.parent)
    method = msgspec.msgpack.decode((folder / METHOD_FILE).read_bytes(), type=Method)
    compiler = _Compiler()
    with announcing_compilation(compiler.say) if method.is_ours else nullcontext():
        report = _report(open_store(store), method, folder)
    report = msgspec.structs.replace(report, peak_mib=peak_mib(), has_compiled=compiler.has_compiled)
    (folder / REPORT_FILE).write_bytes(msgspec.json.encode(report))


class _Compiler(Unwatched):
    """Notices compilation."""

    has_compiled = False

    def say(self, line: str) -> None:
        self.has_compiled = True


def _report(scans: StoredScans, method: Method, folder: Path) -> EndReport:
    """Report of the work, or of the error that ended it."""
    try:
        return work(scans, method, folder)
    except MissingExtraError as error:
        return EndReport(Status.MISSING, str(error))
    except MemoryError as error:
        return EndReport(Status.OUT_OF_MEMORY, _words(error))
    except ScanchainError as error:
        return EndReport(Status.CRASHED, str(error))
    except Exception as error:  # others' code may raise anything
        traceback.print_exc()
        return EndReport(Status.CRASHED, _words(error))


def _words(error: Exception) -> str:
    """Message of an error on one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:_MAX_CHARACTERS]}"


if __name__ == "__main__":
    main()
