"""report.html of a comparison on several logs: medians, ranks, accuracy against time, wins, and each log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import starmap
from pathlib import Path
from urllib.parse import quote

import numpy as np

from scanchain.comparison.overall import FIGURES, ComparedLog, Overall, Standing, sensitivity, variation_folder
from scanchain.comparison.processes import Status
from scanchain.comparison.table import Column
from scanchain.errors import counted
from scanchain_viz.colors import color_of
from scanchain_viz.pictures.figure import INK, THIN, Floats, Plot
from scanchain_viz.report import page
from scanchain_viz.report.page import Cell, Chip, Drawing, Grid, Head, Row, Section

_ACCURACY, _TIME = "ate_share", "median_s"  # of the picture
_BY_LOG = {
    "ate_m": "ATE",
    "kitti_share": "Drift by the KITTI metric",
    "apart_m": "Distance from the other methods",
    "median_s": "Time of a scan",
}
_MARK = 7.0  # points


def write_overall_report(
    directory: Path, overall: Overall, varied: Mapping[str, Mapping[str, Overall]] | None = None
) -> None:
    """Draw and write the page; ``varied`` are the statistics by key and value of a setting."""
    done = [log for log in overall.logs if log.table is not None]
    scans = sum(log.table.scans for log in done if log.table is not None)
    whole = page.Page(
        title=f"Comparison on {counted(len(overall.logs), 'log')}",
        subtitle="The same decoded scans of each log through every method, each in its own process.",
        facts=(
            ("logs", f"{len(done)} of {len(overall.logs)} compared, {overall.ranked_logs} with ground truth"),
            ("scans", f"{scans:,}"),
            ("methods", f"{len(overall.standings)}"),
        ),
        warnings=[*overall.failures, *filter(None, (log.warning for log in overall.logs))],
        sections=[*_sections(overall), *starmap(_sensitivity, (varied or {}).items())],
        links=[(name, name) for name in ("overall.csv", "overall.md", "overall.json")],
        is_sortable=True,
    )
    page.write_page(directory, whole)


def _sections(overall: Overall) -> Iterator[Section]:
    chips = [Chip(each.name, color_of(place)) for place, each in enumerate(overall.standings)]
    yield Section("Logs", "A name links to its comparison.", grid=_logs(overall))
    if not overall.standings:
        return
    shown = [column for column in FIGURES if any(column.key in each.figures for each in overall.standings)]
    text = "Of the logs on which a method finished."
    yield Section("Medians", text, grid=_medians(overall, shown, chips))
    if any(median.low is not None for each in overall.standings for median in each.figures.values()):
        text = "Bootstrap intervals of 95 % of these medians: how far they would vary with other such logs."
        heads = [Head("method"), *(Head(each.head, each.unit) for each in shown)]
        rows = [
            Row(each.name, [each.shown(column)[1].strip("()") or "–" for column in shown], chip)
            for each, chip in zip(overall.standings, chips, strict=True)
        ]
        yield Section("Intervals", text, grid=Grid(heads, rows))
    yield from _pictures(overall, chips)
    if overall.ranked_logs > 1:
        heads = [Head("share of logs"), *(Head(each.name) for each in overall.standings)]
        rows = [
            Row(each.name, [page.figure(share, 100.0, 0) for share in shares], chip)
            for each, shares, chip in zip(overall.standings, overall.wins, chips, strict=True)
        ]
        text = (
            "Percent of the logs in which the method of the row has a smaller ATE than that of the column, of "
            "those in which both took part. A method that does not finish loses."
        )
        yield Section("Wins", text, grid=Grid(heads, rows))
    for column in FIGURES:
        if column.key in _BY_LOG and any(column.key in each.figures for each in overall.standings):
            text = f"{column.definition[0].upper()}{column.definition[1:]}."
            yield Section(f"{_BY_LOG[column.key]} by log [{column.unit}]", text, grid=_by_log(overall, column))


def _sensitivity(key: str, varied: Mapping[str, Overall]) -> Section:
    """Accuracy over the values of a setting, as picture and table."""
    column, names, accuracy = sensitivity(varied)
    chips = [Chip(name, color_of(place)) for place, name in enumerate(names)]
    try:
        places = np.array(list(varied), np.float64)
    except ValueError:
        places = np.arange(1.0, len(varied) + 1.0)
    scale = "xy" if (places > 0.0).all() else "y"
    figure = Plot(key, f"median {column.heading}", logarithmic=scale, is_wide=True)
    for chip, values in zip(chips, accuracy.T, strict=True):
        points = np.stack([places, values], axis=1)[np.argsort(places)]
        figure.line(points, chip.color)
        figure.marks(points, "o", chip.color, _MARK)
    digits = column.digits_of(accuracy[np.isfinite(accuracy)].tolist())
    rows = [
        Row(
            value,
            [page.figure(each, 1.0, digits) for each in row],
            link=quote(f"{variation_folder(key, value)}/{page.REPORT_FILE}"),
        )
        for value, row in zip(varied, accuracy.tolist(), strict=True)
    ]
    text = f"{column.heading} at each value, all else as above; medians over the logs. A value links to its page."
    drawing = Drawing.of("Accuracy", "A gap where a method failed on a log.", figure)
    return Section(f"Sensitivity to {key}", text, chips, [drawing], Grid([Head(key), *map(Head, names)], rows))


def _logs(overall: Overall) -> Grid:
    rows = []
    for log in overall.logs:
        link = quote(f"{log.folder}/{page.REPORT_FILE}") if log.table is not None else ""
        rows.append(Row(log.name, _facts(log), link=link))
    heads = [Head("log"), Head("scans"), Head("points"), Head("finished"), Head("ground truth", is_text=True)]
    return Grid(heads, rows)


def _facts(log: ComparedLog) -> list[Cell | str]:
    if (table := log.table) is None:
        return [Cell(log.reason, "wide")]
    tried = [row.status is Status.OK for row in table.rows if row.status.took_part]
    finished = page.bad_if(not all(tried), f"{sum(tried)}/{len(tried)}")
    return [f"{table.scans:,}", f"{table.points_per_scan:,.0f}", finished, table.truth or "none"]


def _medians(overall: Overall, shown: list[Column], chips: list[Chip]) -> Grid:
    heads = [Head("method"), Head("logs", "", "on which it finished, of those in which it took part")]
    heads += [Head(each.head, each.unit, each.definition) for each in shown]
    heads += [
        Head("rank", "", "mean rank by ATE"),
        Head("verdicts", "", "number of logs by verdict", is_text=True),
    ]
    columns = []
    for column in shown:
        medians = [each.figures.get(column.key) for each in overall.standings]
        columns.append(column.cells([{column.key: median.value if median else None} for median in medians]))
    rows = []
    for place, (each, chip) in enumerate(zip(overall.standings, chips, strict=True)):
        cells = [Cell(cells[place].text, "best" if cells[place].is_best else "") for cells in columns]
        verdicts = ", ".join(f"{count} {verdict}" for verdict, count in each.verdicts.items() if count)
        share = page.bad_if(each.failed > 0, each.share)
        rows.append(Row(each.name, [share, *cells, each.shown_rank, verdicts], chip))
    return Grid(heads, rows, [f"{each.heading}: {each.definition}" for each in shown])


def _by_log(overall: Overall, column: Column) -> Grid:
    """A row for each log with a table, the best of each row marked."""
    heads = [Head("log"), *(Head(each.name) for each in overall.standings)]
    rows = []
    for log in overall.logs:
        if log.table is None:
            continue
        found = {row.name: row for row in log.table.rows}
        figures = [found[each.name].figures if each.name in found else {} for each in overall.standings]
        cells = [
            Cell(shown.text, "best" if shown.is_best else "")
            if each.name not in found or not found[each.name].status.is_failure
            else Cell("failed", "bad")
            for each, shown in zip(overall.standings, column.cells(figures), strict=True)
        ]
        rows.append(Row(log.name, cells))
    return Grid(heads, rows)


def _pictures(overall: Overall, chips: list[Chip]) -> Iterator[Section]:
    drawings = []
    known = [
        (each, chip, each.figures[_TIME].value, each.figures[_ACCURACY].value)
        for each, chip in zip(overall.standings, chips, strict=True)
        if _TIME in each.figures and _ACCURACY in each.figures and not each.failed
    ]
    if known:
        figure = Plot("median time of a scan [ms]", "median ATE / path [%]", logarithmic="xy")
        points = np.array([(1e3 * time_s, 100.0 * share) for _, _, time_s, share in known])
        fastest = points[np.lexsort((points[:, 1], points[:, 0]))]
        best = fastest[fastest[:, 1] <= np.minimum.accumulate(fastest[:, 1])]
        figure.line(_stairs(best, points.max(axis=0)), INK, THIN)
        for (_, chip, *_), point in zip(known, points, strict=True):
            figure.marks(point[None], "o", chip.color, _MARK)
        caption = (
            "Left and below is better. No method is both faster and more accurate than those on the line. Without "
            "those that failed on a log."
        )
        drawings.append(Drawing.of("Accuracy against time", caption, figure))
    if overall.critical_difference is not None:
        drawings.append(_ranks(overall.standings, overall.critical_difference, chips))
    if drawings:
        yield Section("Accuracy, time and ranks", overall.ranking, chips, drawings)


def _stairs(best: Floats, ends: Floats) -> Floats:
    """The border of what points (N, 2), x rising and y falling, dominate, as far as ``ends`` (2,)."""
    corners = np.stack([np.append(best[:, 0], ends[0]), np.append(ends[1], best[:, 1])], axis=1)
    return np.insert(corners, np.arange(1, len(corners)), best, axis=0)


def _ranks(standings: Sequence[Standing], critical: float, chips: list[Chip]) -> Drawing:
    ranked = sorted(
        (each.rank, chip.color) for each, chip in zip(standings, chips, strict=True) if each.rank is not None
    )
    figure = Plot("mean rank by ATE", "place", height_inches=0.9 + 0.2 * len(ranked))
    figure.y.limit(len(ranked) + 0.5, 0.5)
    for place, (rank, color) in enumerate(ranked, start=1):
        ends = np.array([[rank - 0.5 * critical, place], [rank + 0.5 * critical, place]])
        figure.line(ends, color, 2.0)
        figure.marks(np.array([[rank, place]]), "o", color, _MARK)
    caption = "Left is better. Two methods differ significantly (Nemenyi test, 95 %) if their bars do not overlap."
    return Drawing.of("Critical difference", caption, figure)
