"""Statistics over several comparisons, checked against figures that are known or computed by hand."""

import csv
import json
import math

import numpy as np
import pytest

from scanchain.comparison.overall import (
    ComparedLog,
    overall_of,
    overall_text,
    sensitivity,
    variation_folder,
    write_overall,
)
from scanchain.comparison.processes import Status
from scanchain.comparison.table import COLUMNS, Row, Table
from scanchain.runs.provenance import describe_start

ABSENT, FAILED = "absent", "failed"


def row(name, ate_m, apart_m=None, seconds=0.01):
    """A row of a table: finished with an ATE or without truth (None), failed, or not installed."""
    status = {ABSENT: Status.MISSING, FAILED: Status.CRASHED}.get(ate_m, Status.OK)
    figures = dict.fromkeys(column.key for column in COLUMNS)
    if status is Status.OK:
        figures |= {"ate_m": ate_m, "apart_m": apart_m, "median_s": seconds}
    verdict = "trustworthy" if status is Status.OK else ""
    return Row(name, name, status, "" if status is Status.OK else "it broke", "", {}, figures, [], verdict)


def log(name, *rows):
    table = Table(name, "/points", 3, 50, 1e5, 1, "", "", list(rows), [], [], describe_start([]), {})
    return ComparedLog(name, f"{name}-1234", table)


def logs_of(errors):
    """Logs in which methods a, b, … have these errors, a row of ``errors`` each."""
    columns = zip(*errors, strict=True)
    return [log(f"log{k}", *(row("abcde"[m], e) for m, e in enumerate(each))) for k, each in enumerate(columns)]


def standing(overall, name):
    (found,) = (each for each in overall.standings if each.name == name)
    return found


def test_a_median_is_over_the_logs_on_which_a_method_finished_and_its_interval_holds_it():
    overall = overall_of(logs_of([[0.1, 0.4, 0.2, 0.3, 0.5], [1.0, FAILED, 3.0, ABSENT, 2.0]]))
    a, b = (standing(overall, name).figures["ate_m"] for name in "ab")
    assert (a.value, a.logs, b.value, b.logs) == (0.3, 5, 2.0, 3)
    assert 0.1 <= a.low <= 0.3 <= a.high <= 0.5 and a.low < a.high
    b = standing(overall, "b")
    assert (b.finished, b.failed, b.absent, b.share) == (3, 1, 1, "3/4")
    assert b.verdicts["trustworthy"] == 3


def test_the_interval_of_a_median_holds_the_true_one_about_as_often_as_it_says():
    """Of 15 logs drawn from a distribution of median 1; the bootstrap of a median is known to be rather wide."""
    held, draw = 0, np.random.default_rng(0)
    for _ in range(60):
        errors = draw.lognormal(0.0, 0.5, 15).tolist()
        median = standing(overall_of(logs_of([errors])), "a").figures["ate_m"]
        held += median.low <= 1.0 <= median.high
    assert held >= 52


def test_two_logs_have_no_interval():
    median = standing(overall_of(logs_of([[1.0, 3.0]])), "a").figures["ate_m"]
    assert (median.value, median.low, median.high) == (2.0, None, None)


def test_wins_are_of_the_logs_in_which_both_took_part_ties_count_half_and_failures_lose():
    overall = overall_of(
        logs_of(
            [[1.0, 1.0, 1.0, 1.0], [2.0, 1.0, 0.5, FAILED], [ABSENT, 2.0, ABSENT, 2.0], [5.0, FAILED, 5.0, 5.0]]
        )
    )
    assert overall.wins[0][1] == 2.5 / 4 and overall.wins[1][0] == 1.5 / 4
    assert overall.wins[0][2] == 1.0 and overall.wins[2][1] == 0.5
    assert overall.wins[0][0] is None
    assert standing(overall, "c").rank is None  # not in every log
    assert standing(overall, "d").rank == pytest.approx((3 + 3 + 3 + 2) / 4)


@pytest.mark.parametrize(("methods", "quantile"), [(2, 1.960), (3, 2.343), (4, 2.569), (5, 2.728)])
def test_ranks_and_their_critical_difference_are_those_of_the_literature(methods, quantile):
    """The quantiles are those of table 5 of Demšar 2006; the ranks are counted, ties sharing theirs."""
    logs, draw = 14, np.random.default_rng(methods)
    errors = draw.integers(1, 6, (methods, logs)) / 10.0
    overall = overall_of(logs_of(errors.tolist()))
    for name, own in zip("abcde", errors, strict=False):
        counted = [
            1 + sum(each < mine for each in others) + 0.5 * (sum(each == mine for each in others) - 1)
            for mine, others in zip(own, errors.T, strict=True)
        ]
        assert standing(overall, name).rank == pytest.approx(np.mean(counted))
    expected = quantile * math.sqrt(methods * (methods + 1) / (6 * logs))
    assert overall.critical_difference == pytest.approx(expected, rel=1e-3)
    assert f"{expected:.2f} apart" in overall.ranking


