"""The table of a comparison: made from its results; as JSON, CSV, Markdown, and as text for a terminal."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from scanchain.baselines import BASELINES
from scanchain.comparison.figures import COLUMNS, Figures, columns_of, judged, representative
from scanchain.comparison.methods import Method
from scanchain.comparison.processes import Outcome, Status, StoredScans
from scanchain.comparison.results import Results
from scanchain.data import Points
from scanchain.evaluation import Sharpness, disagreement, sampled_map, sampling_step, sharpness
from scanchain.logs import Log
from scanchain.processes import Limits
from scanchain.runs.provenance import Provenance, package_version
from scanchain.verdict import Judged, Verdict

TABLE_FILE = "table.json"


class Row(Struct, frozen=True):
    """A method: end of its runs, settings, and figures.

    Attributes
    ----------
    status, reason : of the first run that did not end well, else ok
    figures : by key of COLUMNS, None where unknown
    settings : whole, as a TOML file for --config would hold them
    definitions : of its errors, as text
    verdict, verdict_reason : on its trajectory, of other tools by wheels and constant velocity; empty if it failed
    verdict_error : the error that the verdict vouches for
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

    Attributes
    ----------
    log, topic : what was read, for headings
    truth : reference of the errors; empty without ground truth
    truth_note : how many scans have no true pose, or why a truth could not be used; else empty
    disagreement_m : row by row the median distance between two methods' motions; None where one has failed
    notes : what was chosen or assumed, a line each
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
    (folder / TABLE_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(tree), indent=2) + b"\n")
    (folder / "table.csv").write_text(_csv(table), encoding="utf-8")
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
    names = ["method", "", *names]
    lines = [f"{name:<{max(map(len, names))}}" for name in names]
    for column, cells in zip(columns, shown, strict=True):
        cells = [cells[place] for place in tried]
        texts = [column.head, column.unit, *(cell.text + (" ", "*")[cell.is_best] for cell in cells)]
        lines = [f"{line}  {text:>{max(map(len, texts))}}" for line, text in zip(lines, texts, strict=True)]
    verdicts = ["verdict", "", *(row.vouched for row in rows)]
    lines = [f"{line}  {verdict}" for line, verdict in zip(lines, verdicts, strict=True)]
    endings = [f"{row.name}: {row.status}: {row.reason}" for row in rows if row.status is not Status.OK]
    endings += _not_installed(table)
    endings += [f"{row.name}: {row.sentence}" for row in table.rows if row.is_doubted]
    endings += [table.provenance.stopped] if table.provenance.stopped else []
    known = [line.rstrip() for line in lines]
    return "\n".join([*known, f"* best of its column. {table.against}", *endings]) + "\n"


def _not_installed(table: Table) -> Iterator[str]:
    """A line for all methods that are not installed, with the command that installs each."""
    missing = [row for row in table.rows if row.status is Status.MISSING]
    commands = dict.fromkeys(row.reason.rpartition(": ")[2] for row in missing)
    if missing:
        yield f"not installed: {', '.join(row.name for row in missing)}; {' and '.join(commands)}"


def _csv(table: Table) -> str:
    """Every figure in its own unit, plus name, status and verdict."""
    keys = [column.key for column in COLUMNS]
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["method", "status", "verdict", "verdict_error", *keys])
    for row in table.rows:
        writer.writerow(
            [row.name, row.status, row.verdict, row.verdict_error, *(row.figures.get(key) for key in keys)]
        )
    return buffer.getvalue()


def summarize(results: Results, log: Log, limits: Limits, provenance: Provenance) -> Table:
    """Every method's row, with figures that depend on all of them: sharpness and disagreement."""
    scans, maps = results.scans, results.maps
    sharp = dict(zip(maps, sharpness(list(maps.values())), strict=True)) if maps else {}
    chosen = {method.name: representative(results.outcomes[method.name]) for method in results.methods}
    apart_m, judgments = disagreement([each.trajectory.poses for each in chosen.values()]), judged(chosen, scans)
    rows = [
        _row(results, method, sharp.get(method.name), np.delete(apart_m[place], place), judgments.get(method.name))
        for place, method in enumerate(results.methods)
    ]
    packages = sorted({BASELINES[method.base].package for method in results.methods if method.base in BASELINES})
    return Table(
        log=", ".join(str(path) for path in log.paths),
        topic=log.topic,
        dimension=scans.dimension,
        scans=len(scans),
        points_per_scan=float(scans.points.mean()),
        repeats=max(len(runs) for runs in results.outcomes.values()),
        truth=results.reference.source,
        truth_note=results.reference.note,
        rows=rows,
        disagreement_m=[[value if np.isfinite(value) else None for value in row] for row in apart_m.tolist()],
        notes=[
            f"every run may take {limits.time_s:,.0f} s and {limits.memory_mib / 1024.0:.1f} GiB",
            *log.notes,
            *log.damage,
        ],
        provenance=provenance,
        baselines={  # a package may be installed as its variant without CUDA
            name: package_version(name) or package_version(f"{name}-cpu") for name in packages
        },
    )


def _row(
    results: Results, method: Method, sharp: Sharpness | None, apart_m: np.ndarray, judgment: Judged | None
) -> Row:
    outcomes, assessed = results.outcomes[method.name], results.assessed[method.name]
    ended = [outcome.report for outcome in outcomes]
    end = next((report for report in ended if report.status is not Status.OK), ended[0])
    known = apart_m[np.isfinite(apart_m)]
    figures = {column.key: assessed.figures.get(column.key) for column in COLUMNS}
    if sharp is not None:
        figures |= {"thickness_m": sharp.thickness_m, "entropy": sharp.mean_map_entropy}
    if len(known):
        figures["disagreement_m"] = float(np.median(known))
    return Row(
        name=method.name,
        base=method.base,
        status=end.status,
        reason=end.reason,
        description=representative(outcomes).report.description,
        verdict="" if judgment is None else str(judgment.verdict),
        verdict_reason="" if judgment is None else judgment.reason,
        verdict_error="" if judgment is None else judgment.error,
        settings=method.settings,
        figures=figures,
        definitions=list(assessed.definitions),
    )


def maps_of(scans: StoredScans, outcomes: Mapping[str, list[Outcome]]) -> dict[str, Points]:
    """Sampled maps (M, d) of the methods that came to their end."""
    step = sampling_step(int(scans.points.sum()))
    chosen = {name: representative(runs) for name, runs in outcomes.items()}
    return {
        name: sampled_map(scans.scans(), outcome.trajectory, step)
        for name, outcome in chosen.items()
        if outcome.is_whole
    }
