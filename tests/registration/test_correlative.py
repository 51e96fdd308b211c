"""Correlative search by branch and bound, against trying every pose."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.kernels.search.branch_and_bound import draw_hits, fill_pyramid, search
from scanchain.registration import BirdsEye, CorrelativeMap, PlaceGrid, PlaceSearch, VoxelMap, Window
from scanchain.registration.birds_eye import upright_columns
from tests.support import naive_search


def walls(rng, count, side_m):
    """Points along walls that run with the axes."""
    lines = []
    for _ in range(count):
        start, axis = rng.uniform(0.0, side_m, 2), rng.integers(2)
        line = np.tile(start, (20, 1))
        line[:, axis] += np.linspace(0.0, 0.3 * side_m, 20)
        lines.append(line)
    return np.concatenate(lines)


def pyramid_of(means, resolution_m, levels):
    origin = means.min(axis=0) - resolution_m * (2 ** (levels - 1) + 1)
    columns, rows = np.ceil((means.max(axis=0) - origin) / resolution_m).astype(int) + 2
    pyramid = np.zeros((levels, rows, columns), np.uint8)
    draw_hits(means, origin, resolution_m, pyramid[0])
    fill_pyramid(pyramid)
    return pyramid, origin


@pytest.mark.parametrize("seed", range(3))
def test_every_level_holds_the_best_of_its_windows(seed):
    means = walls(np.random.default_rng(seed), 6, 5.0)
    pyramid, origin = pyramid_of(means, 0.25, 4)
    grid = naive_search.hits(means, origin, 0.25, pyramid.shape[1:])
    for level in range(4):
        assert np.array_equal(pyramid[level], naive_search.windows(grid, 2**level))


@pytest.mark.parametrize("seed", range(8))
def test_no_pose_of_the_window_scores_better_than_the_one_found(seed):
    rng = np.random.default_rng(seed)
    pyramid, origin = pyramid_of(walls(rng, 6, 5.0), 0.25, 4)
    T = lie.pose_2d(*rng.uniform(1.0, 4.0, 2), rng.uniform(-3.0, 3.0))
    points = lie.transform(lie.inverse(T), walls(rng, 3, 5.0))
    every = naive_search.scores(pyramid[0], origin, 0.25, points, T, 7, 4, 0.05)
    (x, y, yaw, share), *others = search(pyramid, origin, 0.25, points, T, 7, 4, 0.05, 0.0, 1.0, 0.8, 2)
    assert share == pytest.approx(max(every.values()))
    found = (round((yaw - float(lie.yaw(T))) / 0.05), round((x - T[0, 2]) / 0.25), round((y - T[1, 2]) / 0.25))
    assert every[found] == pytest.approx(share)
    elsewhere = [
        value
        for (turn, dx, dy), value in every.items()
        if abs(turn - found[0]) * 0.05 >= 0.1 or max(abs(dx - found[1]), abs(dy - found[2])) * 0.25 >= 1.0
    ]
    rivals = [max(elsewhere)] if max(elsewhere) >= 0.8 * share else []
    assert [other[3] for other in others] == pytest.approx(rivals)


@pytest.mark.parametrize("seed", range(4))
def test_every_further_answer_is_the_best_that_lies_apart_from_those_before(seed):
    rng = np.random.default_rng(seed)
    pyramid, origin = pyramid_of(walls(rng, 6, 5.0), 0.25, 4)
    points = walls(rng, 3, 5.0)
    every = naive_search.scores(pyramid[0], origin, 0.25, points, np.eye(3), 7, 4, 0.05)
    answers = search(pyramid, origin, 0.25, points, np.eye(3), 7, 4, 0.05, 0.0, 0.7, 0.5, 4)
    assert len(answers) > 1
    for x, y, yaw, share in answers:
        assert share == pytest.approx(max(every.values()))
        near = [
            pose
            for pose in every
            if abs(pose[0] * 0.05 - yaw) < 0.1 - 1e-9
            and max(abs(pose[1] * 0.25 - x), abs(pose[2] * 0.25 - y)) < 0.7
        ]
        for pose in near:
            del every[pose]


def test_below_the_least_share_nothing_is_found():
    rng = np.random.default_rng(0)
    pyramid, origin = pyramid_of(walls(rng, 6, 5.0), 0.25, 4)
    points = rng.uniform(0.0, 5.0, (40, 2))
    every = naive_search.scores(pyramid[0], origin, 0.25, points, np.eye(3), 4, 2, 0.05)
    best = max(every.values())
    found = search(pyramid, origin, 0.25, points, np.eye(3), 4, 2, 0.05, best - 1e-6, 1.0, 1.0, 1)
    assert found[0, 3] == pytest.approx(best)
    assert not len(search(pyramid, origin, 0.25, points, np.eye(3), 4, 2, 0.05, best + 1e-6, 1.0, 1.0, 1))


def searched(grid, points, steps, rival=0.5):
    search = PlaceSearch(grid, points, Window(np.inf, np.pi, 2.0, rival, 4, 0.3))
    rounds = 0
    while not search.is_done:
        assert search.go_on(steps) <= steps
        rounds += 1
    return search.poses(), rounds


@pytest.mark.parametrize("seed", range(4))
def test_the_best_pose_near_a_place_is_found_however_few_steps_are_taken_at_once(seed):
    rng = np.random.default_rng(seed)
    means, places, size_m = walls(rng, 12, 20.0), rng.uniform(3.0, 17.0, (3, 2)), 0.5
    T = lie.pose_2d(*places[1], rng.uniform(-3.0, 3.0))
    seen = means[np.linalg.norm(means - places[1], axis=1) < 8.0]
    points = lie.transform(lie.inverse(T), seen)
    grid = PlaceGrid(means, places, size_m, reach_m=1.0, range_m=8.0)
    at_once, rounds = searched(grid, points, 10**6)
    bit_by_bit, more_rounds = searched(grid, points, 7)
    assert rounds == 1 and more_rounds > 10 and np.array_equal(at_once, bit_by_bit)
    best = 0.0
    near = np.linalg.norm(at_once[0, :2] - places, axis=1).min()
    turns = len(PlaceSearch(grid, points, Window(np.inf, np.pi, 2.0, 0.5, 4)).offsets) // 2
    turn_rad = size_m / np.median(np.hypot(*points.T))
    for x, y in grid.surfaces.origin_m + size_m * (np.argwhere(grid.places[0].T) + 0.5):
        first = lie.pose_2d(x, y, 0.0)
        every = naive_search.scores(
            grid.surfaces.pyramid[0], grid.surfaces.origin_m, size_m, points, first, 0, turns, turn_rad
        )
        best = max(best, *every.values())
    assert at_once[0, 3] == pytest.approx(best) and near <= 1.0


def map_of(points):
    target = VoxelMap(2, LocalMapConfig(voxel_size_m=0.1))
    target.insert(points, lie.identity(2))
    return CorrelativeMap(target, lie.identity(2))


def test_a_scan_is_found_wherever_it_was_taken_however_it_is_turned():
    rng = np.random.default_rng(1)
    place = walls(rng, 20, 12.0)
    truth = lie.pose_2d(7.0, 3.0, 2.5)
    scan = lie.transform(lie.inverse(truth), place[np.linalg.norm(place - truth[:2, 2], axis=1) < 5.0])
    seed = map_of(place).best(scan, lie.identity(2), half_width_m=10.0, half_width_rad=np.pi)
    assert seed.share > 0.9
    assert np.abs(lie.log(lie.inverse(truth) @ seed.T_target_source)).max() < 0.15


def test_a_place_that_is_there_twice_has_a_rival_and_a_unique_one_has_none():
    rng = np.random.default_rng(2)
    room, other = walls(rng, 8, 4.0), walls(rng, 8, 4.0)
    for second, has_rival in ((room, True), (other, False)):
        seed = map_of(np.concatenate([room, second + np.array([6.0, 0.0])])).best(
            room, lie.identity(2), half_width_m=7.0, half_width_rad=0.2
        )
        assert (seed.rival > 0.9 * seed.share) == has_rival


def test_an_empty_map_and_an_empty_window_give_the_first_pose_back():
    T = lie.pose_2d(1.0, 2.0, 0.3)
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (30, 2))
    assert map_of(np.empty((0, 2))).best(points, T, half_width_m=1.0, half_width_rad=0.1, least=0.1).share == 0.0


def street(rng):
    """Points of a sloping ground of 80 x 80 m and of walls on it, dense in their height."""
    ground = rng.uniform(-40.0, 40.0, (30_000, 2))
    feet = walls(rng, 12, 60.0) - 30.0
    high = np.repeat(feet, 12, axis=0)
    ground, high = (np.column_stack([xy, 0.05 * xy[:, 0] - 1.7]) for xy in (ground, high))
    high[:, 2] += np.tile(np.linspace(0.0, 4.0, 12), len(feet))
    return ground, high


def test_columns_stand_on_walls_and_not_on_the_ground():
    ground, high = street(np.random.default_rng(3))
    columns = upright_columns(np.concatenate([ground, high]), 1.0)
    assert len(upright_columns(ground, 1.0)) == len(upright_columns(np.empty((0, 3)), 1.0)) == 0
    away_m = np.linalg.norm(columns[:, None] - high[None, :, :2], axis=2).min(axis=1)
    assert len(columns) > 100 and away_m.max() < 1.0


def test_a_scan_in_space_is_found_meters_away_and_turned():
    ground, high = street(np.random.default_rng(4))
    target = VoxelMap(3, LocalMapConfig())
    target.insert(np.concatenate([ground, high]), lie.identity(3))
    truth = lie.lift(lie.pose_2d(9.0, -5.0, 0.6))
    truth[2, 3] = 0.45
    scan = lie.transform(lie.inverse(truth), np.concatenate([ground[::3], high]))
    seeds = BirdsEye(target, lie.identity(3), 60.0).seeds(scan, half_width_m=15.0, half_width_rad=1.0, answers=3)
    away_m, away_rad = lie.apart(truth, seeds[0])
    assert away_m < 1.0 and away_rad < 0.1
    assert (
        BirdsEye(target, lie.identity(3), 60.0).seeds(ground, half_width_m=15.0, half_width_rad=1.0, answers=3)
        == ()
    )
