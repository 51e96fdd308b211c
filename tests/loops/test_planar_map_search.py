"""Search of a whole planar map: two rooms that a wall in one of them tells apart."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Keyframe
from scanchain.kernels.search.branch_and_bound import fill_pyramid
from scanchain.kernels.search.whole_map import (
    FREE,
    NEAR,
    SURFACE,
    best_poses,
    find_room,
    interleave,
    score_cells,
    score_windows,
    turned,
)
from scanchain.loops import planar_map_search
from scanchain.loops.planar_map_search import PlanarMapSearch, WholeSearch
from tests.support.scenes import stored

CENTERS = (lie.pose_2d(0.0, 0.0, 0.0), lie.pose_2d(30.0, 0.0, 0.0))
T_ROOM_LIDAR = lie.pose_2d(0.7, -0.4, 1.1)


def room(with_pillar):
    """Returns of a lidar in a room of 8 m x 6 m, with or without a pillar ahead."""
    angles = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    x, y = np.maximum(np.abs(directions), 1e-9).T
    ranges = np.minimum(
        np.where(directions[:, 0] > 0.0, 5.0, 3.0) / x, np.where(directions[:, 1] > 0.0, 2.0, 4.0) / y
    )
    ranges[np.abs(angles - 2.2) < 0.4] = 1.5  # a rectangle alone looks the same turned around
    if with_pillar:
        ranges[np.abs(angles + 0.6) < 0.4] = 2.0
    return ranges[:, None] * directions


def rooms(pillars):
    """The search in a map of a room with and one without a pillar, each seen twice: once may be by mistake."""
    poses = np.repeat(CENTERS, 2, axis=0)
    clouds = [stored(room(pillar)) for pillar in np.repeat(pillars, 2)]
    keyframes = [Keyframe(k, k, k, cloud, poses[k], 30.0 * k) for k, cloud in enumerate(clouds)]
    return PlanarMapSearch(keyframes, poses, 0.1)


def seen(with_pillar):
    return lie.transform(lie.inverse(T_ROOM_LIDAR), room(with_pillar))


@pytest.mark.parametrize("which", [0, 1])
def test_free_space_tells_rooms_apart_that_have_the_same_walls(which):
    best = rooms([True, False]).best(seen(with_pillar=which == 0), 0.3)
    off_m, off_rad = lie.apart(CENTERS[which] @ T_ROOM_LIDAR, best.T_map_lidar)
    assert off_m < 0.1 and off_rad < 0.03
    assert best.share > 0.9
    assert best.rival < 0.95 * best.share


def test_two_identical_rooms_rival_each_other():
    best = rooms([True, True]).best(seen(with_pillar=True), 0.3)
    assert best.rival > 0.95 * best.share


def test_a_search_in_slices_finds_what_one_at_once_does(monkeypatch):
    target, points = rooms([True, False]), seen(with_pillar=True)
    at_once = WholeSearch(target, points, 0.3)
    at_once.advance()
    assert at_once.is_done
    monkeypatch.setattr(planar_map_search, "_ADDITIONS", 20_000_000)
    sliced = WholeSearch(target, points, 0.3)
    sliced.advance()
    assert not sliced.is_done
    while not sliced.is_done:
        sliced.advance()
    one, other = at_once.best(), sliced.best()
    assert (one.T_map_lidar == other.T_map_lidar).all()
    assert (one.share, one.rival, one.points) == (other.share, other.rival, other.points)


def test_a_room_of_another_shape_is_nowhere():
    circle = np.stack([np.cos(a := np.linspace(-np.pi, np.pi, 720)), np.sin(a)], axis=1)
    assert rooms([True, False]).best(1.7 * circle, 0.3) is None


def test_the_search_finds_the_best_of_all_poses_with_the_lidar_in_free_space():
    rng = np.random.default_rng(3)
    log_odds = np.zeros((60, 50))
    log_odds[20:55, 10:45] = rng.choice([-1.0, 0.0, 1.0], (35, 35), p=[0.7, 0.2, 0.1])
    cells = np.zeros(log_odds.shape, np.int8)
    score_cells(log_odds, 0.5, cells)
    pyramid = np.zeros((4, *cells.shape), np.int8)
    pyramid[0] = cells
    fill_pyramid(pyramid)
    points, turns = rng.uniform(-1.0, 1.0, (40, 2)), 12
    spans = np.empty((15, 2), np.int64)
    has_room = find_room(cells, 2, spans)
    of_points, blocks = turned(points, 0.1, turns), interleave(pyramid[2], 2)
    windows = [score_windows(blocks, 2, has_room, spans, of_points[k : k + 5], k, 0.0) for k in range(0, turns, 5)]
    found = best_poses(pyramid, of_points, np.vstack(windows), 0.1, 0.0, 0.9, 0.5, 1)
    scores = {}
    for turn in range(turns):
        c, s = np.cos(2.0 * np.pi * turn / turns), np.sin(2.0 * np.pi * turn / turns)
        shifts = np.floor(points @ np.array([[c, s], [-s, c]]) / 0.1 + 0.5).astype(int)
        for row, column in np.argwhere((cells == FREE) | (cells == NEAR)).tolist():
            x, y = shifts[:, 0] + column, shifts[:, 1] + row
            inside = (x >= 0) & (y >= 0) & (x < 50) & (y < 60)
            scores[column, row, turn] = int(cells[y[inside], x[inside]].sum(dtype=int))
    best = max(scores.values())
    assert 0 < best < SURFACE * len(points)
    assert found[0, 3] == best == scores[tuple(found[0, :3].astype(int))]
