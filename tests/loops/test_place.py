"""Place recognition in 3D: outlines of submaps, and submaps that agree or do not."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import ClosureVerdict, Keyframe, Proposal
from scanchain.kernels.free_space import FAR, compare_ranges, nearest_ranges
from scanchain.loops import LoopCloser, outline_of
from scanchain.loops.connectivity import Segments
from scanchain.loops.recognizer import Query
from scanchain.loops.submaps import VoxelSubmaps, level_frame, submap_around
from scanchain.loops.upright_search import PLACES_FILE, OutlineRecognizer, UprightMap
from scanchain.loops.verification import Verifier, free_space_agreement
from scanchain.registration import VoxelMap
from scanchain.simulation import plan
from scanchain.simulation.sensors import take_sweep
from tests.support import graphs, naive
from tests.support.scenes import configured, stored

RADIUS_M = 32.0


def pose(x=0.0, y=0.0, z=0.0, yaw=0.0, pitch=0.0):
    return (
        lie.exp(np.array([x, y, z, 0, 0, 0.0]))
        @ lie.exp(np.array([0, 0, 0, 0, 0, yaw]))
        @ lie.exp(np.array([0, 0, 0, 0, pitch, 0.0]))
    )


@cache
def drive():
    return plan("rounds", seed=3, sensor="vlp-16", duration_s=5.0)


def scan_from(x, y, yaw, seed=0):
    """Points (N, 3) of a lidar that stands still in the town, and its true pose."""
    solids, sensor = drive().solids, drive().sensor
    height = float(solids.ground_height(np.array([x, y]))) + 1.73
    T = pose(x, y, height, yaw)

    class Standing:
        def lidar(self, times_s):
            return np.repeat(T[None], len(times_s), axis=0)

    sweep = take_sweep(solids, Standing(), sensor, 0, 0.0, np.random.default_rng(seed))
    return sweep.points().astype(np.float64), T


def passage(places, first_index=0, traveled_m=0.0):
    """Keyframes along places (x, y, yaw), as odometry without drift has them."""
    keyframes = []
    for k, (x, y, yaw) in enumerate(places):
        points, T = scan_from(x, y, yaw, seed=first_index + k)
        if keyframes:
            traveled_m += float(np.linalg.norm((T - keyframes[-1].T_odom_lidar)[:3, 3]))
        index = first_index + k
        keyframes.append(Keyframe(index, index, index, stored(points), T, traveled_m))
    return keyframes


@cache
def street(offset_m=0.0, backwards=False):
    """A drive of 60 m along one street, so far aside of its lane, perhaps the other way."""
    along = np.arange(20.0, 80.1, 4.0)
    if backwards:
        return tuple((x, -2.0 + offset_m, np.pi) for x in along[::-1])
    return tuple((x, -2.0 + offset_m, 0.0) for x in along)


@cache
def place_in_the_middle(offset_m=0.0, backwards=False):
    """Submap around the middle of that drive."""
    keyframes = passage(street(offset_m, backwards))
    return submap_around(keyframes, len(keyframes) // 2, RADIUS_M, Segments())


@pytest.mark.parametrize("seed", range(3))
def test_ranges_compare_as_the_naive_ones(seed):
    rng = np.random.default_rng(seed)
    seen = rng.normal(0.0, 8.0, (2000, 3))
    points = seen[::3] * rng.uniform(0.5, 1.2, (len(seen[::3]), 1))
    T = pose(0.1, 0.2, 0.0, yaw=0.02)
    ranges_m = np.empty((20, 40))
    nearest_ranges(seen, ranges_m)
    found = compare_ranges(points, T, ranges_m, 0.5, 0.05)
    assert found == naive.agreement(seen, points, T, ranges_m.shape, 0.5, 0.05)
    assert min(found) > 20


def test_where_nothing_was_seen_nothing_is_said():
    ranges_m = np.empty((10, 20))
    nearest_ranges(np.empty((0, 3)), ranges_m)
    assert np.all(ranges_m == FAR)
    assert compare_ranges(np.ones((5, 3)), lie.identity(3), ranges_m, 0.5, 0.0) == (0, 0)
    assert compare_ranges(np.zeros((1, 3)), lie.identity(3), ranges_m, 0.5, 0.0) == (0, 0)


def proposed(first, second, T_first_second):
    """Candidates for a submap, passed 500 m after another one, which it is expected at this pose of."""
    recognizer = OutlineRecognizer(configured(3), 3)
    anchors = [replace(each.anchor, index=k, traveled_m=500.0 * k) for k, each in enumerate((first, second))]
    for anchor, each in zip(anchors, (first, second), strict=True):
        recognizer.add(replace(each, anchor=anchor))
    T_world = np.array([lie.identity(3), T_first_second])
    return recognizer.query(Query(replace(second, anchor=anchors[1]), 100.0, T_first_second, anchors, T_world))


@pytest.mark.parametrize(("offset_m", "backwards"), [(0.0, False), (4.0, False), (4.0, True), (0.0, True)])
@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (9.0, -6.0, 0.1), (-25.0, 30.0, -0.3)])
def test_a_place_is_known_again_from_the_other_lane_and_the_other_way(offset_m, backwards, off):
    first, second = place_in_the_middle(), place_in_the_middle(offset_m, backwards)
    truth = lie.inverse(first.anchor.T_odom_lidar) @ second.anchor.T_odom_lidar
    x, y, yaw = off
    best = proposed(first, second, pose(x, y, yaw=yaw) @ truth)[0]
    error = lie.inverse(truth) @ best.T_target_source
    assert best.score > 0.5 and best.rival < 0
    assert best.proposed_by is (Proposal.POSITION if np.hypot(x, y) < 15.0 else Proposal.PLACE)
    assert np.linalg.norm(error[:2, 3]) < 1.0 and lie.rotation_angle(error) < 0.1


def test_a_place_farther_off_than_odometry_drifts_is_not_proposed():
    first, second = place_in_the_middle(), place_in_the_middle(4.0)
    assert proposed(first, second, pose(150.0, 0.0)) == []
    assert proposed(first, second, pose(yaw=2.0)) == []


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.35, 0.0), (-0.2, 0.25)])
def test_up_is_where_the_ground_says_whatever_the_lidars_tilt(pitch, roll):
    points, _ = scan_from(50.0, -2.0, 0.3)
    T_level_tilted = lie.exp(np.array([0, 0, 0, roll, pitch, 0.0]))
    tilted = lie.transform(lie.inverse(T_level_tilted), points)
    T = level_frame(Keyframe(0, 0, 0, stored(tilted), lie.identity(3), 0.0), configured(3).local_map)
    up = (T_level_tilted @ T)[:3, 2]
    assert np.arccos(up[2]) < 0.05
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_submaps_of_one_place_agree_and_those_of_two_do_not():
    here = place_in_the_middle()
    again = place_in_the_middle(4.0, True)
    truth = lie.inverse(here.anchor.T_odom_lidar) @ again.anchor.T_odom_lidar
    true = Verifier(configured(3)).submap(again, here, truth @ pose(1.0, -0.8, yaw=0.06))
    error = lie.inverse(truth) @ true.match.T_target_source
    assert true.match.converged and true.overlap > 0.6 and true.agreement > 0.9
    assert np.linalg.norm(error[:3, 3]) < 0.1 and lie.rotation_angle(error) < 0.005
    false = Verifier(configured(3)).submap(again, here, truth @ pose(0.0, 9.0))
    assert false.agreement < 0.87


def test_a_wall_in_what_was_seen_as_free_is_held_against_a_match():
    here = place_in_the_middle()
    wall = np.stack(np.meshgrid([6.0], np.linspace(-3, 3, 40), np.linspace(-1, 2, 20)), axis=-1).reshape(-1, 3)
    own = here.points()[::20]
    assert free_space_agreement(here, own, lie.identity(3), 1.0) > 0.75
    assert free_space_agreement(here, wall, lie.identity(3), 1.0) < 0.2


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_a_submap_has_the_voxels_that_odometry_used_there(scale):
    points, T = scan_from(50.0, -2.0, 0.0)
    submaps = VoxelSubmaps(3, 5, configured(3).local_map, Segments())
    submap = submaps.around(0, [Keyframe(0, 0, 0, stored(points), T, 0.0, scale)], 0)
    assert submap.voxels.size_m == scale * configured(3).local_map.voxel_size_m


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


@cache
def there_and_back(lost_m=0.0):
    """Keyframes of a street, and of it again the other way after a detour, odometry so far off."""
    there = passage(street())
    back = passage(street(4.0, True), len(there), there[-1].traveled_m + 120.0)
    shift = pose(lost_m, 0.5 * lost_m, yaw=0.02 * lost_m)
    moved = [
        Keyframe(k.index, k.scan_index, k.stamp_ns, k.stored, shift @ k.T_odom_lidar, k.traveled_m) for k in back
    ]
    return [*there, *moved], [k.T_odom_lidar for k in (*there, *back)]


def graph_of(keyframes, sigma_rad=0.002):
    """The graph of odometry alone, a keyframe's heading known from the one before with so much."""
    poses = np.array([keyframe.T_odom_lidar for keyframe in keyframes])
    information = np.diag(np.array([0.02, 0.02, 0.02, 0.002, 0.002, sigma_rad]) ** -2.0)
    edges = [*pairwise(range(len(keyframes)))]
    return graphs.graph_of(poses, edges, lie.between(poses[:-1], poses[1:]), information)


