"""Our own methods in a comparison, with the tables that only they write."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from scanchain.comparison.methods import Method
from scanchain.comparison.outcome import CLOSURES_FILE, STEPS_FILE
from scanchain.config import Config
from scanchain.data import Pose, Scan, Step, Timing, Trajectory
from scanchain.odometry import Odometry
from scanchain.runs.closures import final_verdicts, write_closures
from scanchain.runs.metrics import METRICS_FILE, expected_ate_of
from scanchain.runs.step_table import StepTable
from scanchain.slam import Slam


def start_ours(method: Method, T_base_lidar: Pose) -> OurOdometry | OurChain:
    """One of ours before its first scan."""
    config = msgspec.convert(method.settings, Config)
    return (OurChain if config.loops.enabled else OurOdometry)(config, T_base_lidar)


class OurOdometry:
    """Odometry alone."""

    def __init__(self, config: Config, T_base_lidar: Pose) -> None:
        self.description = _description(config)
        self.odometry = Odometry(config, T_base_lidar)
        self.T_base_lidar = T_base_lidar
        self.steps = StepTable()

    def track(self, scan: Scan) -> Pose:
        """T_odom_lidar (d+1, d+1)."""
        tracked = self.odometry.process(scan)
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
                starts_segment=tracked.elsewhere_m > 0.0,
            )
        )
        return tracked.T_odom_lidar

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        """The final poses; tables go into the folder."""
        self.steps.write(folder / STEPS_FILE, odometry, self.T_base_lidar)
        return odometry


class OurChain:
    """With loop closures and pose graph."""

    def __init__(self, config: Config, T_base_lidar: Pose) -> None:
        self.description = f"{_description(config)}; loops closed, pose graph optimized at the end"
        self.slam = Slam(config, T_base_lidar)
        self.T_base_lidar = T_base_lidar
        self.steps = StepTable()

    def track(self, scan: Scan) -> Pose:
        """T_odom_lidar (d+1, d+1)."""
        step = self.slam.process(scan)
        self.steps.append(step)
        return step.T_odom_lidar

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        """The final poses; tables go into the folder."""
        result = self.slam.finish()
        self.steps.write(folder / STEPS_FILE, result.trajectory, self.T_base_lidar)
        expected = msgspec.json.encode({"expected_ate_m": expected_ate_of(result)})
        (folder / METRICS_FILE).write_bytes(expected)
        final = final_verdicts(result.closures, result.state)
        write_closures(folder / CLOSURES_FILE, final, result.keyframes, odometry.dimension)
        return result.trajectory


def _description(config: Config) -> str:
    wheels = "wheels where the log has them" if config.odometry.prior != "constant-velocity" else "no wheels"
    deskewing = "deskewing where the log has times" if config.preprocess.deskew else "no deskewing"
    steps = f" by {config.matching.optimizer}" if config.matching.matcher == "plicp" else ""
    size_m = np.format_float_positional(config.local_map.voxel_size_m, trim="-")
    return (
        f"ours, {config.matching.matcher}{steps}, scan to map, voxels of {size_m} m, "
        f"one thread, {wheels}, {deskewing}"
    )
