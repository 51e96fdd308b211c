"""Odometries that evalio compiles behind one interface, as baselines ``evalio:NAME`` (arXiv 2507.16000).

Their settings are evalio's parameters, and ``min_range`` and ``max_range`` of its LidarParams.
"""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from scanchain import lie
from scanchain.baselines import BASELINES, DISTORTED, AtStamp, Entry, finite
from scanchain.data import Inertial, Matrix, Pose, RawPoints, Vector
from scanchain.errors import InputError, MissingExtraError, NotApplicableError

_PREFIX = "evalio:"
PIPELINES = tuple(_PREFIX + name for name in ("ct", "dlio", "form", "genz", "kiss", "liosam", "loam", "mad"))
_WANT_LINES, _WANT_IMU = ("form", "liosam", "loam"), ("dlio", "liosam")
_HELD = {"ct": 0.0, "kiss": 1.0}  # share of the sweep at which a pose holds; of the others it is the middle
_LATE = {"liosam": 2}  # number of scans by which a pose is older than the scan that it is returned for
_RANGES_M = {"min_range": 0.1, "max_range": 100.0}  # above 0, since points at the origin stand for none
_RATE_HZ = 10.0  # where points have no times
# No scan left out or cut short for lack of time, and no calibration of the IMU, which needs 3 s of standstill.
_CHANGED: dict[str, dict[str, Any]] = {
    "dlio": {"imu_calibrate": False},
    "kiss": {"deskew": True},
    "liosam": {"mappingProcessInterval": 0.0},
    "mad": {"realtime": False},
}
_UNTIMED = {"kiss": {"deskew": False}, "ct": {"motion_compensation": "NONE", "distance": "POINT_TO_PLANE"}}
_LEAST_LINES, _MOST_LINES = 4, 256
_BACK_RAD = 1.0  # turn against the rotation with which the next scan line begins
_APART_RAD = 1e-3  # least difference in elevation between scan lines
_STEP_RAD = 0.05  # largest usual turn between neighboring points of a line
_MOSTLY = 0.9  # share of the lines that ascend, or of such turns
_SPARE = 1.05  # columns over the points of the fullest line of the first scan
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4"), ("row", "<u2"), ("col", "<u2")])


def entry_of(base: str) -> Entry | None:
    """The baseline of this name, or the pipeline of evalio; None for any other method."""
    if not base.startswith(_PREFIX):
        return BASELINES.get(base)
    name, settings = base.removeprefix(_PREFIX), Struct()
    try:
        known: dict[str, Any] = _imported("evalio.pipelines").all_pipelines()
    except MissingExtraError:
        pass  # its row of the table will say so
    else:
        if name not in known:
            raise InputError(f"evalio has no pipeline {name!r}; choose among {', '.join(sorted(known))}")
        defaults = _RANGES_M | known[name].default_params() | _CHANGED.get(name, {})
        fields = [(key, type(value), value) for key, value in defaults.items()]
        settings = msgspec.defstruct("Parameters", fields, frozen=True, forbid_unknown_fields=True)()
    forgets, wants_imu = name != "genz", name in _WANT_IMU
    return Entry(partial(EvalioPipeline, name), "evalio", settings, None, forgets=forgets, wants_imu=wants_imu)


