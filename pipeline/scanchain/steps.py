"""Figures of all scans so far, in columns."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Integers, Matrix, State, Step, Trajectory, Vector
from scanchain.growing_array import Columns

STAGES = ("read", "preprocess", "match", "map", "loops")
SENSORS = ("wheels", "gyro", "accelerometer", "GNSS")  # that are compared with the matches
_OF_SCAN = ("index", "stamp_ns", "log_time_ns", "dropped", "is_copy")
_OF_STEP = ("keyframe", "state", "reason", "starts_segment", "T_odom_lidar", "T_world_lidar")
_OF_MATCH = (
    "points", "inliers", "iterations", "residual_m", "fit", "converged", "degeneracy_eigenvalue", "observability",
    "degeneracy_direction", "information", "variance_factor",
)  # fmt: skip


class Steps:
    """Figures of all steps in columns, without points: adding a step takes microseconds and under a kilobyte."""

    def __init__(self) -> None:
        self.columns = Columns()

    def __len__(self) -> int:
        return len(self.columns)

    def append(self, step: Step) -> None:
        """Add one step."""
        scan, match = step.scan, step.match
        unknown = np.full_like(step.T_odom_lidar, np.nan)
        self.columns.append({
            "scan_points": len(scan.points),
            "match_reason": match.reason,
            "has_wheels": scan.T_odom_base is not None,
            "T_odom_base": unknown if scan.T_odom_base is None else scan.T_odom_base,
            "timing": [getattr(step.timing, f"{stage}_s") for stage in STAGES],
            "cost_m2": match.cost,
            **{f"innovation_{sensor}": step.innovations.get(sensor, np.nan) for sensor in SENSORS},
            **{name: getattr(scan, name) for name in _OF_SCAN},
            **{name: getattr(step, name) for name in _OF_STEP},
            **{name: getattr(match, name) for name in _OF_MATCH},
        })  # fmt: skip

    def compare(self, sensor: str, stamps_ns: Integers, innovations: Vector) -> None:
        """Set normalized innovations (M,) of a sensor, each at the scan nearest to its stamp (M,)."""
        scans_ns = self.columns["stamp_ns"]
        after = np.clip(np.searchsorted(scans_ns, stamps_ns), 1, len(scans_ns) - 1)
        values = np.full(len(scans_ns), np.nan)
        values[after - (2 * stamps_ns < scans_ns[after - 1] + scans_ns[after])] = innovations
        self.columns.replace(f"innovation_{sensor}", values)

    @property
    def innovations(self) -> dict[str, Vector]:
        """(N,) normalized innovations, NaN where not compared, of each sensor that was compared at some scan."""
        found = {sensor: self.columns[f"innovation_{sensor}"] for sensor in SENSORS}
        return {sensor: values for sensor, values in found.items() if np.isfinite(values).any()}

    def trajectory(self, name: str) -> Trajectory:
        """Trajectory of the steps so far, ``T_odom_lidar`` or ``T_world_lidar``, as estimated at each step."""
        return Trajectory(self.columns["stamp_ns"].copy(), self.columns[name].copy())

    @property
    def span_s(self) -> float:
        """Log time from the first step to the last."""
        times_ns = self.columns["log_time_ns"]
        return int(times_ns[-1] - times_ns[0]) * 1e-9 if len(times_ns) else 0.0

    def covariances(self) -> Matrix:
        """(N, k, k) of the matches, of lidar-frame twists; NaN where a direction is unobservable."""
        informations = self.columns["information"]
        finite = np.atleast_1d(np.isfinite(informations).all(axis=(1, 2)))
        values, vectors = np.linalg.eigh(np.where(finite[:, None, None], informations, 0.0))
        sound = finite & (values[:, 0] > 1e-12 * values[:, -1]) & (values[:, -1] > 0.0)
        scaled = vectors / np.sqrt(np.where(sound[:, None], values, np.nan))[:, None, :]
        return self.columns["variance_factor"][:, None, None] * (scaled @ np.swapaxes(scaled, 1, 2))

    def states(self) -> Counter[State]:
        """Number of steps in each state."""
        return Counter(map(State, self.texts("state")))

    @property
    def inlier_shares(self) -> NDArray[np.float64]:
        """(N,) ``Match.inlier_share``."""
        return self.columns["inliers"] / np.maximum(self.columns["points"], 1)

    def texts(self, name: str) -> list[str]:
        """A column of texts, (N,)."""
        names = self.columns.texts
        return [names[code] for code in self.columns[name].tolist()]
