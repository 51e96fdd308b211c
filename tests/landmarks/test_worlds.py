"""Simulated MRCLAM folders: what the estimate makes of them, and of its own errors."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie
from scanchain.errors import InputError
from scanchain.landmarks.association import _filtered, _inverse, _settled, associated, contradicted, visits
from scanchain.landmarks.files import read_mrclam
from scanchain.landmarks.ranges import OWN, WHEELS, solve_range_log
from tests.support.mrclam import World, write_mrclam
from tests.support.nees import nees, truth_at


def solved(tmp_path, world):
    own = write_mrclam(tmp_path / f"world{world.seed}", world)
    log = read_mrclam(tmp_path / f"world{world.seed}", 1)
    return log, solve_range_log(log, None), own[1]


@pytest.mark.parametrize("world", [{}, {"noise": 2.0}, {"landmarks": 8}, {"range_m": 0.05, "depth": 0.0}])
def test_errors_of_poses_and_landmarks_are_as_large_as_their_covariances_say(tmp_path, world):
    found = []
    for seed in range(20, 23):
        log, solution, _ = solved(tmp_path, World(seed, duration_s=300.0, **world))
        landmarks = log.true_landmarks[solution.problem.measurements.landmarks - 6]
        found.append(nees(solution, truth_at(log, solution.nodes_s), landmarks, 0.005))
    ate_m, position, heading, _, landmark, whole = np.mean(found, axis=0)
    assert ate_m < 0.12
    assert (
        position < 3.0 and landmark < 3.0
    )  # one common scale error dominates them, so that they have few degrees
    assert 0.3 < heading < 1.6 and 0.3 < whole < 1.6


def test_the_sensors_systematic_errors_are_found_within_their_deviations(tmp_path):
    _, solution, (_, sensor) = solved(tmp_path, World(31, duration_s=600.0))
    found, sigma = solution.minimum.estimate.state.calibration[WHEELS:], solution.covariance.calibration[WHEELS:]
    true = np.insert(sensor, 1, 1.0)  # the range is a depth
    assert np.all(np.abs(found - true) < 3.5 * sigma), dict(zip(OWN[WHEELS:], (found - true) / sigma, strict=True))
    assert sigma[OWN.index("depth share") - WHEELS] < 0.1  # known from the log, not from its prior of 1


def test_the_scale_of_the_world_is_what_the_priors_tell(tmp_path):
    """Neither noise nor the number of sightings shrinks it, as they would with noise in units of the world."""
    _, solution, _ = solved(tmp_path, World(40, duration_s=300.0, noise=3.0, systematic=0.0))
    found, sigma = solution.minimum.estimate.state.calibration, solution.covariance.calibration
    at = OWN.index("range scale")
    assert abs(found[at]) < 0.005 and 0.018 < sigma[at] < 0.0201
    assert abs(found[0]) < 2.0 * sigma[0] and sigma[0] > 0.018


@pytest.mark.parametrize("world", [{}, {"landmarks": 6}, {"noise": 2.0}, {"wrong": 0.02}])
def test_without_barcodes_the_landmarks_and_their_number_are_found(tmp_path, world):
    write_mrclam(tmp_path / "world", World(51, duration_s=300.0, **world))
    log = read_mrclam(tmp_path / "world", 1)
    part, solution = associated(log, None)
    seen = np.unique(log.subjects, return_counts=True)[1]
    assert np.count_nonzero(seen >= 4) <= len(np.unique(part.subjects)) <= len(seen) + (2 if world else 0)
    codes = dict(zip(map(tuple, log.measured.tolist()), log.subjects.tolist(), strict=True))
    true = np.array([codes[tuple(row)] for row in part.measured.tolist()])
    pure = sum(np.bincount(true[part.subjects == each]).max() for each in np.unique(part.subjects))
    assert pure > (0.93 if "wrong" in world else 0.97) * len(true) and len(true) > 0.95 * len(log.seen_s)
    landmarks = np.full((len(solution.problem.measurements.landmarks), 2), np.nan)
    assert nees(solution, truth_at(log, solution.nodes_s), landmarks, 0.005).ate_m < 0.15


@pytest.mark.parametrize("seed", [5, 12])
def test_a_log_that_the_filter_loses_with_the_priors_is_found_with_better_errors_or_from_its_end(tmp_path, seed):
    write_mrclam(tmp_path / "world", World(seed, duration_s=450.0))
    log = read_mrclam(tmp_path / "world", 1)
    lost, found = _settled(log, None, _filtered(log, None, None)), associated(log, None)
    (_, missed), (_, missed_then) = visits(*lost), visits(*found)
    assert missed.sum() > 20 and missed_then.sum() == 0
    for (_, solution), is_lost in ((lost, True), (found, False)):
        landmarks = np.full((len(solution.problem.measurements.landmarks), 2), np.nan)
        assert (nees(solution, truth_at(log, solution.nodes_s), landmarks, 0.005).ate_m > 0.2) == is_lost


def test_inverse_motions_and_their_jacobians_are_those_of_their_poses():
    motion = np.random.default_rng(0).normal(size=(5, 3))
    inverse, J = _inverse(motion)
    there, back = (np.array([lie.pose_2d(*each) for each in moves]) for moves in (motion, inverse))
    assert np.allclose(there @ back, np.eye(3))
    for column, step in enumerate(1e-6 * np.eye(3)):
        ahead, behind = (_inverse(motion + sign * step)[0] for sign in (1.0, -1.0))
        assert np.allclose(J[:, :, column], (ahead - behind) / 2e-6, atol=1e-8)


@pytest.mark.parametrize("world", [{}, {"landmarks": 6}, {"noise": 2.0}])
def test_a_landmark_is_contradicted_where_it_has_another_number_later_and_only_there(tmp_path, world):
    log, solution, _ = solved(tmp_path, World(51, duration_s=600.0, **world))
    seen, missed = visits(log, solution)
    assert not len(contradicted(log, solution)) and missed.sum() <= 0.05 * seen.sum()
    often = np.argmax(seen)
    own = np.flatnonzero(log.subjects == solution.problem.measurements.landmarks[often])
    twice = log.subjects.copy()
    twice[own[: len(own) // 5]] = 99
    log = replace(log, subjects=twice)
    solution = solve_range_log(log, None)
    assert contradicted(log, solution).tolist() == [99]


def test_a_log_in_which_nothing_is_recognized_again_is_refused_in_one_line(tmp_path):
    write_mrclam(tmp_path / "world", World(52, duration_s=300.0))
    path = tmp_path / "world" / "Robot1_Measurement.dat"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:4]))
    with pytest.raises(InputError, match="fewer than two landmarks are recognized again") as raised:
        associated(read_mrclam(tmp_path / "world", 1), None)
    assert "\n" not in str(raised.value)
