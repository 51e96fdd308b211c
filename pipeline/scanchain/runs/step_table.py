"""steps.parquet: one row a scan, and the NEES of its covariances."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Match, Matrix, Pose, State, Step, Timing, Trajectory
from scanchain.evaluation import motion_nees, pair
from scanchain.verdict import check_overlap, check_velocity, check_wheels

if TYPE_CHECKING:
    import pyarrow as pa

_SINGULAR = 1e-12  # smallest over largest eigenvalue of an information matrix below which it is not inverted


class StepRow(msgspec.Struct, frozen=True):
    """A step without its points."""

    index: int
    stamp_ns: int
    log_time_ns: int
    points: int
    dropped: int
    T_odom_lidar: Pose
    T_world_lidar: Pose
    match: Match
    state: State
    reason: str
    keyframe: int
    timing: Timing
    T_odom_base: Pose | None = None
    starts_segment: bool = False
    is_copy: bool = False


class StepTable:
    """Rows of all steps, in columns: a row takes microseconds, and a quarter of the memory of its objects."""

    def __init__(self) -> None:
        self._recent: list[StepRow] = []
        self._parts: list[NDArray[np.void]] = []
        self._texts: dict[str, int] = {}

    def __len__(self) -> int:
        return _PART * len(self._parts) + len(self._recent)

    def append(self, step: Step) -> StepRow:
        """Keep one step; what is kept of it."""
        scan = step.scan
        row = StepRow(
            scan.index,
            scan.stamp_ns,
            scan.log_time_ns,
            len(scan.points),
            scan.dropped,
            step.T_odom_lidar,
            step.T_world_lidar,
            step.match,
            step.state,
            step.reason,
            step.keyframe,
            step.timing,
            scan.T_odom_base,
            step.starts_segment,
            scan.is_copy,
        )
        self.add(row)
        return row

    def add(self, row: StepRow) -> None:
        """Keep a row."""
        self._recent.append(row)
        if len(self._recent) == _PART:
            self._parts.append(self._packed(self._recent))
            self._recent = []

    @property
    def rows(self) -> Iterator[StepRow]:
        """The rows, unpacked from the columns one by one."""
        texts = list(self._texts)
        for part in self._parts:
            for packed in part:
                yield _row(packed, texts)
        yield from self._recent

    @property
    def columns(self) -> NDArray[np.void]:
        """(N,) the steps as a structured array; ``texts`` has what state and reasons refer to."""
        recent = [self._packed(self._recent)] if self._recent else []
        parts = [*self._parts, *recent]
        return np.concatenate(parts) if parts else np.empty(0, _layout(3, 3))

    def texts(self, codes: NDArray[np.int64]) -> pa.DictionaryArray:
        """Texts (N,) of these codes."""
        import pyarrow as pa

        used, places = np.unique(codes, return_inverse=True)
        first = np.unique(codes, return_index=True)[1]
        order = np.argsort(first)  # as they occur
        names = list(self._texts)
        return pa.DictionaryArray.from_arrays(
            pa.array(np.argsort(order)[places].astype(np.int32)),
            pa.array([names[used[k]] for k in order.tolist()]),
        )

    @property
    def odometry(self) -> Trajectory:
        """T_odom_lidar of the steps so far."""
        return self._trajectory("T_odom_lidar")

    @property
    def best_known(self) -> Trajectory:
        """T_world_lidar of the steps so far, each as it was known at its time."""
        return self._trajectory("T_world_lidar")

    @property
    def span_s(self) -> float:
        """Log time from the first step to the last."""
        times_ns = self.columns["log_time_ns"]
        return int(times_ns[-1] - times_ns[0]) * 1e-9 if len(times_ns) else 0.0

    def covariances(self) -> list[Matrix | None]:
        """Covariance (k, k) of each match, of a lidar-frame twist; None where a direction is unobservable."""
        values, is_sound = _covariances(self.columns)
        return [value if good else None for value, good in zip(values, is_sound.tolist(), strict=True)]

    def states(self) -> Counter[State]:
        """Number of steps in each state."""
        codes, counts = np.unique(self.columns["state"], return_counts=True)
        names = list(self._texts)
        return Counter({State(names[code]): count for code, count in zip(codes, counts.tolist(), strict=True)})

    def write(self, path: Path, trajectory: Trajectory, T_base_lidar: Pose | None = None) -> None:
        """Write the table; ``trajectory`` has the final pose of each step, ``T_base_lidar`` is for the wheels."""
        import pyarrow.parquet as pq

        pq.write_table(self.table(trajectory, T_base_lidar), path, compression="zstd")

    def table(self, trajectory: Trajectory, T_base_lidar: Pose | None = None) -> pa.Table:
        """The table, as ``write`` writes it."""
        import pyarrow as pa

        steps = self.columns
        covariances, is_sound = _covariances(steps)
        columns: dict[str, object] = {
            **{name: steps[name] for name in ("index", "stamp_ns", "log_time_ns")},
            **pose_columns(trajectory.poses),
            **{f"odom_{name}": values for name, values in pose_columns(steps["T_odom_lidar"]).items()},
            **self._checks(steps, trajectory, T_base_lidar),
            "covariance": _lists(covariances, ~is_sound),
            **{name: steps[name] for name in ("scan_points", "dropped", *_OF_MATCH[:6])},
            "converged": steps["converged"],
            "match_reason": self.texts(steps["match_reason"]),
            "degeneracy_eigenvalue": steps["degeneracy_eigenvalue"],
            "observability": steps["observability"],
            "degeneracy_direction": _lists(steps["degeneracy_direction"]),
            "state": self.texts(steps["state"]),
            "reason": self.texts(steps["reason"]),
            "starts_segment": steps["starts_segment"],
            "is_copy": steps["is_copy"],
            "keyframe": steps["keyframe"],
            **{f"{stage}_s": steps["timing"][:, k] for k, stage in enumerate(STAGES)},
        }
        arrays = {
            name: pa.array(np.ascontiguousarray(values)) if isinstance(values, np.ndarray) else values
            for name, values in columns.items()
        }
        return pa.table(arrays).replace_schema_metadata(_NOTES)

    def _packed(self, rows: Sequence[StepRow]) -> NDArray[np.void]:
        first = rows[0]
        result = np.empty(len(rows), _layout(len(first.T_odom_lidar), len(first.match.information)))
        for name, values in {
            "index": [row.index for row in rows],
            "stamp_ns": [row.stamp_ns for row in rows],
            "log_time_ns": [row.log_time_ns for row in rows],
            "scan_points": [row.points for row in rows],
            "dropped": [row.dropped for row in rows],
            "T_odom_lidar": [row.T_odom_lidar for row in rows],
            "T_world_lidar": [row.T_world_lidar for row in rows],
            "state": [self._code(str(row.state)) for row in rows],
            "reason": [self._code(row.reason) for row in rows],
            "keyframe": [row.keyframe for row in rows],
            "timing": [[getattr(row.timing, f"{stage}_s") for stage in STAGES] for row in rows],
            "has_wheels": [row.T_odom_base is not None for row in rows],
            "starts_segment": [row.starts_segment for row in rows],
            "is_copy": [row.is_copy for row in rows],
            "match_reason": [self._code(row.match.reason) for row in rows],
            **{name: [getattr(row.match, _FIELDS.get(name, name)) for row in rows] for name in _OF_MATCH},
        }.items():
            result[name] = values
        unknown = np.full(first.T_odom_lidar.shape, np.nan)
        result["T_odom_base"] = [unknown if row.T_odom_base is None else row.T_odom_base for row in rows]
        return result

    def _code(self, text: str) -> int:
        return self._texts.setdefault(text, len(self._texts))

    def _checks(
        self, steps: NDArray[np.void], trajectory: Trajectory, T_base_lidar: Pose | None
    ) -> dict[str, object]:
        """Poses by the wheels, and normalized innovations of the independent checks, null where there are none."""
        import pyarrow as pa

        velocity = check_velocity(trajectory.stamps_ns, steps["log_time_ns"].copy(), trajectory.poses)
        overlap = check_overlap(inlier_shares(steps))
        columns: dict[str, object] = {
            "velocity_innovation": pa.array(velocity, from_pandas=True),
            "overlap_ratio": pa.array(overlap, from_pandas=True),
        }
        if T_base_lidar is None or not steps["has_wheels"].any():
            return columns
        wheels = steps["T_odom_base"] @ T_base_lidar
        innovation = check_wheels(trajectory.poses, wheels).innovation
        return columns | {"wheel_innovation": pa.array(innovation, from_pandas=True)} | _wheel_columns(wheels)

    def _trajectory(self, name: str) -> Trajectory:
        steps = self.columns
        return Trajectory(steps["stamp_ns"].copy(), steps[name].copy())


def inlier_shares(steps: NDArray[np.void]) -> NDArray[np.float64]:
    """``Match.inlier_share`` of steps (N,) in columns."""
    return steps["inliers"] / np.maximum(steps["points"], 1)


_PART = 1024  # rows that are put into columns together
_OF_MATCH = (  # as columns; all of a match but its reason
    "points", "inliers", "iterations", "residual_m", "fit", "cost_m2", "converged", "at_minimum",
    "degeneracy_eigenvalue", "observability", "degeneracy_direction", "information", "T_target_source",
    "variance_factor",
)  # fmt: skip
_FIELDS = {"cost_m2": "cost"}  # of a match, where the column has another name
STAGES = ("read", "preprocess", "match", "map", "loops")
_NOTES = {
    "x y z qx qy qz qw": "T_world_lidar after optimization, meters; odom_*: T_odom_lidar before it; "
    "wheel_*: of the lidar by wheel odometry, null where there is no reading near the stamp",
    "covariance": "row by row, of a twist xi in the lidar's own frame, T exp(xi), order (translation, rotation), "
    "SE(2) 3x3, SE(3) 6x6; null where a direction of the match is unobservable",
    "points, inliers": "of the downsampled scan; scan_points: valid returns, dropped: invalid ones",
    "wheel_innovation": "difference of the motion around the scan from that by the wheels, standard deviations; "
    "null where there is nothing to compare",
    "velocity_innovation": "change of the motion to the scan, standard deviations of what an acceleration can be",
    "starts_segment": "true if the motion from the scan before is unknown: a new map begins there",
    "is_copy": "true if the scan is the one before once more, to the last bit",
    "overlap_ratio": "share of the points with a correspondence over its median in the scans before",
    "keyframe": "number in the graph, -1 if none was made",
}


def _layout(size: int, k: int) -> np.dtype[np.void]:
    """Columns of steps with poses (size, size) and twists (k,)."""
    pose = (np.float64, (size, size))
    whole = dict.fromkeys(("index", "stamp_ns", "log_time_ns", "scan_points", "dropped", "keyframe"), np.int64)
    codes = dict.fromkeys(("state", "reason", "match_reason"), np.int32)
    flags = dict.fromkeys(("has_wheels", "starts_segment", "is_copy", "converged", "at_minimum"), np.bool_)
    counts = dict.fromkeys(("points", "inliers", "iterations"), np.int64)
    numbers = dict.fromkeys(
        ("residual_m", "fit", "cost_m2", "degeneracy_eigenvalue", "observability", "variance_factor"), np.float64
    )
    arrays = {
        **dict.fromkeys(("T_odom_lidar", "T_world_lidar", "T_target_source", "T_odom_base"), pose),
        "information": (np.float64, (k, k)),
        "degeneracy_direction": (np.float64, (k,)),
        "timing": (np.float64, (len(STAGES),)),
    }
    return np.dtype(list((whole | counts | codes | flags | numbers | arrays).items()))


def _row(packed: np.void, texts: Sequence[str]) -> StepRow:
    """The row that was packed."""
    of_match = {_FIELDS.get(name, name): _value(packed[name]) for name in _OF_MATCH}
    return StepRow(
        index=int(packed["index"]),
        stamp_ns=int(packed["stamp_ns"]),
        log_time_ns=int(packed["log_time_ns"]),
        points=int(packed["scan_points"]),
        dropped=int(packed["dropped"]),
        T_odom_lidar=packed["T_odom_lidar"],
        T_world_lidar=packed["T_world_lidar"],
        match=Match(**of_match, reason=texts[int(packed["match_reason"])]),
        state=State(texts[int(packed["state"])]),
        reason=texts[int(packed["reason"])],
        keyframe=int(packed["keyframe"]),
        timing=Timing(*packed["timing"].tolist()),
        T_odom_base=packed["T_odom_base"] if packed["has_wheels"] else None,
        starts_segment=bool(packed["starts_segment"]),
        is_copy=bool(packed["is_copy"]),
    )


def _value(field: Any) -> Any:
    return field if isinstance(field, np.ndarray) else field.item()


def _lists(rows: Matrix, is_null: NDArray[np.bool_] | None = None) -> pa.FixedSizeListArray:
    """Rows (N, ...) as lists of one length, null where so marked (N,)."""
    import pyarrow as pa

    size = int(np.prod(rows.shape[1:]))
    mask = None if is_null is None else pa.array(is_null)
    return pa.FixedSizeListArray.from_arrays(pa.array(rows.reshape(-1)), size, mask=mask)


def pose_columns(poses: Matrix) -> dict[str, NDArray[np.float64]]:
    """Columns x, y, z, qx, qy, qz, qw of poses (N, d+1, d+1)."""
    lifted = lie.lift(poses)
    values = np.hstack([lifted[:, :3, 3], lie.to_quaternion(lifted[:, :3, :3])])
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    return {name: column.copy() for name, column in zip(names, values.T, strict=True)}


def _wheel_columns(poses: Matrix) -> dict[str, object]:
    """Pose columns of poses (N, d+1, d+1), null where one is NaN."""
    import pyarrow as pa

    known = np.isfinite(poses[:, 0, 0])
    columns = pose_columns(np.where(known[:, None, None], poses, np.eye(poses.shape[-1])))
    return {f"wheel_{name}": pa.array(values, mask=~known) for name, values in columns.items()}


def _covariances(steps: NDArray[np.void]) -> tuple[Matrix, NDArray[np.bool_]]:
    """Covariances (N, k, k) of the matches of steps in columns, and True where there is one (N,)."""
    informations = steps["information"]
    finite = np.atleast_1d(np.isfinite(informations).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], informations, 0.0))
    sound = finite & (values[:, 0] > _SINGULAR * values[:, -1]) & (values[:, -1] > 0.0)
    scaled = vectors / np.sqrt(np.where(sound[:, None], values, 1.0))[:, None, :]
    return steps["variance_factor"][:, None, None] * (scaled @ np.swapaxes(scaled, 1, 2)), sound


COLUMNS = ("covariance", "state")


def nees_of_steps(
    steps: pa.Table, odometry: Trajectory, truth: Trajectory, *, gap_s: float | None = None
) -> NDArray[np.float64]:
    """(N,) NEES of the motion up to each scan; NaN without a true pose at both ends, or where a scan was not ok.

    steps : with ``COLUMNS``, a row a scan; odometry : T_odom_lidar of the same scans, SE(2) or lifted
    """
    size = steps.schema.field("covariance").type.list_size
    unknown, k = [np.nan] * size, math.isqrt(size)
    covariances = np.array([row or unknown for row in steps["covariance"].to_pylist()]).reshape(-1, k, k)
    covariances[[state != "ok" for state in steps["state"].to_pylist()]] = np.nan
    pairs = pair(odometry, truth, gap_s=gap_s)
    place = pairs.places
    estimate, reference = pairs.estimate, pairs.reference
    if k == 3:
        estimate, reference = lie.flatten(estimate), lie.flatten(reference)
    nees = motion_nees(estimate, covariances[place], reference)
    nees[np.diff(place) != 1] = np.nan
    result = np.full(len(odometry), np.nan)
    result[place[1:]] = nees
    return result
