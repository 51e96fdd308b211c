"""Maps joined in one frame, what objects to a join, and how far a joined map differs from the others."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie, load_settings
from scanchain.data import Closure, ClosureVerdict, Keyframe
from scanchain.loops.connectivity import Segments
from scanchain.loops.submaps import submap_around
from scanchain.maps import Edges, SavedPoints
from scanchain.odometry.odometry import first_match
from scanchain.sessions.joining import (
    Joined,
    UncertainJoin,
    changed,
    graph_of,
    join,
    join_all,
    objection_to,
    repeated_paths,
)  # fmt: skip
from tests.support.rooms import BOX, corridor, hall, map_of, part, room


def test_keyframes_held_as_one_pose_leave_the_cost_as_it_is(dimension):
    rng = np.random.default_rng(3)
    k = 3 if dimension == 2 else 6
    poses = lie.exp(rng.normal(0.0, 1.0, (7, k)))
    pairs = np.array([(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 1), (2, 5), (0, 6)])
    measured = lie.between(poses[pairs[:, 0]], poses[pairs[:, 1]]) @ lie.exp(rng.normal(0.0, 0.1, (9, k)))
    roots = rng.normal(0.0, 1.0, (9, k, k))
    information = roots @ np.swapaxes(roots, 1, 2) + np.eye(k)
    edges = Edges(pairs, measured, information, np.zeros(9, np.bool_), np.ones(9))
    keyframes = tuple(Keyframe(i, i, i, None, pose, float(i)) for i, pose in enumerate(poses))
    joined = Joined((0, 1), keyframes, np.array([0, 0, 0, 1, 1, 1, 1]), edges)
    held, whole = graph_of(joined, held=0), graph_of(joined)
    assert len(held) == 5
    inside = (pairs < 3).all(axis=1)
    assert np.allclose(held.state().edge_chi2, whole.state().edge_chi2[~inside], rtol=1e-9)


def _room(dimension, half_m):
    """A keyframe in the middle of a square room, or of a cube."""
    rays = np.random.default_rng(1).normal(size=(60_000, dimension))
    points = half_m * rays / np.abs(rays).max(axis=1, keepdims=True)
    return Keyframe(0, 0, 0, SavedPoints(points, 1.0), lie.identity(dimension), 0.0)


def test_a_map_that_differs_from_those_it_joined_by_more_than_they_do_in_themselves_is_told(dimension):
    def joined_with(half_m, others_m=(4.0, 4.0)):
        rooms = [_room(dimension, wide_m) for wide_m in (*others_m, half_m, half_m)]
        keyframes = tuple(replace(room, index=k, traveled_m=100.0 * k) for k, room in enumerate(rooms))
        return Joined((0, 1), keyframes, np.array([0, 0, 1, 1]), None)

    assert changed(joined_with(4.0)) == {}
    assert changed(joined_with(9.0))[1] > 0.3
    assert changed(joined_with(4.0, (4.0, 9.0))) == {}  # as much differs within a map


@pytest.mark.parametrize("repeats", [True, False])
def test_agreement_with_one_of_several_equal_places_is_no_evidence_for_a_join(repeats):
    depths_m = np.random.default_rng(4).uniform(1.0, 3.0, 60)
    if repeats:
        depths_m = np.tile(depths_m[:5], 12)
    path = [corridor(float(x_m), index, depths_m) for index, x_m in enumerate(np.arange(20.0, 38.0, 0.5))]
    count = len(path)
    pairs = np.column_stack([np.arange(count), np.arange(count, 2 * count)])
    eyes = np.tile(np.eye(3), (count, 1, 1))
    edges = Edges(pairs, eyes, eyes, np.ones(count, np.bool_), np.ones(count))
    keyframes = tuple(replace(each, index=k) for k, each in enumerate((*path, *path)))
    config = load_settings(2).config
    match = first_match(lie.identity(2), np.empty((0, 2)), config.matching)
    closures = tuple(Closure(i, j, match, 0.95, ClosureVerdict.ACCEPTED, "") for i, j in pairs.tolist())
    joined = Joined((0, 1), keyframes, np.repeat([0, 1], count), edges, closures)
    objection = objection_to(joined, count, config)
    assert ("also fit other locations" in objection) == bool(objection) == repeats
    few = replace(joined, edges=edges.where(pairs[:, 0] < 3))
    assert "short path" in objection_to(few, count, config)


@pytest.mark.parametrize("off_m", [0.0, 4.0])
def test_a_path_that_fits_the_host_elsewhere_than_where_it_was_joined_is_repeated(off_m):
    depths_m = np.random.default_rng(4).uniform(1.0, 3.0, 60)
    host = [corridor(float(x_m), index, depths_m) for index, x_m in enumerate(np.arange(20.0, 38.0, 1.0))]
    shift = lie.pose_2d(off_m, 0.0, 0.0)
    guest = [replace(each, T_odom_lidar=shift @ each.T_odom_lidar) for each in host]
    repeated, paths = repeated_paths(host, guest, np.arange(len(guest)), load_settings(2).config)
    assert paths > 2 and repeated == (paths if off_m else 0)


@pytest.mark.parametrize("held", [-1, 0])
def test_maps_of_one_room_join_and_that_of_another_stays_alone(tmp_path, held):
    T_map_room = lie.pose_2d(0.3, 0.2, 0.1), lie.pose_2d(40.0, -7.0, 2.0), lie.identity(2)
    solids = room(BOX), room(BOX), hall()
    maps = [map_of(tmp_path / n, part(n, *of, count=9)) for n, *of in zip("abc", solids, T_map_room, strict=True)]
    T = T_map_room[0] @ lie.inverse(T_map_room[1])
    config, alone = load_settings(2).config, [Joined.of(number, maps) for number in range(3)]
    assert join(alone[0], alone[2], config, held) is None
    both = join(alone[0], alone[1], config, held)
    assert both.maps == (0, 1) and both.of_map.tolist() == [0] * 9 + [1] * 9
    assert [each.index for each in both.keyframes] == list(range(18))
    assert np.abs(both.poses - np.concatenate([maps[0].poses, T @ maps[1].poses])).max() < 0.005
    assert np.array_equal(both.poses[:9], maps[0].poses) or held < 0
    for anchor in range(18):
        members = submap_around(both.keyframes, anchor, config.loops.place_radius_m, Segments()).members
        assert {each.index < 9 for each in members} == {anchor < 9}
    assert np.array_equal(
        both.edges.pairs[:16], np.delete(np.column_stack([np.arange(17), np.arange(1, 18)]), 8, 0)
    )
    assert both.is_between.sum() == len(
        [each for each in both.closures if each.verdict is ClosureVerdict.ACCEPTED]
    )
    groups, uncertain = join_all(maps, [0, 2, 1], "abc", config, held, lambda stage: None)
    assert objection_to(both, 9, config) == ""
    assert ([group.maps for group in groups], uncertain) == ([(0, 1), (2,)], [])


def test_an_uncertain_join_is_told_with_the_position_and_heading_of_the_session():
    found = UncertainJoin.of("noon", "evening", lie.pose_2d(1.26, -3.0, np.pi / 2), "a reason")
    assert (found.position_m, found.yaw_deg) == ((1.26, -3.0), 90.0)
    assert found.text == (
        "noon might begin at (1.3, -3.0) m, heading 90 deg, in the frame of evening; not certain: a reason"
    )
