"""What moved leaves the maps, what stands stays, and the kernel equals its slow twin."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import MapsConfig
from scanchain.kernels.free_space import FAR, nearest_ranges, weigh_points
from scanchain.maps import View, build_point_map, draw_grid, moved
from tests.support import moving_worlds
from tests.support import naive_maps as naive


@pytest.fixture(scope="module")
def office():
    return list(moving_worlds.walkers_in_the_office())


@pytest.fixture(scope="module")
def town():
    return list(moving_worlds.traffic_in_the_town(30.0))


def judged(scans, voxel_m, spacing_m):
    """Voxel means of a map, which of them hold points of movers alone, and which were found to have moved."""
    pairs = [(scan.T_world_lidar, scan.points) for scan in scans]
    voxels = build_point_map(pairs, dimension=scans[0].points.shape[1], voxel_size_m=voxel_m).points()
    truth = {}
    for scan in scans:
        world = lie.transform(scan.T_world_lidar, scan.points)
        for key, moves in zip(map(tuple, np.floor(world / voxel_m).astype(int)), scan.moves, strict=True):
            truth[key] = truth.get(key, True) and moves
    views = [View(scan.T_world_lidar, scan.points, spacing_m) for scan in scans]
    return voxels, np.array(list(truth.values())), moved(voxels, voxel_m, views)


def test_people_who_walk_about_leave_the_cloud_and_the_office_stays(office):
    _, moves, gone = judged(office, 0.05, 0.01)
    assert moves.sum() > 500
    assert gone[moves].mean() > 0.95 and gone[~moves].mean() < 0.002


@pytest.mark.slow
def test_traffic_leaves_the_cloud_but_for_what_is_close_to_the_ground_and_the_town_stays(town):
    voxels, moves, gone = judged(town, 0.2, 0.5)
    way = np.array([scan.T_world_lidar[:3, 3] for scan in town])
    near = np.min(np.linalg.norm(voxels[:, None, :2] - way[None, ::4, :2], axis=2), axis=1) < 20.0
    assert gone[moves & near].mean() > 0.8 and gone[~moves].mean() < 0.002
    ground_m = moving_worlds.ground_height(voxels[:, :2])
    high = near & (voxels[:, 2] > ground_m + 0.4)
    assert (moves & high).sum() > 5000 and gone[moves & high].mean() > 0.95


def test_people_who_walk_about_leave_no_trace_in_the_grid(office):
    config = MapsConfig(grid_resolution_m=0.05)
    grid = draw_grid([(scan.T_world_lidar, scan.points) for scan in office], config)
    still = draw_grid([(scan.T_world_lidar, scan.points[~scan.moves]) for scan in office], config)
    moving = np.vstack([lie.transform(scan.T_world_lidar, scan.points[scan.moves]) for scan in office])
    columns, rows = np.floor((moving - grid.origin_m) / 0.05).astype(int).T
    struck = np.zeros(grid.log_odds.shape, bool)
    struck[rows, columns] = True
    assert still.log_odds.shape == grid.log_odds.shape
    traces = struck & (grid.probability() > 0.65) & (still.probability() < 0.65)
    assert struck.sum() > 500 and traces.sum() < 0.02 * struck.sum()


@pytest.mark.parametrize("shape", [(90, 180), (1, 180)])
def test_sight_equals_naive(shape):
    random = np.random.default_rng(2)
    flat = np.array([1.0, 1.0, 0.0 if shape[0] == 1 else 0.4])
    points = random.normal(scale=8.0, size=(1500, 3)) * flat
    ranges_m = np.empty(shape)
    nearest_ranges(random.normal(scale=12.0, size=(4000 if shape[0] > 1 else 90, 3)) * flat, ranges_m)
    limits = np.array([15.0, 1.0, 0.3, 0.03, 0.2, 0.01])
    T = lie.exp(np.array([0.3, -0.2, 0.0, 0.0, 0.0, 0.4]))
    counts = np.zeros((2, len(points)), np.int32)
    weigh_points(points, np.array([[0, 700], [700, 1500]]), T, ranges_m, limits, 5, *counts)
    expected = [naive.sight(point, ranges_m, limits) for point in lie.transform(T, points)]
    assert (counts[0] - counts[1]).tolist() == expected
    assert {-1, 0, 1} == set(expected)


def test_points_outside_the_spans_and_those_seen_often_enough_are_left_alone():
    points, ranges_m = np.tile([5.0, 0.0, 0.0], (3, 1)), np.full((90, 180), FAR)
    nearest_ranges(points[:1], ranges_m)
    seen, seen_through = np.array([0, 3, 0], np.int32), np.zeros(3, np.int32)
    limits = np.array([15.0, 1.0, 0.3, 0.03, 0.2, 0.01])
    weigh_points(points, np.array([[0, 2]]), np.eye(4), ranges_m, limits, 3, seen, seen_through)
    assert seen.tolist() == [1, 3, 0] and not seen_through.any()


def test_a_pole_before_a_far_wall_stands_though_most_rays_pass_it():
    wall = np.stack(np.meshgrid([20.0], np.arange(-8, 8, 0.25), np.arange(-1, 4, 0.25)), axis=-1).reshape(-1, 3)
    random, views = np.random.default_rng(0), []
    for k in range(20):
        T = lie.exp(np.array([0.2 * k, 0.0, 0.0, 0.0, 0.0, 0.0]))
        heights = np.arange(-1.0, 1.5, 0.5) + random.uniform(0.0, 0.5, 5)  # one a voxel, as scans are thinned out
        pole = np.column_stack([np.full(5, 9.0), np.zeros(5), heights])
        views.append(View(T, lie.transform(lie.inverse(T), np.vstack([wall, pole])), 0.5))
    heights = np.arange(-0.9, 1.2, 0.2)
    standing = np.column_stack([np.full(len(heights), 9.0), np.zeros(len(heights)), heights])
    gone = moved(np.vstack([standing, [[9.0, 2.0, 0.5]]]), 0.2, views)
    assert gone.tolist() == [False] * len(heights) + [True]


def test_a_leg_hides_what_is_behind_it_and_not_what_is_beside():
    angle = np.radians(np.arange(-20.0, 20.0, 0.5) + 0.25)
    ranges = np.where(np.abs(angle) < np.radians(0.5), 2.0, 9.0)  # the leg, a degree wide, before a wall
    scan = ranges[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    behind, beside = [6.0, 0.0], 6.0 * np.array([np.cos(np.radians(0.8)), np.sin(np.radians(0.8))])
    gone = moved(np.vstack([behind, beside]), 0.05, [View(lie.identity(2), scan, 0.01)] * 3)
    assert gone.tolist() == [False, True]


def test_maps_of_nothing_have_nothing_that_moved():
    assert moved(np.empty((0, 3)), 0.2, [View(np.eye(4), np.empty((0, 3)), 0.5)]).shape == (0,)
