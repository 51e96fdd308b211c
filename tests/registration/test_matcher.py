"""What every matcher does that the configuration names."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig, MatchingConfig
from scanchain.data import Match, Prior
from scanchain.registration import VoxelMap, create_matcher
from scanchain.registration.matcher import CheckedMatcher
from tests.support.matching import dented_corridor, off, scan_at, set_up, truth


@pytest.mark.parametrize("matcher_name", ["plicp", "svd"])
def test_meters_or_centimeters_same_motion(dimension, matcher_name):
    answers = []
    for unit in (1.0, 100.0):
        matcher, target = set_up(dimension, unit, matcher=matcher_name)
        match = matcher.align(scan_at(truth(dimension, unit), unit), target, lie.identity(dimension))
        T = match.T_target_source.copy()
        T[:-1, -1] /= unit
        answers.append((T, match.iterations, match.inliers, match.degeneracy_eigenvalue))
    np.testing.assert_allclose(answers[0][0], answers[1][0], atol=1e-7)
    assert answers[0][1:3] == answers[1][1:3]
    assert answers[0][3] == pytest.approx(answers[1][3], rel=1e-6)


@pytest.mark.parametrize("matcher_name", ["plicp", "svd"])
def test_both_matchers_find_the_motion_from_a_guess_half_a_meter_off(dimension, matcher_name):
    T = truth(dimension)
    T[0, -1] += 0.4
    matcher, target = set_up(dimension, matcher=matcher_name)
    match = matcher.align(scan_at(T), target, lie.identity(dimension), wide=True)
    assert match.converged
    assert off(match.T_target_source, T) < 3e-3


@pytest.mark.parametrize("matcher_name", ["plicp", "svd"])
def test_the_information_predicts_the_spread_of_repeated_matches(dimension, matcher_name):
    """Independent noise on the scan only: the mean squared Mahalanobis distance is about k, in space below it.

    There a pair counts less than its noise would allow, for the errors of real maps, which pairs share.
    """
    T = truth(dimension)
    matcher, target = set_up(dimension, kernel_scale_m=1.0, sensor_noise_m=0.05, matcher=matcher_name)
    clean = scan_at(T)
    rng = np.random.default_rng(3)
    matches = [matcher.align(clean + 0.05 * rng.normal(size=clean.shape), target, T) for _ in range(60)]
    mean = np.mean([lie.log(lie.inverse(T) @ match.T_target_source) for match in matches], axis=0)
    errors = [lie.log(lie.inverse(T) @ match.T_target_source) - mean for match in matches]
    squares = [e @ match.information @ e for e, match in zip(errors, matches, strict=True)]
    k = len(mean)
    assert (0.5 if dimension == 2 else 0.1) < np.mean(squares) / k < 2.0


@pytest.mark.parametrize("matcher_name", ["plicp", "svd"])
@pytest.mark.parametrize(("dents", "is_believed"), [(30, False), (400, True)])
def test_a_sure_prediction_outweighs_weak_data_and_no_others(dents, is_believed, matcher_name):
    """A dent that says 5 cm: a handful of points is not believed against an experience of millimeters."""
    target = VoxelMap(2, LocalMapConfig(voxel_size_m=0.4))
    target.insert(dented_corridor(400), lie.identity(2))
    expected = lie.pose_2d(0.05, 0.0, 0.0)
    prior = Prior(expected, np.diag([0.002, 0.002, 0.001]) ** 2, np.array([0.5, 0.5, 0.2]))
    config = MatchingConfig(matcher=matcher_name, max_distance_m=0.8, min_information=1e-3)
    match = create_matcher(config).align(dented_corridor(dents, seed=1), target, expected, prior)
    assert match.degeneracy_eigenvalue > 1e-3
    assert (match.degeneracy_eigenvalue > 1e-2) == is_believed
    assert abs(match.T_target_source[0, 2] - (0.0 if is_believed else 0.05)) < 0.01


@pytest.mark.parametrize("matcher_name", ["plicp", "svd"])
def test_a_scan_far_from_the_map_says_that_nothing_matched(matcher_name):
    matcher, target = set_up(2, matcher=matcher_name)
    away = lie.pose_2d(500.0, 0.0, 0.0)
    match = matcher.align(scan_at(truth(2)), target, away)
    assert (match.inliers, match.converged) == (0, False)
    assert match.reason == "no point has a correspondence in the map"


@pytest.mark.parametrize("matcher_name", ["plicp", "svd"])
def test_a_match_depends_on_its_arguments_alone_and_leaves_them_as_they_are(dimension, matcher_name):
    matcher, target = set_up(dimension, matcher=matcher_name)
    points, T_first = scan_at(truth(dimension)), lie.identity(dimension)
    given = points.copy()
    first = matcher.align(points, target, T_first)
    matcher.align(points[::2] + 0.3, target, truth(dimension), wide=True)
    again = matcher.align(points, target, T_first)
    assert np.array_equal(again.T_target_source, first.T_target_source)
    assert np.array_equal(again.information, first.information) and again.iterations == first.iterations
    assert np.array_equal(points, given) and np.array_equal(T_first, lie.identity(dimension))


class Fixed:
    """Always the same match, of integers, and the arguments it was asked with."""

    def __init__(self, config):
        self.config = config

    def align(self, *arguments, **options):
        self.asked = *arguments, options
        return Match(np.eye(3, dtype=int), np.eye(3, dtype=int).tolist(), cost=1, inliers=5, points=9)


def test_a_class_of_the_users_gets_every_argument_and_its_match_the_arrays_of_ours():
    config, (_, target) = MatchingConfig(), set_up(2)
    matcher, points = CheckedMatcher("mine:Fixed", Fixed, config), np.zeros((9, 2))
    prior = Prior(lie.identity(2), np.eye(3), np.ones(3))
    match = matcher.align(points, target, lie.identity(2), prior, wide=True)
    *arguments, last, options = matcher.own.asked
    assert matcher.own.config is config and last is prior and options == {"wide": True}
    assert arguments[0] is points and arguments[1] is target
    assert match.inliers == 5 and match.degeneracy_direction.tolist() == [1.0, 0.0, 0.0]
    for array in (match.T_target_source, match.information, match.degeneracy_direction):
        assert isinstance(array, np.ndarray) and array.dtype == np.float64
