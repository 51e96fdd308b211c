"""Alignment of a map to another, which stays where it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scanchain import InputError, lie, load_settings
from scanchain.data import Keyframe
from scanchain.maps import Edges, SavedPoints, write_saved_map
from scanchain.sessions.alignment import _information, align_maps, opened_maps
from scanchain.sessions.changes import Part
from tests.support.rooms import BOX, hall, map_of, part, room, saved
from tests.support.scenes import configured
from tests.support.town import passage, pose, street


def test_the_keyframes_of_a_map_are_found_in_another_of_the_same_room():
    T = lie.pose_2d(2.0, -1.0, 1.0)
    target = map_of(Path("a"), part("a", room(BOX), count=12))
    source = map_of(Path("b"), part("b", room(BOX), lie.inverse(T), count=9))
    found = align_maps(target, source, load_settings(2).config)
    true = T @ source.poses
    assert found.is_found and found.loops == len(found.accepted) == 9
    assert max(lie.apart(*pair)[0] for pair in zip(found.poses, true, strict=True)) < 0.002
    for closure in found.accepted:
        T_target_source = lie.between(target.poses[closure.target], true[closure.source - 12])
        assert lie.apart(closure.match.T_target_source, T_target_source)[0] < 0.01


def test_the_keyframes_of_a_map_in_space_are_found_in_another_of_the_same_street():
    T = pose(500.0, -300.0, 20.0, yaw=2.0, pitch=0.1)
    there, back = passage(street()), passage(street(4.0, True)[4:8])
    true = np.array([each.T_odom_lidar for each in back])
    moved = [replace(each, T_odom_lidar=lie.inverse(T) @ each.T_odom_lidar) for each in back]
    target, source = (map_of(Path("map"), Part("street", path, np.empty(0))) for path in (there, moved))
    found = align_maps(target, source, load_settings(3).config)
    assert found.is_found and found.loops == len(found.accepted) == 4
    off_m, off_rad = zip(*(lie.apart(*pair) for pair in zip(found.poses, true, strict=True)), strict=True)
    assert max(off_m) < 0.02 and max(off_rad) < 0.002
    for closure in found.accepted:
        T_target_source = lie.between(target.poses[closure.target], true[closure.source - 16])
        assert lie.apart(closure.match.T_target_source, T_target_source)[0] < 0.05


def test_a_motion_costs_the_same_walked_backward_and_loops_of_the_map_are_none(dimension):
    rng, count, k = np.random.default_rng(0), 6, 3 * dimension - 3
    keyframes = [Keyframe(n, n, n, None, lie.exp(rng.normal(size=k)), 1.0 * n) for n in range(count)]
    pairs, roots = np.column_stack([np.arange(count - 1), np.arange(1, count)]), rng.normal(size=(count - 1, k, k))
    information = 1e3 * (roots @ np.swapaxes(roots, 1, 2) + np.eye(k))
    T = np.array([each.T_odom_lidar for each in keyframes])
    Z = lie.between(T[:-1], T[1:])
    odometry = Edges(pairs, Z, information, np.zeros(count - 1, bool), np.ones(count - 1))
    loops = replace(odometry, information=1e6 * information, is_loop=np.ones(count - 1, bool))
    config = configured(dimension, {"odometry.edge_sigma_m": 3e-4, "odometry.edge_sigma_rad": 3e-4})
    edges = Edges.chained(odometry, loops)
    of = [_information(keyframes, edges, order, config) for order in (range(6), range(5, -1, -1))]
    forward, backward = of[0][1:], of[1][:0:-1]
    np.testing.assert_allclose(forward, information, rtol=0.05, atol=0.01 * information.max())
    twists = 1e-3 * rng.normal(size=(count - 1, k))
    ahead = lie.log(lie.between(Z, lie.inverse(lie.inverse(Z) @ lie.exp(twists))))
    costs = [np.einsum("ea,eab,eb->e", e, omega, e) for e, omega in ((ahead, forward), (twists, backward))]
    np.testing.assert_allclose(*costs, rtol=0.05)


def test_a_path_that_is_found_late_is_matched_back_to_its_start():
    target = map_of(Path("a"), part("a", room(BOX), count=12))
    seen, away = part("b", room(BOX), count=12), part("b", hall(), lie.pose_2d(30.0, 0.0, 0.0), count=12)
    path = [*seen.keyframes[:2], *away.keyframes, *seen.keyframes[2:]]
    keyframes = [replace(each, index=k, scan_index=k, traveled_m=3.0 * k) for k, each in enumerate(path)]
    poses = np.array([each.T_odom_lidar for each in keyframes])
    found = align_maps(target, map_of(Path("b"), Part("b", keyframes, poses)), load_settings(2).config)
    assert sorted(each.source - 12 for each in found.accepted) == [0, 1, *range(14, 24)]
    assert found.loops == len(found.accepted)  # each once, though two walks begin at the keyframe that was found
    assert max(lie.apart(*pair)[0] for pair in zip(found.poses, poses, strict=True)) < 0.01


def test_a_map_of_another_place_is_not_found():
    target, source = map_of(Path("a"), part("a", room(BOX))), map_of(Path("b"), part("b", hall()))
    with pytest.raises(InputError, match="b: is not found in a "):
        align_maps(target, source, load_settings(2).config)


def test_maps_of_the_plane_and_of_space_are_refused(tmp_path):
    plane = saved(tmp_path / "plane", part("plane", room()))
    flat = map_of(tmp_path, part("space", room(), count=1))
    (seen,) = flat.keyframes
    lifted = replace(seen, stored=SavedPoints(lie.lift_points(seen.points), 1.0), T_odom_lidar=np.eye(4))
    edges = Edges(flat.edges.pairs, np.empty((0, 4, 4)), np.empty((0, 6, 6)), np.empty(0, bool), np.empty(0))
    write_saved_map(
        replace(flat, folder=tmp_path / "space" / "map", dimension=3, keyframes=(lifted,), edges=edges)
    )
    with pytest.raises(InputError, match=r"space: is a 3D map, .*plane a 2D one"):
        opened_maps([plane, tmp_path / "space"], tmp_path / "out")