@pytest.mark.parametrize("lost_m", [0.0, 8.0])
def test_a_street_driven_the_other_way_is_recognized_wherever_odometry_has_it(lost_m):
    keyframes, truth = there_and_back(lost_m)
    closer = LoopCloser(configured(3), 3).places
    accepted = [
        closure
        for k in range(1, len(keyframes) + 1)
        for closure in closer.close(
            keyframes[:k], graph_of(keyframes[:k]), np.ones(k, bool), finish=k == len(keyframes)
        )
        if closure.verdict is ClosureVerdict.ACCEPTED
    ]
    assert len(accepted) >= 3
    for closure in accepted:
        true = lie.inverse(truth[closure.target]) @ truth[closure.source]
        assert np.linalg.norm((lie.inverse(true) @ closure.match.T_target_source)[:3, 3]) < 0.2


@pytest.mark.parametrize(("sigma_rad", "are_refused"), [(0.002, True), (0.2, False)])
def test_a_place_is_refused_that_odometry_cannot_have_missed_by_so_much(monkeypatch, sigma_rad, are_refused):
    monkeypatch.setattr("scanchain.loops.recognizer._PLACE_DRIFT", 0.001)
    keyframes, _ = there_and_back(8.0)
    closures = LoopCloser(configured(3), 3).places.close(
        keyframes, graph_of(keyframes, sigma_rad), np.ones(len(keyframes), bool), finish=True
    )
    assert closures and all("of the path between" in closure.reason for closure in closures) == are_refused


