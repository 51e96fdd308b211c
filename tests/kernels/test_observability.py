"""Observability of a pose: every kernel equals its slow, clear twin, and degenerate scenes are found."""

import math

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig, MatchingConfig
from scanchain.data import Prior
from scanchain.kernels import geometry
from scanchain.kernels.matrices import definite_inverse, eigensystem
from scanchain.kernels.registration import icp, observability
from scanchain.kernels.registration.residuals import normal_equations
from scanchain.registration import VoxelMap, create_matcher
from scanchain.registration.plicp import settings_of
from tests.support import naive

LIMITS = MatchingConfig(max_distance_m=1.0, sensor_noise_m=0.02)
BEFORE = 12  # scans


def definite(k, spread=1.0, seed=0):
    """A symmetric positive definite (k, k), its eigenvalues a factor 10^spread from each other."""
    rng = np.random.default_rng(seed)
    vectors = np.linalg.qr(rng.normal(size=(k, k)))[0]
    return (vectors * 10.0 ** (-spread * np.arange(k))) @ vectors.T


def some_pose(k, seed=0):
    return lie.exp(np.random.default_rng(seed).normal(size=k))


DEFINITE = [definite(k, spread) for k in (3, 6) for spread in (0.0, 0.5, 2.0)]


@pytest.mark.parametrize("A", [*DEFINITE, np.zeros((3, 3)), np.diag([0.0, 2.0, 1.0]), np.ones((3, 3))])
def test_the_eigensystem_of_a_small_matrix_equals_lapacks(A):
    k = len(A)
    values, vectors = np.empty(k), np.empty((k, k))
    eigensystem(A.copy(), values, vectors)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(A), atol=1e-14)
    np.testing.assert_allclose((vectors * values) @ vectors.T, A, atol=1e-14)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(k), atol=1e-14)


