"""A method at work, behind one verb: ours with all it knows of itself, the others as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import msgspec

from scanchain.baselines import BASELINES, Baseline, InPlane
from scanchain.comparison.methods import Method
from scanchain.data import Pose, Scan, Trajectory
from scanchain.registry import load_class


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
    from scanchain.comparison.ours import start_ours  # much code, which is not to count as memory of the others

    return start_ours(method, T_base_lidar)


def can_start_again(method: Method) -> bool:
    """Whether an instance knows nothing of those before it, so that one may be thrown away to get warm."""
    return method.base not in BASELINES or BASELINES[method.base].forgets


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
        return load_class(method.base, "track")(**method.settings)
    entry = BASELINES[method.base]
    baseline = entry.make(msgspec.convert(method.settings, type(entry.settings)))
    return baseline if dimension == 3 else InPlane(baseline, is_raised=entry.is_raised)