def _imported(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingExtraError("evalio", "evalio") from None


class EvalioPipeline:
    """A pipeline of evalio, started with the first scan, by which its lidar is known."""

    def __init__(self, name: str, settings: Struct) -> None:
        self.types, self.helpers = _imported("evalio.types"), _imported("evalio._cpp.helpers")
        kind = _imported("evalio.pipelines").all_pipelines()[name]
        self.name, self.pipeline = name, kind()
        self.params: dict[str, Any] = msgspec.to_builtins(settings)
        self.ranges = {key: self.params.pop(key) for key in _RANGES_M}
        untimed = ", ".join(f"{key} {value}" for key, value in _UNTIMED.get(name, {}).items())
        changed = [f"{key} {value}, " for key, value in self.params.items() if value != kind.default_params()[key]]
        self.description = (
            f"{kind.__name__} {kind.version()} of evalio, {self.ranges['min_range']:g} to "
            f"{self.ranges['max_range']:g} m, {''.join(changed)}else its defaults"
            f"{'; without times of points ' * bool(untimed)}{untimed}"
            f"{'; its poses, two scans late, are extrapolated' * (name in _LATE)}"
        )
        self.lines: ScanLines | None = None
        self.at_stamp, self.held_ns, self.samples = AtStamp(), list[int](), list[tuple[int, Vector, Vector]]()
        self.T_imu_lidar, self.T_odom_imu, self.scans = np.eye(4), np.eye(4), 0

    def add_inertial(self, inertial: Inertial) -> None:
        """Add the samples since the scan before; without a transform the IMU is taken to lie in the lidar."""
        if not self.scans and inertial.T_lidar_imu is not None:
            self.T_imu_lidar = lie.inverse(inertial.T_lidar_imu)
        self.samples += zip(inertial.stamps_ns.tolist(), inertial.rates, inertial.accelerations, strict=True)

    def track(self, points: RawPoints, times_s: NDArray[np.float32], stamp_ns: int) -> Pose:
        """Register one scan; the pose is moved to the scan's stamp.

        Raises NotApplicableError at the first scan if the log lacks what the pipeline needs.
        """
        frame, times = finite(points, times_s)
        first_s, last_s = (float(times.min()), float(times.max())) if len(times) else (0.0, 0.0)
        if not self.scans:
            self._start(frame, last_s - first_s)
        self.scans += 1
        for sample_ns, rate, acceleration in self.samples:
            stamp = self.types.Stamp.from_nsec(sample_ns)
            self.pipeline.add_imu(self.types.ImuMeasurement(stamp, rate, acceleration))
        self.samples.clear()
        self.pipeline.add_lidar(self._measurement(frame, times - first_s, stamp_ns + round(1e9 * first_s)))
        for _, T_odom_imu in self.pipeline.saved_estimates():
            self.T_odom_imu = T_odom_imu.to_mat()
        is_distorted = self.params.get("deskew") is False or (self.name == "kiss" and self.scans <= DISTORTED)
        share = 0.5 if is_distorted else _HELD.get(self.name, 0.5)
        self.held_ns.append(stamp_ns + round(1e9 * (first_s + share * (last_s - first_s))))
        held_ns = self.held_ns[max(self.scans - 1 - _LATE.get(self.name, 0), 0)]
        return self.at_stamp.move(self.T_odom_imu @ self.T_imu_lidar, stamp_ns, 1e-9 * (held_ns - stamp_ns))

    def _start(self, points: Matrix, sweep_s: float) -> None:
        if self.name in _WANT_IMU and not self.samples:
            raise NotApplicableError("needs an IMU, of which the first scan has no sample")
        if not sweep_s:
            self.params |= _UNTIMED.get(self.name, {})
        rows, columns = 1, len(points)
        if self.name in _WANT_LINES:
            self.lines = ScanLines(points)
            rows, columns = self.lines.rows, self.lines.columns
        rate_hz = 1.0 / sweep_s if sweep_s else _RATE_HZ
        self.pipeline.set_params(self.params)
        self.pipeline.set_lidar_params(
            self.types.LidarParams(num_rows=rows, num_columns=columns, rate=rate_hz, **self.ranges)
        )
        self.pipeline.set_imu_params(self.types.ImuParams.down())
        self.pipeline.set_imu_T_lidar(self.types.SE3.from_mat(self.T_imu_lidar))
        self.pipeline.initialize()

    def _measurement(self, points: Matrix, times_s: NDArray[np.float64], begin_ns: int) -> Any:
        """The scan, in the order of its scan lines where they are known."""
        cloud = np.zeros(len(points), _POINT)
        cloud["x"], cloud["y"], cloud["z"] = points.T
        cloud["t"] = np.rint(1e9 * times_s) if len(times_s) else 0
        if self.lines is not None:
            cloud = self.lines.organized(cloud, points)
        kinds = self.helpers.DataType
        numbers = {"<f4": kinds.FLOAT32, "<u4": kinds.UINT32, "<u2": kinds.UINT16}
        fields = [
            self.helpers.Field(name=name, datatype=numbers[kind.str], offset=offset)
            for name, (kind, offset, *_) in (_POINT.fields or {}).items()
        ]
        size, stamp = len(cloud), self.types.Stamp.from_nsec(begin_ns)
        about = self.helpers.PointCloudMetadata(
            stamp=stamp, width=size, height=1, point_step=_POINT.itemsize, row_step=cloud.nbytes,
            is_bigendian=0, is_dense=1,
        )  # fmt: skip
        return self.helpers.pc2_to_evalio(about, fields, cloud.tobytes())


class ScanLines:
    """Scan lines of a lidar, found in the first scan by the order of its points, or else by their elevations.

    Raises NotApplicableError where neither shows them.
    """

    def __init__(self, points: Matrix) -> None:
        self.edges = np.empty(0)  # elevations between the lines; empty where the order shows them
        elevations = _elevations(points)
        lines = self._of(points)
        if not _are_lines(lines, points, elevations):
            ordered = np.sort(elevations)
            gaps = np.flatnonzero(np.diff(ordered) > _APART_RAD)
            self.edges = 0.5 * (ordered[gaps] + ordered[gaps + 1])
            lines = self._of(points)
            if not len(gaps) or not _are_lines(lines, points, elevations):
                raise NotApplicableError(
                    "needs the lidar's scan lines, which neither the order of the points nor their elevations show"
                )
        counts = np.bincount(lines)
        self.rows, self.columns = len(counts), round(_SPARE * counts.max())

    def organized(self, cloud: NDArray[np.void], points: Matrix) -> NDArray[np.void]:
        """A row for each line, without holes, since features are found by neighbors; filled up with zeros."""
        lines = self._of(points)
        order = np.argsort(lines, kind="stable")
        lines = lines[order]
        columns = np.arange(len(lines)) - np.searchsorted(lines, lines)
        result = np.zeros((self.rows, self.columns), _POINT)
        fits = (lines < self.rows) & (columns < self.columns)
        result[lines[fits], columns[fits]] = cloud[order[fits]]
        result["row"], result["col"] = np.indices(result.shape)
        return result.ravel()

    def _of(self, points: Matrix) -> NDArray[np.int16]:
        """Line of each point (N,)."""
        if not len(points):
            return np.empty(0, np.int16)
        if len(self.edges):
            return np.searchsorted(self.edges, _elevations(points)).astype(np.int16)
        azimuths = np.arctan2(points[:, 1], points[:, 0])
        sense = np.copysign(1.0, np.median(_turns(azimuths)))
        turned = sense * (azimuths - azimuths[0]) % (2.0 * np.pi)
        return np.cumsum(np.diff(turned, prepend=0.0) < -_BACK_RAD).astype(np.int16)


def _elevations(points: Matrix) -> NDArray[np.float64]:
    return np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))


def _turns(azimuths: NDArray[np.float64]) -> NDArray[np.float64]:
    return (np.diff(azimuths) + np.pi) % (2.0 * np.pi) - np.pi


def _are_lines(lines: NDArray[np.int16], points: Matrix, elevations: NDArray[np.float64]) -> bool:
    """True if they are a plausible number, ascend or descend, and their points are in order."""
    count = int(lines.max()) + 1
    if not _LEAST_LINES <= count <= _MOST_LINES:
        return False
    order = np.argsort(lines, kind="stable")
    heights = [
        np.median(each) for each in np.split(elevations[order], np.searchsorted(lines[order], range(1, count)))
    ]
    turns = _turns(np.arctan2(points[order, 1], points[order, 0]))
    return bool(abs(np.sign(np.diff(heights)).mean()) > _MOSTLY and (np.abs(turns) < _STEP_RAD).mean() > _MOSTLY)
