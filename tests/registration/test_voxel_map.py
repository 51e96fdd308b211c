import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.registration.voxel_map import MapKeeper, VoxelMap


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


def test_voxels_grow_where_the_noise_would_fill_them_and_no_sooner(dimension):
    config = LocalMapConfig(voxel_size_m=0.2)
    assert VoxelMap(dimension, config, 0.5, noise_m=0.03).voxels.size_m == pytest.approx(0.1)
    assert VoxelMap(dimension, config, 0.5, noise_m=0.08).voxels.size_m > 0.19


def drive(dimension, count, step_m=0.3):
    """Scans, each with its pose a step ahead of the one before."""
    rng = np.random.default_rng(dimension)
    poses = [lie.exp(np.eye(3 * dimension - 3)[0] * step_m * n) for n in range(count)]
    return [(rng.uniform(-5.0, 5.0, (60, dimension)), T) for T in poses]


def test_a_scan_is_inserted_once_the_lidar_moved_or_turned_far_enough():
    keeper = MapKeeper(2, LocalMapConfig(insert_distance_m=1.0, insert_angle_rad=0.5))
    inserted = []
    for x_m, yaw_rad in ((0.2, 0.0), (1.1, 0.0), (1.3, 0.0), (1.3, 0.4), (1.3, 0.6), (2.2, 0.6), (2.4, 0.6)):
        keeper.extend(np.ones((1, 2)), lie.pose_2d(x_m, 0.0, yaw_rad))
        inserted.append(keeper.surfaces.insertions)
    assert inserted == [1, 1, 2, 2, 3, 3, 4]


def test_at_a_standstill_the_first_scans_are_inserted_and_no_more_until_it_ends():
    keeper = MapKeeper(2, LocalMapConfig())
    for points, _ in drive(2, 30):
        keeper.extend(points, lie.identity(2), is_standing=True)
    assert keeper.surfaces.insertions == 10
    keeper.extend(np.ones((1, 2)), lie.identity(2))
    assert keeper.surfaces.insertions == 11


def test_a_map_rebuilt_with_other_voxels_is_one_of_the_last_scans_alone(dimension):
    config, scans = LocalMapConfig(), drive(dimension, 50)
    keeper = MapKeeper(dimension, config)
    for scan in scans:
        keeper.extend(*scan)
    before = keeper.surfaces
    keeper.resize(1.0)
    assert keeper.surfaces is before  # nothing has changed
    changes = [
        (lambda: keeper.resize(0.5), 0.0, scans[-20:]),
        (lambda: keeper.resize(0.5, 0.3), 0.3, scans[-20:]),
        (lambda: keeper.replace(scans[:7]), 0.3, scans[:7]),
    ]
    for change, noise_m, given in changes:
        change()
        expected = VoxelMap(dimension, config, 0.5, noise_m)
        for points, T in given:
            expected.insert(points, T)
        assert np.array_equal(keeper.surfaces.points(), expected.points())
        assert keeper.surfaces.voxels.size_m == expected.voxels.size_m
