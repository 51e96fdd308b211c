"""The table of a comparison: its columns and rows; as JSON, CSV, Markdown, and as text for a terminal."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct

from scanchain.comparison.processes import Status
from scanchain.errors import folded
from scanchain.files import write_json
from scanchain.runs.provenance import Provenance
from scanchain.verdict import Judged, Verdict

TABLE_FILE = "table.json"
Figures = Mapping[str, float | None]  # by key of COLUMNS; unknown without a reference, or after a failure


class Shown(Struct, frozen=True):
    """A figure as text, – where there is none; True if it is the best of its column."""

    text: str
    is_best: bool


class Column(Struct, frozen=True):
    """Presentation of a figure.

    scale : from the figure's unit to the shown one
    digits : after the point, at most
    better : which values are the best; none of a figure that is not about accuracy or cost, as the NEES of a bad
        method may be near 1
    table : the summary, which the short tables are, or one of the two that hold the rest
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
        value = figures.get(self.key)
        return None if value is None else self.scale * value

    def digits_of(self, values: Sequence[float]) -> int:
        """Digits of shown values: as many as the smallest needs for three figures."""
        sizes = [abs(value) for value in values if value]
        return min(self.digits, max(0, 2 - math.floor(math.log10(min(sizes))))) if sizes else self.digits

    def cells(self, rows: Sequence[Figures]) -> list[Shown]:
        """The figures of a table's rows; none is the best where all that are known are equal as text."""
        values = [self.of(row) for row in rows]
        digits = self.digits_of([value for value in values if value is not None])
        sign = {"low": 1.0, "high": -1.0, "": 0.0}[self.better]
        badness = [None if value is None else sign * round(value, digits) for value in values]
        known = {each for each in badness if each is not None}
        is_contest = len(known) > 1
        return [
            Shown("–", False) if value is None else Shown(f"{value:.{digits}f}", is_contest and each == min(known))
            for value, each in zip(values, badness, strict=True)
        ]


_DEGREES = math.degrees(1.0)

COLUMNS = (
    Column("ate_m", "ATE", "m", 1.0, 4, "low", "summary",
        "rmse of positions from the second scan on, after rigid alignment, without scale"),
    Column("start_m", "start", "m", 1.0, 3, "", "summary",
        "error of the motion from the first scan to the second, which nothing predicts; in no other figure"),
    Column("ate_share", "ATE/path", "%", 100.0, 3, "low", "accuracy",
        "ATE over the length of the true path"),
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
    Column("apart_m", "apart", "m", 1.0, 4, "", "summary",
        "median distance of the trajectory to those of the other methods, rmse as for the ATE"),
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


class Row(Struct, frozen=True):
    """A method: end of its runs, settings, and figures.

    status, reason : of the first run that did not end well, else ok
    figures : by key of COLUMNS, None where unknown
    settings : whole, as a TOML file for --config would hold them
    verdict, verdict_reason : on its trajectory, of other tools by wheels and constant velocity; empty if it failed
    verdict_error : the error bound that the verdict states
    """

    name: str
    base: str
    status: Status
    reason: str
    description: str
    settings: dict[str, Any]
    figures: dict[str, float | None]
    definitions: list[str]
    verdict: str = ""
    verdict_reason: str = ""
    verdict_error: str = ""

    @property
    def vouched(self) -> str:
        """Verdict and error in a cell; empty if it failed."""
        is_known = self.verdict_error and self.verdict == Verdict.TRUSTWORTHY
        return f"{self.verdict}, {self.verdict_error}" if is_known else self.verdict

    @property
    def sentence(self) -> str:
        """Verdict, error and reason of one that did not fail."""
        return Judged(Verdict(self.verdict), self.verdict_reason, error=self.verdict_error).sentence

    @property
    def is_doubted(self) -> bool:
        """True if it has a verdict, and another than trustworthy."""
        return self.verdict not in ("", Verdict.TRUSTWORTHY)


class Table(Struct, frozen=True):
    """A comparison.

    truth : reference of the errors; empty without ground truth
    truth_note : how many scans have no true pose, or why a truth could not be used; else empty
    disagreement_m : row by row the median distance between two methods' motions; None where one has failed
    notes : what was chosen or assumed, one per line
    baselines : versions of the packages that were compared
    """

    log: str
    topic: str
    dimension: int
    scans: int
    points_per_scan: float
    repeats: int
    truth: str
    truth_note: str
    rows: list[Row]
    disagreement_m: list[list[float | None]]
    notes: list[str]
    provenance: Provenance
    baselines: dict[str, str]

    @property
    def against(self) -> str:
        """Reference of the errors, in a sentence."""
        note = f" {self.truth_note}." if self.truth_note else ""
        if self.truth:
            return f"Errors are against {self.truth}.{note}"
        return (
            f"There is no ground truth: surfaces and to others are sharpness and disagreement, not accuracy.{note}"
        )

    @property
    def figures(self) -> list[Figures]:
        """Figures of the rows, empty for a row that failed."""
        return [row.figures if row.status is Status.OK else {} for row in self.rows]


def write_table(folder: Path, table: Table) -> None:
    """table.json, table.csv and table.md."""
    tree = msgspec.to_builtins(table) | {"columns": msgspec.to_builtins(COLUMNS)}
    write_json(folder / TABLE_FILE, tree)
    keys = [column.key for column in COLUMNS]
    with (folder / "table.csv").open("w", encoding="utf-8") as file:  # every figure in its own unit
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["method", "status", "verdict", "verdict_error", *keys])
        for row in table.rows:
            figures = [row.figures.get(key) for key in keys]
            writer.writerow([row.name, row.status, row.verdict, row.verdict_error, *figures])
    (folder / "table.md").write_text(markdown(table), encoding="utf-8")


