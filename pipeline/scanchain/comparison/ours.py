"""Our own methods in a comparison, with the tables that only they write."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from scanchain.comparison.methods import Method
from scanchain.comparison.processes import CLOSURES_FILE, STEPS_FILE, StoredScans
from scanchain.config import Config
from scanchain.data import Pose, Scan, Trajectory
from scanchain.runs.closures import closures_table, final_verdicts
from scanchain.runs.directory import METRICS_FILE
from scanchain.runs.results import expected_of
from scanchain.runs.step_table import steps_table, write_table
from scanchain.slam import Slam


class Ours:
    """Odometry, with loop closures and pose graph where the method closes loops."""

    def __init__(self, method: Method, T_base_lidar: Pose, *, is_mounted: bool = True) -> None:
        self.config = config = msgspec.convert(method.settings, Config)
        self.has_loops = config.loops.enabled
        closing = "; loops closed, pose graph optimized at the end" if self.has_loops else ""
        self.description = f"{_description(config)}{closing}"
        self.slam = Slam(config, T_base_lidar if is_mounted else None, dimension=len(T_base_lidar) - 1)

    def track(self, scan: Scan) -> Pose:
        """T_odom_lidar (d+1, d+1)."""
        return self.slam.process(scan).T_odom_lidar

    def finish(self, odometry: Trajectory, folder: Path) -> Trajectory:
        """The final poses; tables go into the folder."""
        self.result = result = self.slam.finish()
        trajectory = result.trajectory if self.has_loops else odometry
        write_table(folder / STEPS_FILE, steps_table(result.steps, trajectory, result.T_base_lidar))
        if self.has_loops:
            final = final_verdicts(result.closures, result.state)
            write_table(folder / CLOSURES_FILE, closures_table(final, result.keyframes, odometry.dimension))
        return trajectory

    def measure_errors(self, scans: StoredScans, folder: Path) -> None:
        """Write the expected ATE, by processing all scans once more, into the folder."""
        again = scans.scans() if self.config.outputs.error_bars == "full" else None
        expected = expected_of(self.result, again, scans.distorted_share)
        (folder / METRICS_FILE).write_bytes(msgspec.json.encode({"expected_ate_m": expected and expected.ate}))


def _description(config: Config) -> str:
    wheels = "wheels where the log has them" if config.odometry.prior != "constant-velocity" else "no wheels"
    deskewing = "deskewing where the log has times" if config.preprocess.deskew else "no deskewing"
    steps = f" by {config.matching.optimizer}" if config.matching.matcher == "plicp" else ""
    size_m = np.format_float_positional(config.local_map.voxel_size_m, trim="-")
    return (
        f"ours, {config.matching.matcher}{steps}, scan to map, voxels of {size_m} m, "
        f"one thread, {wheels}, {'with' if config.odometry.imu else 'no'} IMU, {deskewing}"
    )
