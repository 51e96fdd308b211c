"""What docs/results.md says of its cheap examples holds, loosely: states and verdicts, errors within a factor."""

import re

import pytest

import scanchain
from tests.support import made
from tests.support.scenes import ROOT

TEXT = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
pytestmark = pytest.mark.slow  # minutes of simulated drives; the numbers change rarely
WITHIN = 3.0  # factor between an error that the page says and the one measured


def metrics_of(log, folder, **overrides):
    return scanchain.run(log, folder / "run", recording=False, **overrides).metrics


def errors_m(metrics):
    """ATE before and after optimization."""
    truth = metrics.ground_truth
    return truth.odometry.ate_rmse_m, truth.optimized.ate_rmse_m


def are_near(said, measured):
    return said / WITHIN < measured < said * WITHIN


def numbers_of(pattern):
    """The numbers of the only place of the page that fits a pattern."""
    (found,) = re.findall(pattern, TEXT)
    return [float(number) for number in found]


@pytest.fixture(scope="module")
def office():
    return made.log("office", seconds=120)


def test_loops_hardly_change_an_office_that_odometry_tracks_well(office, tmp_path):
    loops, before_mm, after_mm = numbers_of(
        r"closing (\d+) loops changes the\s+ATE by less than a millimeter \(([\d.]+) to ([\d.]+) mm"
    )
    metrics = metrics_of(office, tmp_path)
    before_m, after_m = errors_m(metrics)
    assert metrics.verdict == "trustworthy"
    assert are_near(loops, metrics.closures_accepted)
    assert abs(before_m - after_m) < 0.001
    assert are_near(before_mm, 1e3 * before_m)
    assert are_near(after_mm, 1e3 * after_m)


@pytest.mark.parametrize(
    ("row", "overrides", "verdict"),
    [
        ("default, `odometry.max_turn_rad_s` 2", {}, "trustworthy"),
        ("turns faster than that are not searched", {"odometry__max_turn_rad_s": 0.1}, "not trustworthy"),
    ],
)
def test_turns_outside_of_the_window_are_contradicted_and_not_lost(row, overrides, verdict, office, tmp_path):
    contradicted, ate_m = numbers_of(rf"{row} \| (\d+) of 120 \| ([\d.]+) m")
    slow = {"log__every": 10, "odometry__prior": "constant-velocity"}
    metrics = metrics_of(office, tmp_path, **slow, **overrides)
    assert metrics.verdict == verdict
    assert metrics.scans == 120
    assert metrics.lost < 0.1 * metrics.scans
    assert abs(metrics.contradicted - contradicted) < 0.2 * metrics.scans
    assert are_near(ate_m, errors_m(metrics)[1])


def test_wheels_hold_the_poses_along_corridors_that_a_short_range_leaves_degenerate(tmp_path):
    log = made.log("identical", seconds=90)  # of the 300 s of the page
    without, with_wheels = (
        metrics_of(log, tmp_path / prior, preprocess__max_range_m=4.0, odometry__prior=prior)
        for prior in ("constant-velocity", "auto")
    )
    assert (without.verdict, with_wheels.verdict) == ("not trustworthy", "check these segments")
    assert "wheels disagree" in without.verdict_reason
    for metrics in (without, with_wheels):
        assert metrics.degenerate > 0.4 * metrics.scans
    assert errors_m(with_wheels)[1] < 0.5 * errors_m(without)[1]
