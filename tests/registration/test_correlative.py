"""Correlative search by branch and bound, against trying every pose."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.kernels.search.branch_and_bound import draw_hits, fill_pyramid, search
from scanchain.registration import CorrelativeMap, VoxelMap
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


def test_below_the_least_share_nothing_is_found():
    rng = np.random.default_rng(0)
    pyramid, origin = pyramid_of(walls(rng, 6, 5.0), 0.25, 4)
    points = rng.uniform(0.0, 5.0, (40, 2))
    every = naive_search.scores(pyramid[0], origin, 0.25, points, np.eye(3), 4, 2, 0.05)
    best = max(every.values())
    found = search(pyramid, origin, 0.25, points, np.eye(3), 4, 2, 0.05, best - 1e-6, 1.0, 1.0, 1)
    assert found[0, 3] == pytest.approx(best)
    assert not len(search(pyramid, origin, 0.25, points, np.eye(3), 4, 2, 0.05, best + 1e-6, 1.0, 1.0, 1))


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
