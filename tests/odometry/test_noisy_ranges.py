"""Lidars of noisy ranges: states, verdicts and poses follow the noise that is measured."""

import json

import pytest

import scanchain
from tests.support import made
from tests.support.scenes import shared_data

pytestmark = pytest.mark.error_bars


def metrics_of(path):
    return json.loads((path / "metrics.json").read_text())


@pytest.mark.parametrize(("noise_m", "most_m"), [(0.04, 0.025), (0.08, 0.04)])
def test_a_noisy_lidar_with_dropouts_in_an_office_is_neither_degenerate_nor_contradicted(
    tmp_path, noise_m, most_m
):
    path = made.run("office", tmp_path, seconds=12, noise_m=noise_m, dropout=0.3)
    metrics = metrics_of(path)
    assert metrics["degenerate"] + metrics["contradicted"] <= 0.1 * metrics["scans"]
    assert metrics["verdict"] == "trustworthy" and metrics["ground_truth"]["optimized"]["ate_rmse_m"] < most_m
    assert metrics["range_noise_m"] == pytest.approx(noise_m, rel=0.1)
    assert "lidar noise " in (path / "summary.txt").read_text()


def test_a_real_lidar_of_noisy_ranges_that_stands_still_does_not_move(tmp_path):
    done = scanchain.run(shared_data("reports/rplidar_standing.bag"), tmp_path / "run", recording=False)
    assert done.metrics.verdict == "trustworthy" and "does not move" in done.summary
    assert done.metrics.contradicted < 0.03 * done.metrics.scans
    error_m = float(done.metrics.verdict_error.split()[2])
    assert 0.005 < error_m < 0.08
