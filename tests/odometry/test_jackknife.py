"""The jackknife over directions: which scans it measures, and that it shows errors that leave no residuals."""

from itertools import chain, repeat

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.evaluation import absolute_error, pair
from scanchain.logs import Log, open_log
from scanchain.odometry import jackknife
from scanchain.runs.results import expected_of
from scanchain.settings import load_settings
from scanchain.slam import Slam
from tests.support import made

pytestmark = pytest.mark.error_bars


def result_of(path, **of_log):
    """Result of a log, its configuration, its expected errors by random and by all errors, and the true ATE."""
    log = open_log([path], **of_log)
    config = load_settings(log.dimension).config
    slam = Slam(config, log.T_base_lidar)
    for scan in log.scans():
        slam.process(scan)
    result = slam.finish()
    quick, full = (expected_of(result, scans).ate for scans in (None, open_log([path], **of_log).scans()))
    true_m = absolute_error(pair(result.trajectory, log.ground_truth())).translation_m.rmse
    return result, config, quick, full, true_m


def test_distorted_scans_widen_the_error_bar_though_they_leave_no_residuals():
    _, _, quick, full, true_m = result_of(made.log("town", sensor="os1-32", seconds=4), point_times="none")
    assert quick.is_random and not full.is_random
    assert quick.high < 0.5 * true_m and full.high > 3.0 * quick.high and full.mean > 2.5 * quick.mean


def test_a_short_log_is_measured_whole_and_each_group_differs(office):
    result, config, _, _, _ = result_of(office)
    keyframes = np.array([each.scan_index for each in result.keyframes])
    odometry = result.odometry.poses
    every = np.arange(len(odometry))
    found = jackknife.influence(open_log([office]).scans(), odometry, keyframes, every, config, None)
    assert found.is_measured.all() and found.of_keyframes.shape == (jackknife.AZIMUTHS[2], len(keyframes) - 1, 3)
    assert (np.linalg.norm(found.of_keyframes, axis=(1, 2)) > 0.0).all()
    assert found.of_scans.shape == (jackknife.AZIMUTHS[2], len(every), 3)
    sizes = np.linalg.norm(found.of_scans, axis=(0, 2))
    assert sizes[keyframes].max() < 1e-12 and np.median(sizes) > 1e-5


@pytest.mark.parametrize("scans", [10, 60, 61, 1000, 20_000])
def test_windows_lie_within_the_log_and_apart(scans):
    path_m = np.concatenate([np.zeros(scans // 2), np.linspace(0.0, 50.0, scans - scans // 2)])  # stands at first
    firsts = jackknife.first_scans(path_m, 3)
    length = min(jackknife.LONGEST[3], scans)
    assert firsts[0] >= 0 and firsts[-1] + length <= scans
    assert (np.diff(firsts) >= length).all()
    groups = jackknife.AZIMUTHS[3] + jackknife.ELEVATIONS[3] + 1
    assert len(firsts) * length * groups <= max(scans, groups * length)


def test_influences_between_windows_are_interpolated_by_the_path():
    motion = lie.exp(np.array([0.5, 0.0, 0.0]))
    poses = np.array([np.linalg.matrix_power(motion, number) for number in range(100)])
    off = np.array([np.linalg.matrix_power(motion @ lie.exp(np.array([0.01, 0.0, 0.0])), k) for k in range(100)])
    windows = [jackknife.Window(first, poses[:20], off[None, :20]) for first in (10, 60)]
    twists, is_measured = jackknife._twists(
        windows, np.arange(0, 97, 3), np.arange(3, 100, 3), 0.5 * np.arange(100.0)
    )
    assert np.flatnonzero(is_measured).tolist() == [4, 5, 6, 7, 8, *range(20, 26)]
    np.testing.assert_allclose(twists, np.broadcast_to([0.03, 0.0, 0.0], twists.shape), atol=1e-9)


def test_a_log_that_cannot_be_read_again_has_error_bars_of_random_errors(office, tmp_path, monkeypatch):
    readings = chain([Log.scans] * 2, repeat(lambda log, preprocess=None: (scan for scan in ())))
    monkeypatch.setattr(Log, "scans", lambda log, preprocess=None: next(readings)(log, preprocess))
    done = scanchain.run(office, tmp_path / "run", recording=False, log__point_times="s")  # which are not tested
    assert done.metrics.expected_ate_m.is_random
    assert any(each.startswith("error bars of random errors only: the scans from 0 on") for each in done.warnings)
