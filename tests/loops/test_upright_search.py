"""Place recognition in 3D by upright structure: of submaps within the drift, and in a map, from nowhere."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import ClosureVerdict, Keyframe, Proposal
from scanchain.loops import LoopCloser, outline_of
from scanchain.loops.place_search import completed
from scanchain.loops.recognizer import Query
from scanchain.loops.upright_search import PLACES_FILE, OutlineRecognizer, UprightMap
from tests.support.scenes import configured, stored
from tests.support.town import blocked, graph_of, passage, place_in_the_middle, pose, street


def proposed(first, second, T_first_second):
    """Candidates for a submap, passed 500 m after another one, which it is expected at this pose of."""
    recognizer = OutlineRecognizer(configured(3), 3)
    anchors = [replace(each.anchor, index=k, traveled_m=500.0 * k) for k, each in enumerate((first, second))]
    for anchor, each in zip(anchors, (first, second), strict=True):
        recognizer.add(replace(each, anchor=anchor))
    T_world = np.array([lie.identity(3), T_first_second])
    return recognizer.query(Query(replace(second, anchor=anchors[1]), 100.0, T_first_second, anchors, T_world))


@pytest.mark.parametrize(("offset_m", "backwards"), [(0.0, False), (4.0, False), (4.0, True), (0.0, True)])
@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (9.0, -6.0, 0.1), (-25.0, 30.0, -0.3), (5.0, 0.0, 0.45)])
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


@pytest.mark.parametrize("off_m", [0.0, 40.0])
def test_far_from_the_expected_pose_a_place_that_is_also_elsewhere_is_ambiguous(off_m):
    here, recognizer = place_in_the_middle(), OutlineRecognizer(configured(3), 3)
    anchors = [replace(here.anchor, index=k, traveled_m=500.0 * k) for k in range(3)]
    for anchor in anchors:
        recognizer.add(replace(here, anchor=anchor))
    T_world = np.array([pose(), pose(60.0, 40.0), pose(off_m)])
    best = recognizer.query(Query(replace(here, anchor=anchors[2]), 500.0, T_world[2], anchors, T_world))[0]
    assert best.score > 0.9 and best.rival == (1 - best.target if off_m else -1)


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


@pytest.mark.parametrize(("count", "width_m", "verdict"), [(30, 5.0, "accepted"), (30, 10.0, "rejected")])
def test_a_map_of_another_day_may_differ_but_not_in_most_of_what_it_shows(count, width_m, verdict):
    log = blocked(passage(street(4.0, True)[4:8]), count, width_m)
    closure = completed(UprightMap(passage(street()), configured(3)).found(log))
    assert closure.verdict.value == verdict


def test_a_level_pose_is_on_the_ground_of_the_nearest_keyframe_of_each_story():
    """A lidar 2 m above the ground of a valley, whose sides fall and rise by 1 in 5, and 4 m above that again."""
    x, y = np.random.default_rng(0).uniform(-15.0, 15.0, (2, 20_000))
    keyframes = []
    for k, (x_m, z_m, slope) in enumerate(
        [(-20.0, 4.0, -0.2), (20.0, 4.0, 0.2), (-20.0, 8.0, -0.2), (20.0, 8.0, 0.2)]
    ):
        cloud = stored(np.column_stack([x, y, slope * x - 2.0]))
        keyframes.append(Keyframe(k, k, k, cloud, pose(x_m, 0.0, z_m), 40.0 * k))
    valley = UprightMap(keyframes, configured(3))
    at = lie.pose_2d(-16.0, 3.0, 0.7)
    assert [valley.stories(at[:2, 2]), valley.stories(np.array([20.0, 1.0])), valley.stories(np.zeros(2))] == [
        [0, 2],
        [1, 3],
        [],
    ]
    for k, z_m in ((0, 3.2), (2, 7.2)):
        T = keyframes[k].T_odom_lidar @ valley.on_ground(k, at)
        np.testing.assert_allclose(T[:3, 3], [-16.0, 3.0, z_m], atol=0.02)
        np.testing.assert_allclose(T[:3, 2], np.array([0.2, 0.0, 1.0]) / np.hypot(0.2, 1.0), atol=0.01)
        assert np.arctan2(T[1, 0], T[0, 0]) == pytest.approx(0.7, abs=0.02)


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
