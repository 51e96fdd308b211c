import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.kernels.registration import icp
from scanchain.registration.plicp import settings_of
from scanchain.registration.svd_icp import DegeneratePairsError, SvdMatcher, rigid_transform
from tests.support.matching import off, scan_at, set_up, truth


def test_the_closed_form_equals_scipys(dimension):
    rng = np.random.default_rng(4)
    x = rng.normal(size=(40, 3)) * ([1, 1, 0] if dimension == 2 else 1)
    T = lie.exp(np.array([1, 2, 0, 0, 0, 2.0] if dimension == 2 else [1, 2, 3, 0.3, -1.2, 2.0]))
    y = lie.transform(T, x) + 0.1 * rng.normal(size=x.shape) * ([1, 1, 0] if dimension == 2 else 1)
    weight = rng.uniform(0.1, 1.0, 40)
    center = [weight @ v / weight.sum() for v in (x, y)]
    R = Rotation.align_vectors(y - center[1], x - center[0], weights=weight)[0].as_matrix()
    answer = rigid_transform(x[:, :dimension], y[:, :dimension], weight)
    np.testing.assert_allclose(answer[:-1, :-1], R[:dimension, :dimension], atol=1e-9)
    np.testing.assert_allclose(answer[:-1, -1], (center[1] - R @ center[0])[:dimension], atol=1e-9)


def test_noisy_points_never_come_out_as_a_reflection(dimension):
    rng = np.random.default_rng(5)
    for _ in range(200):
        x, y = rng.normal(size=(2, dimension + 1, dimension))
        T = rigid_transform(x, y, np.ones(len(x)))
        assert np.linalg.det(T[:-1, :-1]) == pytest.approx(1.0)


def test_planar_points_in_space_give_a_rotation_not_a_reflection():
    rng = np.random.default_rng(6)
    x = rng.normal(size=(30, 3)) * [1, 1, 0]
    T = lie.exp(np.array([1, 2, 3, 0.3, -1.2, 2.0]))
    np.testing.assert_allclose(rigid_transform(x, lie.transform(T, x), np.ones(30)), T, atol=1e-9)


@pytest.mark.parametrize(
    ("x", "word"), [(np.outer(np.linspace(-1, 1, 20), [1.0, 2.0, -1.0]), "line"), (np.ones((5, 2)), "point")]
)
def test_points_that_leave_a_rotation_free_are_refused_not_answered(x, word):
    with pytest.raises(DegeneratePairsError, match=f"on a {word}"):
        rigid_transform(x, x + 1.0, np.ones(len(x)))


def plain_icp(points, target, config):
    """Pose and iterations of closest points and closed form in turn, without acceleration, to the last digit."""
    settings, k = settings_of(config, target, wide=False), lie.twist_size(lie.identity(points.shape[1]))
    T, scale_m = lie.identity(points.shape[1]), settings.first_scale_m
    problem = icp.problem_of(target.voxels, points, T, np.zeros((k, k)), settings)
    source, closest, weight = np.empty_like(points), np.empty_like(points), np.empty(len(points))
    iterations, moved = 0, np.inf
    while moved > 1e-9 and iterations < 2000:
        count = icp.closest_pairs(problem, T, scale_m, source, closest, weight)
        step = rigid_transform(source[:count], closest[:count], weight[:count])
        T, scale_m = lie.normalize(step @ T), max(settings.scale_m, icp.SHRINK * scale_m)
        iterations, moved = iterations + 1, np.abs(lie.log(step)).max()
    return T, iterations


def test_the_accelerated_iteration_ends_where_plain_icp_does_in_fewer_steps(dimension):
    matcher, target = set_up(dimension, matcher="svd", tolerance_m=1e-5, tolerance_rad=1e-5)
    assert isinstance(matcher, SvdMatcher)
    points = scan_at(truth(dimension))[::4]
    expected, iterations = plain_icp(points, target, matcher.config)
    match = matcher.align(points, target, lie.identity(dimension))
    assert match.at_minimum and off(match.T_target_source, expected) < 1e-5
    assert 4 * match.iterations < iterations < 2000
