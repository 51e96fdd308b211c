"""A method at work, behind one verb: ours with all it knows of itself, the others as they are."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np

from pipeline.baselines import BASELINES, Baseline, InPlane
from pipeline.compare.methods import Method
from pipeline.config import Config
from pipeline.data import Pose, Scan, Step, Timing, Trajectory
from pipeline.errors import InputError
from pipeline.odometry import Odometry
from pipeline.runs.closure_table import write_closures
from pipeline.runs.step_table import StepTable
from pipeline.runs.verdicts import final_verdicts
from pipeline.slam import Slam

STEPS_FILE, CLOSURES_FILE = "steps.parquet", "loops.parquet"


class Runner(Protocol):
    """Scans in, poses out."""

    @property
    def description(self) -> str:
        """What it does, with its settings."""
        ...

    def track(self, scan: Scan) -> Pose:
        """T_odom_lidar (d+1, d+1) at the scan's stamp."""
        ...

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        """The last word on all poses; what else is known goes into files of the folder."""
        ...


def start(method: Method, T_base_lidar: Pose) -> Runner:
    """The method before its first scan. Raises MissingExtraError where its package is not installed."""
    if not method.is_ours:
        return _Others(method, len(T_base_lidar) - 1)
    config = msgspec.convert(method.settings, Config)
    return (_Chain if config.loops.enabled else _Odometry)(method, config, T_base_lidar)


def can_start_again(method: Method) -> bool:
    """Whether an instance knows nothing of those before it, so that one may be thrown away to get warm."""
    return method.base not in BASELINES or BASELINES[method.base].forgets


class _Odometry:
    def __init__(self, method: Method, config: Config, T_base_lidar: Pose) -> None:
        self.description = _description(config)
        self.odometry = Odometry(config, T_base_lidar)
        self.steps = StepTable()

    def track(self, scan: Scan) -> Pose:
        tracked = self.odometry.track(scan)
        self.steps.append(
            Step(
                scan=scan,
                points=tracked.matched,
                T_odom_lidar=tracked.T_odom_lidar,
                T_world_lidar=tracked.T_odom_lidar,
                match=tracked.match,
                state=tracked.state,
                reason=tracked.reason,
                keyframe=-1,
                local_map=tracked.matched[:0],
                closures=(),
                graph=None,
                timing=Timing(0.0, tracked.preprocess_s, tracked.match_s, tracked.map_s, 0.0),
            )
        )
        return tracked.T_odom_lidar

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        self.steps.write(folder / STEPS_FILE, odometry)
        return odometry


class _Chain:
    """With loop closures and pose graph."""

    def __init__(self, method: Method, config: Config, T_base_lidar: Pose) -> None:
        self.description = f"{_description(config)}; loops closed, pose graph optimised at the end"
        self.slam = Slam(config, T_base_lidar)
        self.steps = StepTable()

    def track(self, scan: Scan) -> Pose:
        step = self.slam.process(scan)
        self.steps.append(step)
        return step.T_odom_lidar

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        result = self.slam.finish()
        self.steps.write(folder / STEPS_FILE, result.trajectory)
        judged = final_verdicts(result.closures, result.state)
        write_closures(folder / CLOSURES_FILE, judged, result.keyframes, odometry.dimension)
        return result.trajectory


class _Others:
    def __init__(self, method: Method, dimension: int) -> None:
        self.baseline = _baseline(method, dimension)
        self.description = self.baseline.description

    def track(self, scan: Scan) -> Pose:
        return self.baseline.track(scan.points, scan.times_s, scan.stamp_ns)

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        return odometry


def _baseline(method: Method, dimension: int) -> Baseline:
    if method.base not in BASELINES:
        return _brought(method)
    entry = BASELINES[method.base]
    baseline = entry.make(msgspec.convert(method.settings, type(entry.settings)))
    return baseline if dimension == 3 else InPlane(baseline, is_raised=entry.is_raised)


def _brought(method: Method) -> Baseline:
    """An object of the user's own class, made with the settings as keywords."""
    module, _, name = method.base.partition(":")
    try:
        return getattr(import_module(module), name)(**method.settings)
    except (ImportError, AttributeError) as error:
        raise InputError(f"{method.name}: {method.base} cannot be had ({error}); check PYTHONPATH") from error


def _description(config: Config) -> str:
    wheels = "wheels where the log has them" if config.odometry.prior != "constant-velocity" else "no wheels"
    deskewing = "deskewing where the log has times" if config.preprocess.deskew else "no deskewing"
    size_m = np.format_float_positional(config.local_map.voxel_size_m, trim="-")
    return (
        f"ours, {config.matching.matcher}, {config.matching.optimiser}, scan to map, voxels of {size_m} m, "
        f"one thread, {wheels}, {deskewing}"
    )