@pytest.mark.parametrize("A", [definite(3), definite(6), np.diag([1.0, 0.0, 1.0])])
def test_a_definite_matrix_has_an_inverse_and_another_has_none(A):
    wanted = np.linalg.inv(A) if np.linalg.det(A) else np.zeros((3, 3))
    np.testing.assert_allclose(definite_inverse(A), wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("k", [3, 6])
def test_the_spectrum_counts_turns_as_lengths(k):
    H = definite(k)
    found = observability.spectrum_of(H, 7.0, 12.0)
    scale, values, vectors = naive.spectrum(H, 7.0, 12.0)
    np.testing.assert_allclose(found.scale, scale)
    np.testing.assert_allclose(found.values, values, atol=1e-15)
    np.testing.assert_allclose(np.abs((found.vectors * vectors).sum(axis=0)), 1.0)


@pytest.mark.parametrize("k", [3, 6])
@pytest.mark.parametrize("min_information", [1e-9, 1e-4, 1e-2, 1.0])
@pytest.mark.parametrize("signal", [0.5, 2.9, 3.1, 29.0, 31.0, np.inf])
@pytest.mark.parametrize("is_fused", [False, True])
def test_weak_directions_have_a_prior_and_no_others(k, min_information, signal, is_fused):
    H, expected = definite(k, 1.5), definite(k, 0.5, seed=1)
    config = MatchingConfig(min_information=min_information, min_signal=3.0)
    settings = settings_of(config, VoxelMap(3, LocalMapConfig()), wide=False)
    found = observability.spectrum_of(H, 2.0, 5.0)
    found.signals[1] = signal
    prior = observability.weak_prior(found, 2.0, expected, is_fused, settings)
    wanted = naive.weak_prior(H, 2.0, 5.0, expected, found.signals, (min_information, 3.0), is_fused)
    np.testing.assert_allclose(prior, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("k", [3, 6])
def test_information_turns_into_the_frame_of_the_source(k):
    T, T_first, H = some_pose(k), some_pose(k, seed=1), definite(k)
    direction = observability.spectrum_of(H, 1.0, 3.0).vectors[:, 0]
    found = observability.seen_from_source(T, T_first, H, direction, 0.04)
    for one, other in zip(found, naive.seen_from_source(T, T_first, H, direction, 0.04), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


@pytest.mark.parametrize("k", [3, 6])
@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 0.3, 3.0, math.pi - 1e-6, math.pi])
def test_how_far_apart_two_poses_are_and_what_lies_between_them(k, angle_rad):
    a, turn = some_pose(k), np.zeros(k)
    turn[-1] = angle_rad
    b = a @ lie.exp(turn)
    b[:-1, -1] += 0.5
    meters, radians = geometry.apart(a, b)
    assert meters == pytest.approx(0.5 * math.sqrt(len(a) - 1))
    assert radians == pytest.approx(angle_rad, abs=1e-7)
    assert math.isclose(radians, float(lie.rotation_angle(lie.between(a, b))), abs_tol=1e-7)
    np.testing.assert_allclose(a @ lie.between(a, b), b, atol=1e-14)
    np.testing.assert_allclose(lie.between(a[None], b[None])[0], lie.between(a, b), atol=1e-14)


def walls(seed, ends=0, length_m=16.0):
    """Points on the floor and two walls of a corridor along x, 2 cm of noise, and so many on faces across it."""
    rng = np.random.default_rng(seed)
    n = 1500
    x = rng.uniform(-length_m / 2.0, length_m / 2.0, 3 * n)
    across = rng.uniform(-1.0, 1.0, 3 * n)
    sides = np.repeat([0, 1, 2], n)
    y = np.where(sides == 0, 1.5 * across, np.where(sides == 1, -1.5, 1.5))
    points = np.column_stack([x, y, np.where(sides == 0, -1.0, 0.3 + across)])
    faces = np.column_stack([np.full(ends, 6.0), rng.uniform(-1.5, 1.5, ends), rng.uniform(-1.0, 1.2, ends)])
    points = np.concatenate([points, faces])
    return points + 0.02 * rng.normal(size=points.shape)


def map_of(ends=0, scans=BEFORE, d=3):
    voxel_map = VoxelMap(d, LocalMapConfig(voxel_size_m=0.5))
    for seed in range(scans):
        voxel_map.insert(walls(seed, ends)[:, :d].copy(), lie.identity(d))
    return voxel_map


def aligned(voxel_map, points, prior=None):
    return create_matcher(LIMITS).align(points, voxel_map, lie.identity(3), prior)


def at_its_fit(voxel_map, points):
    """A problem aligned from nearby: it, its pose and the settings."""
    d = points.shape[1]
    k, settings = d * (d + 1) // 2, settings_of(LIMITS, voxel_map, wide=False)
    T = lie.exp(np.array([0.02, -0.01, 0.03] if d == 2 else [0.02, -0.01, 0.03, 0.001, 0.002, -0.003]))
    problem = icp.problem_of(voxel_map.voxels, points, T, np.zeros((k, k)), settings)
    icp.align(problem, T, np.zeros(k), settings.first_scale_m)
    return problem, T, settings


@pytest.mark.parametrize("twist", [np.eye(6)[0], np.eye(6)[4], np.array([0.3, -0.2, 0.5, 0.02, -0.1, 0.05])])
@pytest.mark.parametrize("scans", [1, 2, BEFORE])
def test_the_signal_is_that_of_its_slow_twin(twist, scans):
    voxel_map, points = map_of(200, scans), walls(99, 30)[::5].copy()
    voxel_map.insert(points + np.array([0.0, 0.0, 0.4]), lie.identity(3))  # voxels that are young
    problem, T, _ = at_its_fit(voxel_map, points)
    found = observability.signal_along(problem, T, twist)
    assert found == pytest.approx(naive.signal_along(voxel_map, problem, T, twist), rel=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_gradients_of_the_sectors_are_those_of_their_points_near_and_far(d):
    points = walls(99, 30)[::5, :d].copy()
    problem, T, settings = at_its_fit(map_of(200, 3, d), points)
    range_m, k = np.linalg.norm(points, axis=1), len(problem.prior)
    gradients = icp.gradients_of_sectors(problem, T)
    assert problem.range_m == pytest.approx(np.sqrt((range_m**2).mean()))
    number = (points[:, 0] > 0.0) + 2 * (points[:, 1] > 0.0) + 4 * (range_m > problem.range_m)
    for sector in range(8):
        H, b = np.zeros((k, k)), np.zeros(k)
        others = np.where(number == sector, problem.correspondence, -1).astype(np.int32)
        normal_equations(problem._replace(correspondence=others), T, settings.scale_m, 0.0, H, b)
        np.testing.assert_allclose(gradients[sector], b, atol=1e-9)
    assert np.abs(gradients).max(axis=1).all()


def test_a_corridor_without_ends_has_the_signal_of_noise_and_a_face_across_it_makes_it_observable():
    match = aligned(map_of(), walls(99)[::2])
    assert match.observability < 1.0 / 3.0
    assert abs(match.degeneracy_direction[0]) > np.cos(np.radians(5.0))
    match = aligned(map_of(ends=90), walls(99, ends=90)[::2])  # a fiftieth of the points
    assert match.degeneracy_eigenvalue < 0.02
    assert match.observability > 5.0


def test_neither_one_surface_alone_nor_a_wall_that_is_new_in_the_map_is_enough():
    """As much information as by the fiftieth above: all on one voxel, or in none that is older."""
    one, new, rng = map_of(), map_of(), np.random.default_rng(5)
    face = np.array([[6.0, y, z] for y in np.linspace(-0.4, 0.4, 4) for z in np.linspace(0.1, 0.4, 4)])
    for _ in range(8):
        one.insert(face + 0.02 * rng.normal(size=face.shape), lie.identity(3))
    new.insert(walls(98, ends=90), lie.identity(3))
    for voxel_map, points in ((one, np.concatenate([walls(99)[::2], face])), (new, walls(99, ends=90)[::2])):
        match = aligned(voxel_map, points)
        assert match.degeneracy_eigenvalue > 0.005
        assert match.observability < 0.5


def test_along_a_degenerate_direction_the_pose_stays_at_the_prediction():
    shifted = lie.exp(np.array([0.04, 0.0, 0.0, 0.0, 0.0, 0.0]))
    prior = Prior(lie.identity(3), np.diag(np.full(6, 0.01)), np.full(6, 0.5))
    blind = aligned(map_of(), lie.transform(shifted, walls(99))[::2], prior)
    seeing = aligned(map_of(ends=200), lie.transform(shifted, walls(99, ends=200))[::2], prior)
    assert abs(blind.T_target_source[0, 3]) < 1e-3
    assert abs(seeing.T_target_source[0, 3] + 0.04) < 0.01
