import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.config import LocalMapConfig, MatchingConfig
from scanchain.data import Prior
from scanchain.registration import DegeneratePairsError, VoxelMap, create_matcher, rigid_transform
from scanchain.registration.plicp import OPTIMIZERS


def room(dimension, seed=0, unit=1.0):
    """Points on the walls (and floor) of a room with a pillar, some centimeters of noise."""
    rng = np.random.default_rng(seed)
    n = 3000
    z = rng.uniform(0.0, 2.5, n)
    x, y = rng.uniform(-4.0, 4.0, n), rng.uniform(-3.0, 3.0, n)
    walls = [
        np.column_stack([x, np.full(n, 3.0), z]),
        np.column_stack([x, np.full(n, -3.0), z]),
        np.column_stack([np.full(n, 4.0), y, z]),
        np.column_stack([np.full(n, -4.0), y, z]),
    ]
    if dimension == 3:
        walls.append(np.column_stack([x, y, np.zeros(n)]))
    points = np.concatenate(walls) + 0.01 * rng.normal(size=(n * len(walls), 3))
    return unit * np.ascontiguousarray(points[:, :dimension])


def set_up(dimension, unit=1.0, **changes):
    """A matcher for the room, every length of its configuration in the given unit."""
    settings = {
        "max_distance_m": 0.8, "kernel_scale_m": 0.2, "wide_max_distance_m": 1.0, "wide_kernel_scale_m": 0.5,
        "tolerance_m": 1e-5, "sensor_noise_m": 0.02,
    }  # fmt: skip
    scaled = {name: unit * value for name, value in settings.items()}
    config = msgspec.convert({"tolerance_rad": 1e-6, "max_iterations": 200, **scaled, **changes}, MatchingConfig)
    target = VoxelMap(dimension, LocalMapConfig(voxel_size_m=0.4 * unit))
    target.insert(room(dimension, unit=unit), lie.identity(dimension))
    return create_matcher(config), target


def truth(dimension, unit=1.0):
    T = lie.exp(np.array([0.12, -0.07, 0.04] if dimension == 2 else [0.12, -0.07, 0.05, 0.02, -0.03, 0.04]))
    T[:-1, -1] *= unit
    return T


def scan_at(T, unit=1.0):
    """The room seen from T, a tenth of its points."""
    return lie.transform(lie.inverse(T), room(T.shape[0] - 1, seed=1, unit=unit)[::10])


def off(T_a, T_b):
    return np.abs(lie.log(lie.inverse(T_a) @ T_b)).max()


def test_all_four_optimizers_reach_one_minimum_near_the_truth_by_second_order_in_half_the_steps(dimension):
    T, found = truth(dimension), {}
    for optimizer in OPTIMIZERS:
        matcher, target = set_up(dimension, optimizer=optimizer, max_iterations=20_000)
        found[optimizer] = matcher.align(scan_at(T), target, lie.identity(dimension))
    expected, slow = found["levenberg-marquardt"], found.pop("gradient-descent")
    assert expected.converged and off(expected.T_target_source, T) < 3e-3
    for match in found.values():
        assert off(match.T_target_source, expected.T_target_source) < 1e-3 and match.iterations < 40
    # correspondences and their weights stay after PATIENCE associations, when gradient descent is on its way still
    assert off(slow.T_target_source, expected.T_target_source) < 5e-3
    assert slow.iterations >= 2 * expected.iterations


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


def test_a_smooth_floor_between_rough_walls_holds_height_and_tilt_as_its_own_residuals_say():
    rng = np.random.default_rng(4)

    def room(count):
        points = rng.uniform([-8, -8, 0], [8, 8, 6], (count, 3))
        side = rng.integers(0, 3, count)
        rows = np.arange(count)
        points[rows, side] = np.where(side == 2, 0.0, np.sign(points[rows, side]) * 8.0)
        points[rows, side] += rng.normal(size=count) * np.where(side == 2, 0.003, 0.06)
        return points - np.array([0.0, 0.0, 2.0])

    target = VoxelMap(3, LocalMapConfig(voxel_size_m=1.0))
    target.insert(room(60_000), lie.identity(3))
    matcher = create_matcher(MatchingConfig())
    matches = [matcher.align(room(2_000), target, lie.identity(3)) for _ in range(40)]
    errors = np.array([lie.log(match.T_target_source) for match in matches])
    covariances = np.array([np.linalg.inv(match.information) for match in matches])
    variances = np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0)
    squares = ((errors - errors.mean(axis=0)) ** 2).mean(axis=0) / variances
    assert ((squares > 0.2) & (squares < 3.0)).all(), squares


def dented_corridor(dents, seed=0):
    """Two walls 20 m long, 1 cm of noise, with so many points on the faces of a dent across them."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-10, 10, 4000)
    walls = np.column_stack([x, np.where(rng.random(4000) < 0.5, 1.0, -1.0) + 0.01 * rng.normal(size=4000)])
    faces = np.column_stack([0.01 * rng.normal(size=dents) + 2.0, rng.uniform(0.2, 1.0, dents)])
    return np.concatenate([walls, faces])


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


def test_a_map_forgets_what_is_far_and_what_is_old():
    config = LocalMapConfig(voxel_size_m=1.0, max_distance_m=30.0, max_insertions=50)
    target = VoxelMap(3, config)
    rng = np.random.default_rng(0)
    sizes = []
    for step in range(400):
        target.insert(rng.uniform(-10, 10, (500, 3)), lie.exp(np.array([step * 1.0, 0, 0, 0, 0, 0])))
        sizes.append(len(target))
    assert np.abs(target.points()[:, 0] - 399.0).max() < 30.0 + 20 * 1.0 + 10.0
    assert max(sizes[200:]) < 1.1 * max(sizes[100:200])
    standing = VoxelMap(2, config)
    standing.insert(np.array([[5.0, 5.0]]), lie.identity(2))
    for _ in range(80):
        standing.insert(np.array([[1.0, 1.0]]), lie.identity(2))
    assert len(standing) == 1


@pytest.mark.parametrize("is_measured", [True, False])
def test_along_a_bare_corridor_of_the_plane_a_measured_motion_holds_and_any_is_degenerate(is_measured):
    target = VoxelMap(2, LocalMapConfig(voxel_size_m=0.2))
    for seed in range(6):
        target.insert(dented_corridor(0, seed), lie.identity(2))
    expected = lie.pose_2d(0.05, 0.0, 0.0)
    prior = Prior(expected, np.diag([0.01, 0.01, 0.005]) ** 2, np.array([0.5, 0.5, 0.2]), is_measured=is_measured)
    config = MatchingConfig(max_distance_m=0.5, kernel_scale_m=0.1, min_information=0.0)
    match = create_matcher(config).align(dented_corridor(0, seed=99), target, expected, prior)
    assert match.observability < 1.0 and not match.converged
    assert abs(match.degeneracy_direction[0]) > np.cos(np.radians(5.0))
    sigma_m = np.sqrt(np.linalg.inv(match.information + 1e-6 * np.eye(3))[0, 0])
    if is_measured:  # stays where the wheels have it, and does not claim to have measured it
        assert match.T_target_source[0, 2] == pytest.approx(0.05, abs=0.005) and sigma_m > 0.01