# --- in a map, from nowhere --------------------------------------------------------------------------------------

T_ODOM_WORLD = pose(500.0, -300.0, 20.0, yaw=2.0)


def sought(mapped, log, folder):
    """Closures of each keyframe of a log in a map, and its true poses; odometry begins elsewhere."""
    first, gone_m = len(mapped), mapped[-1].traveled_m + 500.0
    closer = LoopCloser(configured(3), 3)
    closer.add_map(mapped, folder)
    closer.start_segment(first)
    moved = [
        replace(k, index=first + n, T_odom_lidar=T_ODOM_WORLD @ k.T_odom_lidar, traveled_m=gone_m + k.traveled_m)
        for n, k in enumerate(log)
    ]
    keyframes = [*mapped, *moved]
    closures = [
        closer.close(keyframes[:end], graph_of(keyframes[:end])) for end in range(first + 1, len(keyframes) + 1)
    ]
    return closures, [k.T_odom_lidar for k in (*mapped, *log)]


def begun_live(mapped, seen, folder):
    """A live search in a map before its first keyframe, and the keyframes up to that one."""
    closer = LoopCloser(configured(3), 3, is_live=True)
    closer.add_map(mapped, folder)
    closer.start_segment(len(mapped))
    T_odom_lidar = T_ODOM_WORLD @ seen.T_odom_lidar
    return closer, [*mapped, replace(seen, index=len(mapped), T_odom_lidar=T_odom_lidar, traveled_m=10_000.0)]