def test_the_friedman_test_tells_a_method_that_is_always_better():
    draw = np.random.default_rng(0)
    alike = draw.uniform(1.0, 2.0, (3, 12))
    apart = alike + np.array([[0.0], [2.0], [4.0]])
    assert overall_of(logs_of(alike.tolist())).friedman_p > 0.05
    assert overall_of(logs_of(apart.tolist())).friedman_p < 1e-4
    assert overall_of(logs_of([[0.1, 0.2]] * 3)).friedman_p is None  # all tie


def test_the_sensitivity_is_that_of_methods_that_never_failed():
    """One that fails on the hard logs would else look better there."""
    varied = {
        "1": overall_of(logs_of([[0.1, 0.2, 5.0, 6.0]])),
        "2": overall_of(logs_of([[0.1, 0.2, FAILED, FAILED]])),
    }
    _, names, values = sensitivity(varied)
    assert names == ["a"] and values[0, 0] == 2.6 and np.isnan(values[1, 0])
    assert variation_folder("log.topic", "/../../x") == "vary/log.topic=%2F..%2F..%2Fx"


def test_logs_without_truth_have_no_part_in_ranks_and_wins():
    overall = overall_of(
        [*logs_of([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]]), log("bare", row("a", None), row("b", FAILED))]
    )
    assert overall.ranked_logs == 3 and overall.wins[1][0] == 0.0
    assert [standing(overall, name).rank for name in "ab"] == [1.0, 2.0]
    assert overall.friedman_p is None  # which needs three methods


def test_a_truth_that_is_worse_than_the_methods_is_doubted():
    worse = log(
        "gps", *(row(name, ate, apart) for name, ate, apart in (("a", 0.4, 0.1), ("b", 0.5, 0.2), ("c", 0.3, 0.1)))
    )
    better = log(
        "rtk", *(row(name, ate, apart) for name, ate, apart in (("a", 0.1, 0.1), ("b", 0.2, 0.2), ("c", 0.1, 0.1)))
    )
    assert worse.warning == (
        "gps: all methods are 0.3 m and more from the ground truth, but 0.1 m from each other (median), so it may "
        "be worse than they are"
    )
    one_is_right = (("a", 0.01, 1.0), ("b", 1.0, 0.1), ("c", 1.05, 0.1), ("d", 0.98, 0.1))
    assert not log("gps", *(row(*each) for each in one_is_right)).warning
    alike = [row(name, 0.4, 0.001) for name in ("plicp", "svd", "plicp+loops")]  # no three independent methods
    assert not log("gps", *alike).warning and log("gps", *alike, row("a", 0.5, 0.1), row("b", 0.4, 0.1)).warning
    assert not better.warning and not log("bare", row("a", None), row("b", None), row("c", None)).warning
    assert worse.warning in overall_of([worse, better]).notes


def test_the_tables_have_a_row_for_each_method_and_name_what_failed(tmp_path):
    bad = ComparedLog("gone.mcap", "gone-1", None, "gone.mcap: no such file")
    overall = overall_of([*logs_of([[0.1, 0.2, 0.3], [0.2, FAILED, 0.1]]), bad])
    write_overall(tmp_path, overall)
    rows = list(csv.DictReader((tmp_path / "overall.csv").open()))
    assert [(each["method"], each["finished"], each["failed"]) for each in rows] == [
        ("a", "3", "0"),
        ("b", "2", "1"),
    ]
    assert float(rows[0]["ate_m"]) == 0.2 and rows[1]["ate_m_low"] == ""
    tree = json.loads((tmp_path / "overall.json").read_text())
    assert [each["name"] for each in tree["logs"]] == ["log0", "log1", "log2", "gone.mcap"]
    assert tree["methods"][0]["figures"]["ate_m"]["value"] == 0.2
    lines = (tmp_path / "overall.md").read_text().splitlines()
    assert lines[0].startswith("| method | logs | ATE [m] |") and lines[2].startswith(
        "| a | 3/3 | 0.200 (0.100 to 0.300) |"
    )
    said = overall_text(overall)
    assert "gone.mcap: gone.mcap: no such file" in said and "log1: b crashed: it broke" in said
