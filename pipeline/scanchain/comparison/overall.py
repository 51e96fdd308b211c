"""Comparisons of the same methods on several logs, taken together: medians, wins, ranks."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import msgspec
import numpy as np
from msgspec import Struct
from scipy.stats import bootstrap, friedmanchisquare, rankdata, studentized_range

from scanchain.comparison.methods import OURS
from scanchain.comparison.processes import Status
from scanchain.comparison.table import COLUMNS, Column, Row, Table, lined_up
from scanchain.data import Matrix, Vector
from scanchain.errors import counted, folded
from scanchain.files import write_json, write_whole
from scanchain.verdict import Verdict

OVERALL_FILE = "overall.json"
_SHOWN = ("ate_m", "ate_share", "kitti_share", "rpe_1_s_m", "apart_m", "median_s", "cpu_s", "peak_mib")
FIGURES = tuple(column for column in COLUMNS if column.key in _SHOWN)
_MEANING = "Medians over the logs on which a method finished, with bootstrap intervals of 95 % from three logs on."
_LEVEL = 0.95  # of the intervals, and of the critical difference
_FEWEST = 3  # logs that an interval needs
_WORSE = 2.0  # distance to the truth over that of the methods from each other, from which the truth is doubted


class Median(Struct, frozen=True):
    """Median over ``logs`` logs, with a bootstrap interval of 95 %; without one where there are fewer than 3."""

    value: float
    low: float | None
    high: float | None
    logs: int


class Standing(Struct, frozen=True):
    """A method over all logs.

    figures : by key of ``FIGURES``, over the logs on which it finished
    finished, failed, absent : numbers of logs; absent where it does not apply or is not installed
    verdicts : number of logs by verdict
    rank : mean rank by ATE; None for a method that did not take part in every log with ground truth
    """

    name: str
    figures: dict[str, Median]
    finished: int
    failed: int
    absent: int
    verdicts: dict[str, int]
    rank: float | None

    @property
    def share(self) -> str:
        """Logs on which it finished, of those in which it took part."""
        return f"{self.finished}/{self.finished + self.failed}"

    @property
    def shown_rank(self) -> str:
        """The rank as text."""
        return "–" if self.rank is None else f"{self.rank:.2f}"

    def shown(self, column: Column) -> tuple[str, str]:
        """Median and interval as text, – where there is none."""
        if (median := self.figures.get(column.key)) is None:
            return "–", ""
        digits = column.digits_of([column.scale * median.value])
        low, high = median.low, median.high
        value, *ends = (
            f"{column.scale * each:.{digits}f}" for each in (median.value, low, high) if each is not None
        )
        return value, f"({' to '.join(ends)})" if ends else ""


@dataclass(frozen=True, slots=True)
class ComparedLog:
    """A log: its name, the folder of its comparison, and its table, or the reason why there is none."""

    name: str
    folder: str
    table: Table | None
    reason: str = ""

    @property
    def warning(self) -> str:
        """Why the ground truth may be worse than the methods; empty where nothing says so."""
        rows = [row for row in self.table.rows if row.status is Status.OK] if self.table is not None else []
        ours = [row for row in rows if row.base in OURS]  # which resemble each other: one counts
        both = [(row.figures["ate_m"], row.figures["apart_m"]) for row in rows if row not in ours[1:]]
        known = np.array([pair for pair in both if None not in pair])
        if len(known) < _FEWEST:
            return ""
        ate_m, apart_m = float(known[:, 0].min()), float(np.median(known[:, 1]))
        if ate_m < _WORSE * apart_m:
            return ""
        return (
            f"{self.name}: all methods are {ate_m:.2g} m and more from the ground truth, but {apart_m:.2g} m from "
            "each other (median), so it may be worse than they are"
        )


@dataclass(frozen=True, slots=True)
class Overall:
    """Comparisons on several logs.

    wins : by method and other method the share of logs, of those with truth in which both took part, in which it
        has the smaller ATE; ties are a half, a failure loses against what finished; None without such a log
    ranked_logs : number of logs with ground truth
    critical_difference : of mean ranks: two that are equally good differ by less with 95 % probability (Nemenyi,
        as in Demšar 2006, https://jmlr.org/papers/v7/demsar06a.html); None for fewer than two methods or logs
    friedman_p : probability of ranks that differ as much if all methods are equal; None for fewer than three
    """

    logs: Sequence[ComparedLog]
    standings: Sequence[Standing]
    wins: Sequence[Sequence[float | None]]
    ranked_logs: int
    critical_difference: float | None
    friedman_p: float | None

    @property
    def ranking(self) -> str:
        """Ranks and their significance in a sentence; empty without ranks."""
        if self.critical_difference is None:
            return ""
        ranked = sorted((each.rank, each.name) for each in self.standings if each.rank is not None)
        order = ", ".join(f"{name} {rank:.2f}" for rank, name in ranked)
        p = "" if self.friedman_p is None else f"; Friedman test p = {self.friedman_p:.2g}"
        left_out = [each.name for each in self.standings if each.rank is None]
        others = f"; without {', '.join(left_out)}, which did not take part in all" if left_out else ""
        return (
            f"Mean ranks by ATE over {counted(self.ranked_logs, 'log')} with ground truth: {order}; ranks less "
            f"than {self.critical_difference:.2f} apart do not differ significantly{p}{others}."
        )

    @property
    def notes(self) -> list[str]:
        """Meaning of the figures, ranks, warnings and failures, one per line."""
        return [*filter(None, (_MEANING, self.ranking, *(log.warning for log in self.logs))), *self.failures]

    @property
    def failures(self) -> list[str]:
        """Logs without a comparison, and methods that did not finish, with the logs."""
        lines = [f"{log.name}: {log.reason}" for log in self.logs if log.table is None]
        return lines + [
            f"{log.name}: {row.name} {row.status}: {row.reason}"
            for log in self.logs
            for row in (log.table.rows if log.table is not None else ())
            if row.status.is_failure
        ]


def overall_of(logs: Sequence[ComparedLog]) -> Overall:
    """Statistics over the logs that have a table."""
    tables = [log.table for log in logs if log.table is not None]
    names = list(dict.fromkeys(row.name for table in tables for row in table.rows))
    rows = [[next((row for row in table.rows if row.name == name), None) for table in tables] for name in names]
    errors_m = np.array([[_error_m(row) for row in each] for each in rows]).reshape(len(names), len(tables))
    errors_m = errors_m[:, np.isfinite(errors_m).any(axis=0)]
    is_ranked = ~np.isnan(errors_m).any(axis=1)
    ranks, critical, p = _ranked(errors_m[is_ranked])
    by_name = dict(zip(np.array(names)[is_ranked].tolist(), ranks, strict=True)) if ranks else {}
    return Overall(
        logs=logs,
        standings=[_standing(name, each, by_name.get(name)) for name, each in zip(names, rows, strict=True)],
        wins=[
            [None if theirs is ours else _wins(errors_m[ours], errors_m[theirs]) for theirs in range(len(names))]
            for ours in range(len(names))
        ],
        ranked_logs=errors_m.shape[1],
        critical_difference=critical,
        friedman_p=p,
    )


def _error_m(row: Row | None) -> float:
    """ATE, infinite for a failure, NaN where it did not take part or there is no truth."""
    if row is None or not row.status.took_part:
        return math.nan
    ate_m = row.figures.get("ate_m")
    return math.inf if row.status.is_failure else math.nan if ate_m is None else ate_m


def _standing(name: str, rows: Sequence[Row | None], rank: float | None) -> Standing:
    done = [row for row in rows if row is not None and row.status is Status.OK]
    failed = sum(row is not None and row.status.is_failure for row in rows)
    values = {column.key: [row.figures.get(column.key) for row in done] for column in FIGURES}
    medians = {key: _median([value for value in each if value is not None]) for key, each in values.items()}
    return Standing(
        name=name,
        figures={key: median for key, median in medians.items() if median is not None},
        finished=len(done),
        failed=failed,
        absent=len(rows) - len(done) - failed,
        verdicts={verdict: sum(row.verdict == verdict for row in done) for verdict in Verdict},
        rank=rank,
    )


def _median(values: Sequence[float]) -> Median | None:
    if not values:
        return None
    if len(values) < _FEWEST:
        return Median(float(np.median(values)), None, None, len(values))
    found = bootstrap((values,), np.median, confidence_level=_LEVEL, method="percentile", rng=0)
    low, high = (float(each) for each in found.confidence_interval)
    return Median(float(np.median(values)), low, high, len(values))


def _wins(ours_m: Vector, theirs_m: Vector) -> float | None:
    """Share of logs in which the first of two rows of errors (L,) is smaller."""
    both = ~(np.isnan(ours_m) | np.isnan(theirs_m))
    ours, theirs = ours_m[both], theirs_m[both]
    return float(np.mean((ours < theirs) + 0.5 * (ours == theirs))) if both.any() else None


def _ranked(errors_m: Matrix) -> tuple[list[float], float | None, float | None]:
    """Mean ranks of errors (K, L), their critical difference, and p of the Friedman test."""
    count, logs = errors_m.shape
    if count < 2 or logs < 2:
        return [], None, None
    ranks = rankdata(errors_m, axis=0)
    quantile = studentized_range.ppf(_LEVEL, count, math.inf) / math.sqrt(2.0)
    p = float(friedmanchisquare(*errors_m).pvalue) if count > 2 and np.ptp(ranks) else None
    return ranks.mean(axis=1).tolist(), float(quantile * math.sqrt(count * (count + 1) / (6.0 * logs))), p


def write_overall(folder: Path, overall: Overall) -> None:
    """overall.json, overall.csv, overall.md."""
    logs = [
        {"name": each.name, "folder": each.folder, "reason": each.reason, "warning": each.warning}
        for each in overall.logs
    ]
    tree = {
        "logs": logs,
        "methods": overall.standings,
        "wins": overall.wins,
        "ranked_logs": overall.ranked_logs,
        "critical_difference": overall.critical_difference,
        "friedman_p": overall.friedman_p,
        "columns": FIGURES,
    }
    write_json(folder / OVERALL_FILE, tree)
    with (folder / "overall.csv").open("w", encoding="utf-8") as file:  # every figure in its own unit
        writer = csv.writer(file, lineterminator="\n")
        keys = [f"{column.key}{part}" for column in FIGURES for part in ("", "_low", "_high", "_logs")]
        writer.writerow(["method", "finished", "failed", "absent", "rank", *keys])
        for each in overall.standings:
            medians = [each.figures.get(column.key) for column in FIGURES]
            cells = [
                cell for median in medians for cell in (msgspec.structs.astuple(median) if median else [None] * 4)
            ]
            writer.writerow([each.name, each.finished, each.failed, each.absent, each.rank, *cells])
    head = ["method", "logs", *(column.heading for column in FIGURES), "rank"]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for each in overall.standings:
        cells = [" ".join(filter(None, each.shown(column))) for column in FIGURES]
        name = each.name.replace("|", "\\|")
        lines.append(f"| {' | '.join([name, each.share, *cells, each.shown_rank])} |")
    write_whole(folder / "overall.md", ("\n".join([*lines, "", *overall.notes]) + "\n").encode())


def overall_text(overall: Overall) -> str:
    """Medians for a terminal, then ranks, warnings and failures."""
    standings = overall.standings
    columns = [
        ["method", "", *(each.name for each in standings)],
        ["logs", "", *(each.share for each in standings)],
    ]
    columns += [
        [column.head, column.unit, *(each.shown(column)[0] for each in standings)]
        for column in FIGURES
        if any(column.key in each.figures for each in standings)
    ]
    columns.append(["rank", "", *(each.shown_rank for each in standings)])
    return "\n".join([*lined_up(columns), *map(folded, overall.notes)]) + "\n"


def variation_folder(key: str, value: str) -> str:
    """Folder of the comparison with another value of a setting, within that of the comparison."""
    return f"vary/{quote(key, safe='')}={quote(value, safe='')}"


def sensitivity(varied: Mapping[str, Overall]) -> tuple[Column, list[str], Matrix]:
    """Median accuracy by value of a setting (rows) and method (columns), NaN where it failed on a log.

    The column is the ATE, over the path where all paths are long enough.
    """
    names = list(dict.fromkeys(each.name for overall in varied.values() for each in overall.standings))
    by_value = [
        {each.name: each.figures for each in overall.standings if not each.failed} for overall in varied.values()
    ]
    ate, share = FIGURES[:2]
    known = [figures for of_methods in by_value for figures in of_methods.values() if ate.key in figures]
    column = share if all(share.key in figures for figures in known) else ate
    medians = [[of_methods.get(name, {}).get(column.key) for name in names] for of_methods in by_value]
    values = [[math.nan if each is None else column.scale * each.value for each in row] for row in medians]
    return column, names, np.array(values).reshape(len(varied), len(names))


def sensitivity_text(key: str, varied: Mapping[str, Overall]) -> str:
    """Accuracy by value of a setting for a terminal."""
    column, names, values = sensitivity(varied)
    digits = column.digits_of(values[np.isfinite(values)].tolist())
    columns = [[key, column.unit, *varied]]
    for name, each in zip(names, values.T, strict=True):
        columns.append([name, column.head, *("–" if math.isnan(x) else f"{x:.{digits}f}" for x in each)])
    return "\n".join(lined_up(columns)) + "\n"
