"""Signal-to-noise ratio along a twist: the kernel equals its slow twin, and degenerate scenes are found."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig, MatchingConfig
from scanchain.data import Prior
from scanchain.kernels.registration import icp, observability
from scanchain.kernels.registration.residuals import normal_equations
from scanchain.registration import VoxelMap, create_matcher
from scanchain.registration.plicp import settings_of
from tests.support.naive_evidence import signal_along

LIMITS = MatchingConfig(max_distance_m=1.0, sensor_noise_m=0.02)
BEFORE = 12  # scans


def walls(seed, ends=0, length_m=16.0):
    """Points on the floor and two walls of a corridor along x, 2 cm of noise, and so many on faces across it."""
    rng = np.random.default_rng(seed)
    n = 1500
    x = rng.uniform(-length_m / 2.0, length_m / 2.0, 3 * n)
    across = rng.uniform(-1.0, 1.0, 3 * n)
    sides = np.repeat([0, 1, 2], n)
    points = np.column_stack(
        [
            x,
            np.where(sides == 0, 1.5 * across, np.where(sides == 1, -1.5, 1.5)),
            np.where(sides == 0, -1.0, 0.3 + across),
        ]
    )
    faces = np.column_stack([np.full(ends, 6.0), rng.uniform(-1.5, 1.5, ends), rng.uniform(-1.0, 1.2, ends)])
    points = np.concatenate([points, faces])
    return points + 0.02 * rng.normal(size=points.shape)


def map_of(ends=0, scans=BEFORE):
    voxel_map = VoxelMap(3, LocalMapConfig(voxel_size_m=0.5))
    for seed in range(scans):
        voxel_map.insert(walls(seed, ends), lie.identity(3))
    return voxel_map


def aligned(voxel_map, points, prior=None):
    return create_matcher(LIMITS).align(points, voxel_map, lie.identity(3), prior)


@pytest.mark.parametrize("twist", [np.eye(6)[0], np.eye(6)[4], np.array([0.3, -0.2, 0.5, 0.02, -0.1, 0.05])])
@pytest.mark.parametrize("scans", [1, 2, BEFORE])
def test_the_signal_is_that_of_its_slow_twin(twist, scans):
    voxel_map, points = map_of(200, scans), walls(99, 30)[::5]
    voxel_map.insert(points + np.array([0.0, 0.0, 0.4]), lie.identity(3))  # voxels that are young
    T = lie.exp(np.array([0.02, -0.01, 0.03, 0.001, 0.002, -0.003]))
    settings = settings_of(LIMITS, voxel_map, wide=False)
    problem = icp.problem_of(voxel_map.voxels, points, T, np.zeros((6, 6)), settings)
    icp.align(problem, T, np.zeros(6), settings.first_scale_m)
    found = observability.signal_along(problem, T, twist)
    assert found == pytest.approx(signal_along(voxel_map, problem, T, twist), rel=1e-9)


def test_a_corridor_without_ends_has_the_signal_of_noise():
    match = aligned(map_of(), walls(99)[::2])
    assert match.observability < 1.0 / 3.0
    assert abs(match.degeneracy_direction[0]) > np.cos(np.radians(5.0))


def test_a_fiftieth_of_the_points_on_a_face_across_the_corridor_makes_it_observable():
    match = aligned(map_of(ends=90), walls(99, ends=90)[::2])
    assert match.degeneracy_eigenvalue < 0.02
    assert match.observability > 5.0


def test_one_surface_alone_is_not_enough():
    """As much information as in the fiftieth above, all by points on one voxel."""
    voxel_map = map_of()
    face = np.array([[6.0, y, z] for y in np.linspace(-0.4, 0.4, 4) for z in np.linspace(0.1, 0.4, 4)])
    rng = np.random.default_rng(5)
    for _ in range(8):
        voxel_map.insert(face + 0.02 * rng.normal(size=face.shape), lie.identity(3))
    match = aligned(voxel_map, np.concatenate([walls(99)[::2], face]))
    assert match.degeneracy_eigenvalue > 0.005
    assert match.observability < 0.5


def test_a_wall_that_is_new_in_the_map_is_not_enough():
    voxel_map = map_of()
    voxel_map.insert(walls(98, ends=90), lie.identity(3))
    match = aligned(voxel_map, walls(99, ends=90)[::2])
    assert match.degeneracy_eigenvalue > 0.005
    assert match.observability < 0.5


def test_along_a_degenerate_direction_the_pose_stays_at_the_prediction():
    shifted = lie.exp(np.array([0.04, 0.0, 0.0, 0.0, 0.0, 0.0]))
    prior = Prior(lie.identity(3), np.diag(np.full(6, 0.01)), np.full(6, 0.5))
    blind = aligned(map_of(), lie.transform(shifted, walls(99))[::2], prior)
    seeing = aligned(map_of(ends=200), lie.transform(shifted, walls(99, ends=200))[::2], prior)
    assert abs(blind.T_target_source[0, 3]) < 1e-3
    assert abs(seeing.T_target_source[0, 3] + 0.04) < 0.01


@pytest.mark.parametrize("d", [2, 3])
def test_gradients_of_the_sectors_are_those_of_their_points(d):
    voxel_map, points = VoxelMap(d, LocalMapConfig(voxel_size_m=0.5)), walls(99, 30)[::5, :d].copy()
    for seed in range(3):
        voxel_map.insert(walls(seed, 200)[:, :d].copy(), lie.identity(d))
    k, settings = d * (d + 1) // 2, settings_of(LIMITS, voxel_map, wide=False)
    T = lie.exp(np.array([0.02, -0.01, 0.03] if d == 2 else [0.02, -0.01, 0.03, 0.001, 0.002, -0.003]))
    problem = icp.problem_of(voxel_map.voxels, points, T, np.zeros((k, k)), settings)
    icp.align(problem, T, np.zeros(k), settings.first_scale_m)
    found, far = problem.gradients, np.linalg.norm(points, axis=1) > problem.range_m
    number = (points[:, 0] > 0.0) + 2 * (points[:, 1] > 0.0) + 4 * far
    for sector in range(8):
        H, b = np.zeros((k, k)), np.zeros(k)
        others = np.where(number == sector, problem.correspondence, -1).astype(np.int32)
        normal_equations(problem._replace(correspondence=others), T, settings.scale_m, 0.0, H, b)
        np.testing.assert_allclose(found[sector], b, atol=1e-9)
    assert np.abs(found).max(axis=1).all()
