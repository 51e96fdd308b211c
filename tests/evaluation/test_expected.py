"""Expected errors against the truth of simulated logs, and as smfeval judges them."""

import io
import re
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import State
from scanchain.evaluation import absolute_error_of_any_path, expected_errors, motion_nees, pair
from scanchain.logs import open_log
from scanchain.settings import Override, load_settings
from scanchain.slam import Slam
from scanchain.trajectory import write_tum, write_wide_tum
from tests.support import made

WITHOUT_WHEELS = (Override("odometry.prior", "constant-velocity", "this test"),)
DRIVES = [
    ("office", "lms-270", 20.0),
    ("identical", "lms-270", 20.0),
    ("town", "vlp-16", 8.0),
    ("hall", "os1-32", 12.0),
]


@cache
def driven(world, sensor, duration_s):
    """Result, steps, truth and expected errors of a simulated drive."""
    log = open_log(made.log(world, sensor=sensor, seconds=duration_s, seed=2))
    config = load_settings(log.dimension, overrides=WITHOUT_WHEELS).config
    slam = Slam(config, log.T_base_lidar)
    steps = [slam.process(scan) for scan in log.scans()]
    result = slam.finish()
    scans = np.diff([*(keyframe.scan_index for keyframe in result.keyframes), len(steps)])
    return result, steps, log.ground_truth(), expected_errors(result.graph, result.map_errors, config, scans)


@pytest.mark.parametrize("drive", DRIVES, ids=lambda drive: drive[0])
def test_the_true_ate_of_a_simulated_drive_lies_within_its_expected_bounds(drive):
    result, _, truth, expected = driven(*drive)
    true_m = absolute_error_of_any_path(pair(result.trajectory, truth)).translation_m.rmse
    assert expected.ate.low <= true_m <= expected.ate.high
    assert true_m / 3.0 < expected.ate.mean < 3.0 * true_m


@pytest.mark.parametrize("drive", DRIVES, ids=lambda drive: drive[0])
def test_motions_between_simulated_scans_err_as_their_covariances_say(drive):
    result, steps, truth, _ = driven(*drive)
    pairs = pair(result.odometry, truth)
    estimate, reference = pairs.estimate, pairs.reference
    if result.odometry.dimension == 2:
        estimate, reference = lie.flatten(lie.lift(estimate)), lie.flatten(lie.lift(reference))
    nees = motion_nees(estimate, np.array([step.match.covariance for step in steps]), reference)
    are_ok = [a.state is b.state is State.OK for a, b in pairwise(steps)]
    assert 0.2 < nees[are_ok][3:].mean() < 3.0


@pytest.mark.parametrize("drive", DRIVES[::2], ids=lambda drive: drive[0])
def test_smfeval_finds_the_covariances_of_keyframes_neither_far_too_tight_nor_far_too_loose(tmp_path, drive):
    smfeval = pytest.importorskip("smfeval.cli.main", reason="smfeval is not installed")
    result, _, truth, expected = driven(*drive)
    estimate, reference, said = tmp_path / "keyframes.tum", tmp_path / "truth.tum", io.StringIO()
    write_wide_tum(estimate, result.keyframe_trajectory, expected.covariances)
    write_tum(reference, truth, force=True)
    frames = ["--est-body-frame", "lidar", "--ref-body-frame", "lidar"]
    with redirect_stdout(said), redirect_stderr(io.StringIO()):
        smfeval.main(["nees", str(estimate), str(reference), *frames])
    (gap,) = re.findall(r"\bk = ([0-9.e+-]+)", said.getvalue())
    assert 0.05 < float(gap) < 6.0


def test_a_wide_tum_file_has_the_pose_and_the_lower_triangle_of_its_covariance(tmp_path):
    result, _, _, expected = driven(*DRIVES[0])
    write_wide_tum(tmp_path / "wide.tum", result.keyframe_trajectory, expected.covariances)
    rows = np.loadtxt(tmp_path / "wide.tum")
    assert rows.shape == (len(result.keyframes), 29)
    covariance = np.zeros((6, 6))
    covariance[np.tril_indices(6)] = rows[5, 8:]
    np.testing.assert_allclose(
        covariance[np.ix_([0, 1, 5], [0, 1, 5])], np.tril(expected.covariances[5]), rtol=1e-5
    )
    assert np.linalg.eigvalsh(expected.covariances[5])[0] > 0.0
