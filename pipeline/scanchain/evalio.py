"""scanchain as a pipeline of evalio: ``python -m scanchain.evalio run -d NAME/SEQUENCE -p scanchain``.

That is evalio's command line with the pipeline; elsewhere evalio finds it by ``EVALIO_CUSTOM=scanchain.evalio``.
Its parameters are keys of the configuration, those of 3D logs by default: ``local_map.voxel_size_m: 0.5``.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import msgspec
import numpy as np

from scanchain import lie
from scanchain.ahead import compile_ahead
from scanchain.data import Inertial, Scan, Vector
from scanchain.errors import MissingExtraError
from scanchain.settings import leaves, load_settings, overrides_of
from scanchain.slam import Slam

try:
    from evalio.pipelines import Pipeline, register_pipeline
    from evalio.types import SE3, ImuMeasurement, ImuParams, LidarMeasurement, LidarParams, Stamp
except ImportError:
    raise MissingExtraError("evalio", "evalio") from None

_NOT = "log", "maps", "recording", "outputs"  # sections of the configuration that do not change poses


class ScanchainPipeline(Pipeline):
    """Odometry with loop closures, whose poses are those right after each scan.

    A scan waits for the samples of the IMU during its sweep: until the first one after it, or the next scan.
    """

    def __init__(self) -> None:
        super().__init__()
        self.params = self.default_params()
        self.T_lidar_imu = np.eye(4)
        self.samples: list[tuple[int, Vector, Vector]] = []
        self.last_imu_ns: int | None = None  # stamp of the latest sample; None without an IMU
        self.waiting: Scan | None = None

    @staticmethod
    def name() -> str:
        """Its name for ``-p``."""
        return "scanchain"

    @staticmethod
    def version() -> str:
        """The version of scanchain."""
        return version("scanchain")

    @staticmethod
    def url() -> str:
        """The address of its project, which has none yet."""
        return ""

    @staticmethod
    def default_params() -> dict[str, Any]:
        """The preset of 3D logs: keys of the sections that change poses."""
        tree: dict[str, Any] = msgspec.to_builtins(load_settings(3).config)
        return dict(leaves({section: keys for section, keys in tree.items() if section not in _NOT}))

    def set_params(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Set keys of the configuration; the unknown ones are returned."""
        self.params |= {key: value for key, value in params.items() if key in self.params}
        return {key: value for key, value in params.items() if key not in self.params}

    def set_imu_params(self, params: ImuParams) -> None:
        """Nothing: noise and biases are estimated."""

    def set_lidar_params(self, params: LidarParams) -> None:
        """Retain the range of the lidar, if it is smaller than that of the parameters."""
        least, most = "preprocess.min_range_m", "preprocess.max_range_m"
        self.params[least] = max(self.params[least], params.min_range)
        self.params[most] = min(self.params[most], params.max_range)

    def set_imu_T_lidar(self, T: SE3) -> None:
        """Retain the mounting."""
        self.T_lidar_imu = lie.inverse(np.array(T.to_mat()))

    def initialize(self) -> None:
        """Start before the first scan; InputError for a value out of its limits."""
        compile_ahead(["3d"], lambda done, total: None)
        config = load_settings(3, overrides=overrides_of(self.params)).config
        self.slam = Slam(config, lie.inverse(self.T_lidar_imu), dimension=3)

    def add_imu(self, mm: ImuMeasurement) -> None:
        """Add a sample; those not later than one before are left out."""
        stamp_ns = mm.stamp.to_nsec()
        if self.last_imu_ns is None or stamp_ns > self.last_imu_ns:
            self.samples.append((stamp_ns, mm.gyro, mm.accel))
            self.last_imu_ns = stamp_ns
        if self.waiting is not None and stamp_ns >= _end_ns(self.waiting):
            self._process(self.waiting)

    def add_lidar(self, mm: LidarMeasurement) -> None:
        """Process a scan, or let it wait for samples of the IMU, and process the one that has waited."""
        if self.waiting is not None:
            self._process(self.waiting)
        points, times_s = (np.array(each, np.float32) for each in (mm.to_vec_positions(), mm.to_vec_stamps()))
        valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
        stamp_ns, dropped = mm.stamp.to_nsec(), len(points) - int(np.count_nonzero(valid))
        self.waiting = Scan(-1, stamp_ns, stamp_ns, points[valid], times_s[valid], dropped, None)
        if self.last_imu_ns is None or self.last_imu_ns >= _end_ns(self.waiting):
            self._process(self.waiting)

    def map(self) -> dict[str, list[Any]]:
        """Nothing: the map is not drawn by evalio."""
        return {}

    def _process(self, scan: Scan) -> None:
        end_ns, inertial = _end_ns(scan), None
        if used := [sample for sample in self.samples if sample[0] <= end_ns]:
            stamps_ns, rates, accelerations = (np.array(column) for column in zip(*used, strict=True))
            inertial = Inertial(stamps_ns, rates, accelerations, self.T_lidar_imu)
        step = self.slam.process(replace(scan, inertial=inertial))
        self.save(Stamp.from_nsec(scan.stamp_ns), SE3.from_mat(step.T_odom_lidar @ self.T_lidar_imu))
        self.samples, self.waiting = self.samples[len(used) :], None


def _end_ns(scan: Scan) -> int:
    """Stamp of the last point."""
    return scan.stamp_ns + round(1e9 * float(scan.times_s.max(initial=0.0)))


def main() -> None:
    """Run evalio's command line, which of rerun needs an older version or none."""
    sys.modules["rerun"] = None  # pyright: ignore[reportArgumentType]
    register_pipeline(ScanchainPipeline)
    from evalio.cli import app

    app()


if __name__ == "__main__":
    main()
