"""Correlative search by branch and bound, against trying every pose."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.registration import SearchGrid, VoxelMap, Wanted, Window, find, search
from scanchain.registration.search import Search, upright_columns
from tests.support import naive
from tests.support.scenes import sloping_street, walls

CELL_M = 0.25


def scene(seed):
    """A grid of walls with free space among them, and points of such walls."""
    rng = np.random.default_rng(seed)
    drawn = SearchGrid.of_points(walls(rng, 6, 5.0), CELL_M)
    cells = drawn.pyramid[0].copy()
    cells[(cells == 0) & (rng.uniform(size=cells.shape) < 0.2)] = -2
    room = rng.uniform(size=cells.shape) < 0.2
    return SearchGrid(cells, drawn.origin_m, CELL_M, room), walls(rng, 3, 5.0), rng


def every(grid, points, turn_rad, T, shifts, turns):
    """Shares by pose: turn, x and y in steps from T."""
    return naive.scores(grid.pyramid[0], grid.origin_m, CELL_M, points, T, shifts, turns, turn_rad)


def test_every_level_holds_the_best_of_its_windows():
    means = walls(np.random.default_rng(0), 6, 5.0)
    grid = SearchGrid.of_points(means, CELL_M)
    drawn = naive.hits(means, grid.origin_m, CELL_M, grid.room.shape)
    for level, layer in enumerate(grid.pyramid):
        assert np.array_equal(layer, naive.windows(drawn, 2**level))


@pytest.mark.parametrize("seed", range(8))
def test_every_answer_is_the_best_pose_of_the_window_that_lies_apart_from_those_before(seed):
    grid, points, rng = scene(seed)
    T = lie.pose_2d(*rng.uniform(-1.0, 1.0, 2), rng.uniform(-3.0, 3.0))
    points = lie.transform(lie.inverse(T), points)
    turn_rad = CELL_M / max(float(np.median(np.hypot(*points.T))), 10.0 * CELL_M)
    window = Window(T, 7.0 * CELL_M, 4.0 * turn_rad)
    answers = find(points, grid, window, Wanted(apart_m=0.7, rival=0.6, answers=4))
    left = every(grid, points, turn_rad, T, 7, 4)
    best = max(left.values())
    assert len(answers) > 1 or seed
    for found in answers:
        assert found.share == pytest.approx(max(left.values()))
        turn = round(float(lie.yaw(lie.between(T, found.T_target_source))) / turn_rad)
        x, y = np.round((found.T_target_source - T)[:2, 2] / CELL_M).astype(int).tolist()
        assert left[turn, x, y] == pytest.approx(found.share)
        left = {
            pose: share
            for pose, share in left.items()
            if abs(pose[0] - turn) * turn_rad >= 0.1 or max(abs(pose[1] - x), abs(pose[2] - y)) * CELL_M >= 0.7
        }
    assert len(answers) == 4 or max(left.values()) < 0.6 * best
    for least, count in ((best - 1e-6, 1), (best + 1e-6, 0)):
        assert len(find(points, grid, window, Wanted(1.0, 1.0, 1, least))) == count


@pytest.mark.parametrize("seed", range(4))
def test_anywhere_the_best_pose_with_room_is_found_however_few_steps_are_taken_at_once(seed, monkeypatch):
    grid, points, _ = scene(seed)
    wanted = Wanted(apart_m=1.0, rival=0.7, answers=4)
    at_once = find(points, grid, None, wanted)
    sliced, rounds = Search(points, grid, None, wanted), 0
    monkeypatch.setattr(search, "_STEPS", 7)
    sliced.headings = 5
    while not sliced.is_done:
        sliced.advance()
        rounds += 1
    assert rounds > 10 and [each.share for each in sliced.poses()] == [each.share for each in at_once]
    for one, other in zip(sliced.poses(), at_once, strict=True):
        assert np.array_equal(one.T_target_source, other.T_target_source)
    turns = len(sliced.cells)
    shares = [
        max(every(grid, points, sliced.turn_rad, T, 0, turns // 2).values())
        for x, y in grid.origin_m + CELL_M * (np.argwhere(grid.room.T) + 0.5)
        if (T := lie.pose_2d(x, y, (turns // 2) * sliced.turn_rad)) is not None
    ]
    assert at_once[0].share == pytest.approx(max(shares))
    column, row = np.floor((at_once[0].T_target_source[:2, 2] - grid.origin_m) / CELL_M).astype(int)
    assert grid.room[row, column]


def map_of(points):
    target = VoxelMap(2, LocalMapConfig(voxel_size_m=0.1))
    target.insert(points, lie.identity(2))
    return SearchGrid.of_voxels(target, lie.identity(2))


def test_a_scan_is_found_wherever_it_was_taken_however_it_is_turned():
    rng = np.random.default_rng(1)
    place = walls(rng, 20, 12.0)
    truth = lie.pose_2d(7.0, 3.0, 2.5)
    scan = lie.transform(lie.inverse(truth), place[np.linalg.norm(place - truth[:2, 2], axis=1) < 5.0])
    found = find(scan, map_of(place), Window(lie.identity(2), 10.0), Wanted(1.0, 0.8, 2))
    assert found[0].share > 0.7
    assert np.abs(lie.log(lie.inverse(truth) @ found[0].T_target_source)).max() < 0.15


def test_a_place_that_is_there_twice_has_a_rival_and_a_unique_one_has_none():
    rng = np.random.default_rng(2)
    room, other = walls(rng, 8, 4.0), walls(rng, 8, 4.0)
    for second, count in ((room, 2), (other, 1)):
        both = map_of(np.concatenate([room, second + np.array([6.0, 0.0])]))
        assert len(find(room, both, Window(lie.identity(2), 7.0, 0.2), Wanted(1.0, 0.9, 2))) == count


def test_in_an_empty_map_and_without_points_nothing_is_found():
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (30, 2))
    window, wanted = Window(lie.pose_2d(1.0, 2.0, 0.3), 1.0, 0.1), Wanted(1.0, 0.8, 2)
    assert not find(points, map_of(np.empty((0, 2))), window, wanted)
    assert not find(points, map_of(np.empty((0, 2))), None, wanted)
    assert not find(np.empty((0, 2)), map_of(points), window, wanted)


def test_columns_stand_on_walls_and_not_on_the_ground():
    ground, high = sloping_street(np.random.default_rng(3))
    columns = upright_columns(np.concatenate([ground, high]), 1.0)
    assert len(upright_columns(ground, 1.0)) == len(upright_columns(np.empty((0, 3)), 1.0)) == 0
    away_m = np.linalg.norm(columns[:, None] - high[None, :, :2], axis=2).min(axis=1)
    assert len(columns) > 100 and away_m.max() < 1.0
