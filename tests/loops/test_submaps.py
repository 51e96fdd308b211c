"""Submaps: which keyframes they hold, their voxels, and the vertical direction in them."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Keyframe
from scanchain.loops.connectivity import Segments
from scanchain.loops.submaps import VoxelSubmaps, level_frame, submap_around
from scanchain.registration import VoxelMap
from tests.support.scenes import configured, stored
from tests.support.town import passage, scan_from, street


def test_a_submap_holds_keyframes_of_its_own_segment_alone():
    points = np.array([[1.0, 0.0], [1.0, 0.05], [1.0, 0.1]])
    keyframes = [Keyframe(k, k, k, stored(points), lie.pose_2d(10.0 * k, 0.0, 0.0), 1.0 * k) for k in range(8)]
    segments = Segments()
    whole = VoxelSubmaps(2, 5, configured(2).local_map, segments).around(5, keyframes, 7)
    early = VoxelSubmaps(2, 5, configured(2).local_map, segments).around(5, keyframes, 6)
    segments.start(4)
    part = VoxelSubmaps(2, 5, configured(2).local_map, segments).around(5, keyframes, 7)
    assert np.ptp(whole.points()[:, 0]) == pytest.approx(70.0)
    assert np.ptp(early.points()[:, 0]) == pytest.approx(60.0)
    assert np.ptp(part.points()[:, 0]) == pytest.approx(30.0)


@pytest.mark.parametrize("anchor", [38, 52])
def test_a_submap_holds_what_was_passed_within_its_radii_and_its_points_lie_within_one(anchor):
    rng = np.random.default_rng(0)
    clouds = [rng.normal(0.0, 20.0, (200, 2)) for _ in range(60)]
    keyframes = [
        Keyframe(k, k, k, stored(cloud), lie.pose_2d(0.7 * k, 0.0, 0.1 * k), 0.7 * k)
        for k, cloud in enumerate(clouds)
    ]
    segments = Segments()
    segments.start(20)
    submap = submap_around(keyframes, anchor, 10.0, segments)
    assert [each.index for each in submap.members] == [
        k for k in range(20, 60) if -20.0 <= 0.7 * (k - anchor) < 10.0
    ]
    T_anchor_odom = lie.inverse(keyframes[anchor].T_odom_lidar)
    seen = np.vstack([lie.transform(T_anchor_odom @ each.T_odom_lidar, each.points) for each in submap.members])
    np.testing.assert_allclose(submap.points(), seen[np.linalg.norm(seen, axis=1) < 10.0], atol=1e-9)


def test_a_submap_is_anchored_in_the_segment_of_its_keyframe():
    segments = Segments()
    segments.start(7)
    submaps = VoxelSubmaps(2, 5, configured(2).local_map, segments)
    assert [submaps.anchor_of(k) for k in (0, 4, 6, 7, 9, 10, 14)] == [0, 0, 5, 7, 7, 10, 10]


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_a_submap_has_the_voxels_that_odometry_used_there(scale):
    points, T = scan_from(50.0, -2.0, 0.0)
    submaps = VoxelSubmaps(3, 5, configured(3).local_map, Segments())
    submap = submaps.around(0, [Keyframe(0, 0, 0, stored(points), T, 0.0, scale)], 0)
    assert submap.voxels.size_m == scale * configured(3).local_map.voxel_size_m


def test_a_submap_of_a_map_has_twice_as_many_keyframes_the_nearest_ones_of_any_pass():
    positions = np.array([(1.0 * (k % 30), 3.3 * (k // 30)) for k in range(60)])
    points = np.array([[0.0, 0.0], [0.0, 0.01], [0.01, 0.0]])
    keyframes = [
        Keyframe(k, k, k, stored(points), lie.pose_2d(*xy, 0.0), 1.0 * k) for k, xy in enumerate(positions + 0.02)
    ]
    submaps = VoxelSubmaps(2, 5, configured(2).local_map, Segments())
    submaps.add_map(keyframes)
    seen = np.round(submaps.around(10, keyframes, 59).points() + positions[10], 1)
    nearest = np.argsort(np.linalg.norm(positions - positions[10], axis=1), kind="stable")[:22]
    assert sorted(map(tuple, seen)) == sorted(map(tuple, positions[nearest]))
    assert submaps.around(10, keyframes, 12) is submaps.around(10, keyframes, 59)  # whatever is newest


def test_a_submap_of_a_map_in_space_holds_every_second_one_of_its_keyframes():
    cloud = stored(np.random.default_rng(0).uniform(0.1, 0.4, (9, 3)))
    keyframes = [Keyframe(k, k, k, cloud, lie.lift(lie.pose_2d(1.0 * k, 0.0, 0.0)), 1.0 * k) for k in range(60)]
    submaps = VoxelSubmaps(3, 5, configured(3).local_map, Segments())
    submaps.add_map(keyframes)
    x_m = np.sort(submaps.around(30, keyframes, 59).points()[:, 0])
    assert len(x_m) == 11 and np.allclose(np.diff(x_m), 2.0) and -11.0 < x_m[0] < -9.0


def test_submaps_that_were_used_last_are_kept():
    points = stored(np.array([[0.0, 0.0], [0.0, 0.01], [0.01, 0.0]]))
    keyframes = [Keyframe(k, k, k, points, lie.pose_2d(1.0 * k, 0.0, 0.0), 1.0 * k) for k in range(350)]
    submaps = VoxelSubmaps(2, 5, configured(2).local_map, Segments())
    made = {anchor: submaps.around(anchor, keyframes, 349) for anchor in range(0, 350, 5)}
    assert all(submaps.around(anchor, keyframes, 349) is made[anchor] for anchor in range(300, 350, 5))


def test_a_submap_of_a_map_takes_no_more_memory_than_its_voxels():
    keyframes = passage(street())
    submaps = VoxelSubmaps(3, 5, configured(3).local_map, Segments())
    submaps.add_map(keyframes)
    submap = submaps.around(5, keyframes, 10)
    assert len(submap) <= len(submap.voxels.cells) < max(2 * len(submap), 4097)
    loose = VoxelMap(3, configured(3).local_map)
    for keyframe in keyframes[:3]:
        loose.insert(keyframe.points, keyframe.T_odom_lidar)
    before, rows = loose.voxels, len(loose)
    loose.compact()
    assert len(loose.voxels.cells) < len(before.cells)
    for name in ("keys", "moments", "cells", "history"):
        np.testing.assert_array_equal(getattr(loose.voxels, name)[:rows], getattr(before, name)[:rows])


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.35, 0.0), (-0.2, 0.25)])
def test_up_is_where_the_ground_says_whatever_the_lidars_tilt(pitch, roll):
    points, _ = scan_from(50.0, -2.0, 0.3)
    T_level_tilted = lie.exp(np.array([0, 0, 0, roll, pitch, 0.0]))
    tilted = lie.transform(lie.inverse(T_level_tilted), points)
    T = level_frame(Keyframe(0, 0, 0, stored(tilted), lie.identity(3), 0.0), configured(3).local_map)
    up = (T_level_tilted @ T)[:3, 2]
    assert np.arccos(up[2]) < 0.05
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