def accepted_of(closures):
    return [closure for closure in closures if closure.verdict is ClosureVerdict.ACCEPTED]


def test_a_log_is_found_in_a_map_by_keyframes_that_say_the_same(tmp_path):
    closures, truth = sought(passage(street()), passage(street(4.0, True)[4:6]), tmp_path)
    assert [len(accepted_of(found)) for found in closures] == [1, 1]
    for closure in sum(closures, ()):
        true = lie.inverse(truth[closure.target]) @ truth[closure.source]
        assert np.linalg.norm((lie.inverse(true) @ closure.match.T_target_source)[:3, 3]) < 0.2


def test_a_search_over_many_scans_finds_what_one_in_a_single_scan_finds(tmp_path, monkeypatch):
    mapped, log = passage(street()), passage(street(4.0, True)[4:5])
    (at_once,), _ = sought(mapped, log, tmp_path)
    monkeypatch.setattr("scanchain.registration.search._STEPS", 500)
    closer, keyframes = begun_live(mapped, log[0], tmp_path)
    found, scans = closer.close(keyframes, graph_of(keyframes)), 1
    while closer.search.underway is not None:
        found, scans = closer.advance(), scans + 1
    assert scans > 3 and [each.target for each in found] == [each.target for each in at_once]
    np.testing.assert_array_equal(found[0].match.T_target_source, at_once[0].match.T_target_source)


def test_a_search_that_the_end_of_the_log_interrupts_is_completed(tmp_path, monkeypatch):
    monkeypatch.setattr("scanchain.registration.search._STEPS", 500)
    mapped, log = passage(street()), passage(street(4.0, True)[4:5])
    closer, keyframes = begun_live(mapped, log[0], tmp_path)
    assert not closer.close(keyframes, graph_of(keyframes)) and closer.search.underway is not None
    assert closer.finish(keyframes, graph_of(keyframes)) and closer.search.underway is None


def test_a_log_of_elsewhere_is_found_nowhere_in_a_map(tmp_path):
    elsewhere = tuple((0.0, y, 0.5 * np.pi) for y in np.arange(-30.0, -9.0, 4.0))
    closures, _ = sought(passage(street()[4:]), passage(elsewhere), tmp_path)
    assert not accepted_of(sum(closures, ()))


def test_of_two_places_that_are_the_same_none_is_said_to_be_it(tmp_path):
    there = passage(street())
    T, count, gone_m = pose(200.0, yaw=1.0), len(there), there[-1].traveled_m + 500.0
    again = [
        replace(k, index=count + k.index, T_odom_lidar=T @ k.T_odom_lidar, traveled_m=gone_m + k.traveled_m)
        for k in there
    ]
    closures, _ = sought([*there, *again], passage(street(4.0, True)[4:7]), tmp_path)
    reasons = {closure.reason for closure in sum(closures, ())}
    assert reasons == {"another location in the map is as similar"}
    assert UprightMap([*there, *again], configured(3)).is_repeated(there[1:11])
    assert not UprightMap(there, configured(3)).is_repeated(there[1:11])


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_the_outline_of_a_map_is_kept_beside_it_and_made_anew_where_it_is_damaged(tmp_path, tilt):
    there = [replace(k, T_odom_lidar=pose(pitch=tilt) @ k.T_odom_lidar) for k in passage(street()[::4])]
    made = outline_of(tmp_path, there, configured(3).local_map)
    kept = outline_of(tmp_path, [replace(k, stored=None) for k in there], configured(3).local_map)
    assert np.array_equal(kept.columns, made.columns) and np.array_equal(kept.T_map_level, made.T_map_level)
    assert np.degrees(np.arccos((pose(pitch=tilt).T @ made.T_map_level)[2, 2])) < 2.0
    assert len(made.columns) > 300
    (tmp_path / PLACES_FILE).write_bytes((tmp_path / PLACES_FILE).read_bytes()[:-100])
    assert np.array_equal(outline_of(tmp_path, there, configured(3).local_map).columns, made.columns)
    assert len(outline_of(tmp_path, there[1:], configured(3).local_map).columns) < len(made.columns)
