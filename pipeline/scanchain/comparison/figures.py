"""Figures of a method, and their columns in tables: heads, units, digits, best value."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from msgspec import Struct


class Figures(Struct, frozen=True):
    """A row of the table; errors are None without ground truth or relations, or after a failure."""

    ate_m: float | None = None
    ate_share: float | None = None
    ate_rotation_rad: float | None = None
    rpe_1_s_m: float | None = None
    rpe_10_m_m: float | None = None
    rpe_100_m_m: float | None = None
    kitti_share: float | None = None
    kitti_rad_per_m: float | None = None
    paired_share: float | None = None
    relations_m: float | None = None
    relations_rad: float | None = None
    nees: float | None = None
    thickness_m: float | None = None
    entropy: float | None = None
    disagreement_m: float | None = None
    median_s: float | None = None
    p95_s: float | None = None
    cpu_s: float | None = None
    first_s: float | None = None
    scans_per_s: float | None = None
    preprocess_s: float | None = None
    match_s: float | None = None
    map_s: float | None = None
    loops_s: float | None = None
    start_s: float | None = None
    finish_s: float | None = None
    peak_mib: float | None = None
    repeats_apart_m: float | None = None


class Shown(Struct, frozen=True):
    """A figure as text, – where there is none; True if it is the best of its column."""

    text: str
    is_best: bool


class Column(Struct, frozen=True):
    """Presentation of a figure.

    Attributes
    ----------
    key : the field of ``Figures``
    head, unit : what stands above it
    scale : from the field's unit to the shown one
    digits : after the point, at most
    better : which values are marked as the best; none of a figure that is not about accuracy or cost, as the NEES
        of a bad method may be near 1
    table : the summary, which the short tables are, or one of the two that hold the rest
    definition : its meaning, in a sentence
    """

    key: str
    head: str
    unit: str
    scale: float
    digits: int
    better: Literal["low", "high", ""]
    table: Literal["summary", "accuracy", "time"]
    definition: str

    @property
    def heading(self) -> str:
        """Head with its unit."""
        return f"{self.head} [{self.unit}]" if self.unit else self.head

    def of(self, figures: Figures) -> float | None:
        """The shown value of a row."""
        value: float | None = getattr(figures, self.key)
        return None if value is None else self.scale * value

    def cells(self, rows: Sequence[Figures]) -> list[Shown]:
        """The figures of a table's rows; none is the best where all that are known are equal as text."""
        values = [self.of(row) for row in rows]
        digits = self._digits([abs(value) for value in values if value])
        badness = [None if value is None else self._badness(round(value, digits)) for value in values]
        known = {each for each in badness if each is not None}
        is_contest = bool(self.better) and len(known) > 1
        return [
            Shown("–", False) if value is None else Shown(f"{value:.{digits}f}", is_contest and each == min(known))
            for value, each in zip(values, badness, strict=True)
        ]

    def _digits(self, sizes: list[float]) -> int:
        """As many as the smallest needs for three figures."""
        return min(self.digits, max(0, 2 - math.floor(math.log10(min(sizes))))) if sizes else self.digits

    def _badness(self, shown: float) -> float:
        return {"low": shown, "high": -shown, "": 0.0}[self.better]


_DEGREES = 57.29577951308232

COLUMNS = (
    Column("ate_m", "ATE", "m", 1.0, 4, "low", "summary",
        "rmse of positions after rigid alignment, without scale"),
    Column("ate_share", "ATE/path", "%", 100.0, 3, "low", "accuracy", "the same over the length of the path"),
    Column("ate_rotation_rad", "ATE rot.", "deg", _DEGREES, 3, "low", "accuracy",
        "rmse of the angle after alignment"),
    Column("rpe_1_s_m", "RPE 1 s", "mm", 1e3, 1, "low", "summary", "rmse of the motion over 1 s"),
    Column("rpe_10_m_m", "RPE 10 m", "mm", 1e3, 1, "low", "accuracy",
        "rmse of the motion over 10 m of the true path"),
    Column("rpe_100_m_m", "RPE 100 m", "mm", 1e3, 1, "low", "accuracy", "rmse of the motion over 100 m"),
    Column("kitti_share", "KITTI", "%", 100.0, 3, "low", "summary",
        "mean drift over 100 to 800 m, short paths 10 to 40 m"),
    Column("kitti_rad_per_m", "KITTI rot.", "deg/m", _DEGREES, 4, "low", "accuracy",
        "mean turn per meter over the same"),
    Column("paired_share", "paired", "%", 100.0, 1, "", "accuracy",
        "share of the scans that have a true pose, interpolated or not"),
    Column("relations_m", "relations", "m", 1.0, 4, "low", "summary",
        "mean absolute error over manually verified relations"),
    Column("relations_rad", "relations", "deg", _DEGREES, 3, "low", "summary", "the same, of the angle"),
    Column("nees", "NEES", "", 1.0, 2, "", "accuracy",
        "squared error of a motion over its covariance; 1 is exact"),
    Column("thickness_m", "surfaces", "mm", 1e3, 2, "low", "summary",
        "thickness of the map's surfaces; needs no ground truth"),
    Column("entropy", "entropy", "nats", 1.0, 3, "low", "accuracy", "mean map entropy; needs no ground truth"),
    Column("disagreement_m", "to others", "mm", 1e3, 1, "", "summary",
        "median distance of a motion to that of the other methods"),
    Column("median_s", "time", "ms", 1e3, 2, "low", "summary", "median time of a scan, all but the first"),
    Column("p95_s", "p95", "ms", 1e3, 2, "low", "summary", "95th percentile of the same"),
    Column("cpu_s", "CPU", "ms", 1e3, 2, "low", "summary", "median CPU time of a scan, all threads together"),
    Column("first_s", "first", "ms", 1e3, 1, "low", "time",
        "time of the first scan, everything compiled and loaded"),
    Column("scans_per_s", "rate", "scans/s", 1.0, 1, "high", "time", "scans over the sum of their times"),
    Column("preprocess_s", "preprocess", "ms", 1e3, 2, "", "time",
        "median of cropping and downsampling, reported by our methods only"),
    Column("match_s", "match", "ms", 1e3, 2, "", "time", "median of matching"),
    Column("map_s", "map", "ms", 1e3, 2, "", "time", "median of extending the local map"),
    Column("loops_s", "loops", "ms", 1e3, 2, "", "time", "mean of keyframes, loop closures and optimizations"),
    Column("start_s", "start", "s", 1.0, 1, "", "time", "import, loading what is compiled, warming up"),
    Column("finish_s", "finish", "s", 1.0, 2, "", "time", "after the last scan: optimization, tables"),
    Column("peak_mib", "memory", "MiB", 1.0, 0, "low", "summary",
        "peak of the process, interpreter and packages included"),
    Column("repeats_apart_m", "repeats", "m", 1.0, 4, "low", "accuracy",
        "largest distance between runs of the same method"),
)  # fmt: skip


def columns_of(rows: Sequence[Figures], table: str) -> list[Column]:
    """The columns of a table with a figure in at least one row."""
    return [
        column for column in COLUMNS if column.table == table and any(column.of(row) is not None for row in rows)
    ]