def read_table(folder: Path) -> Table:
    """The table of a comparison's directory."""
    return msgspec.json.decode((folder / TABLE_FILE).read_bytes(), type=Table)


def markdown(table: Table) -> str:
    """The summary for a README, the best of each column in bold, and below it the meaning of the columns."""
    columns = columns_of(table.figures, "summary")
    head = ["method", *(column.heading for column in columns), "verdict"]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    shown, bar = [column.cells(table.figures) for column in columns], "\\|"
    for place, row in enumerate(table.rows):
        cells = [f"**{cells[place].text}**" if cells[place].is_best else cells[place].text for cells in shown]
        if row.status is not Status.OK:
            cells = [f"{row.status}: {row.reason}".replace("|", bar), *[""] * (len(columns) - 1)]
        lines.append(f"| {row.name.replace('|', bar)} | {' | '.join([*cells, row.vouched])} |")
    notes = [f"- *{column.heading}*: {column.definition}" for column in columns]
    return "\n".join([*lines, "", table.against, "", *notes]) + "\n"


def text(table: Table) -> str:
    """The summary for a terminal, the best of each column starred; then failures with their reasons."""
    columns = columns_of(table.figures, "summary")
    shown = [column.cells(table.figures) for column in columns]
    tried = [place for place, row in enumerate(table.rows) if row.status is not Status.MISSING]
    rows = [table.rows[place] for place in tried]
    names = [row.name if row.status is Status.OK else f"{row.name}: {row.status}" for row in rows]
    marked = [[cells[place].text + (" ", "*")[cells[place].is_best] for place in tried] for cells in shown]
    heads = [[column.head, column.unit] for column in columns]
    lines = lined_up([["method", "", *names], *(head + cells for head, cells in zip(heads, marked, strict=True))])
    best = "* best of its column. " if any(cell.is_best for cells in shown for cell in cells) else ""
    endings = [f"{row.name}: {row.status}: {row.reason}" for row in rows if row.status is not Status.OK]
    if missing := [row for row in table.rows if row.status is Status.MISSING]:
        commands = dict.fromkeys(row.reason.rpartition(": ")[2] for row in missing)  # that install them
        endings += [f"not installed: {', '.join(row.name for row in missing)}; {' and '.join(commands)}"]
    endings += [f"{row.name}: {row.sentence if row.is_doubted else row.vouched}" for row in rows if row.verdict]
    endings += [table.provenance.stopped] if table.provenance.stopped else []
    return "\n".join([*lines, *map(folded, (f"{best}{table.against}", *endings))]) + "\n"


def lined_up(columns: Sequence[Sequence[str]]) -> list[str]:
    """Lines of columns of text, the first flush left, the others flush right."""
    first, *others = columns
    lines = [f"{text:<{max(map(len, first))}}" for text in first]
    for column in others:
        width = max(map(len, column))
        lines = [f"{line}  {text:>{width}}" for line, text in zip(lines, column, strict=True)]
    return [line.rstrip() for line in lines]
