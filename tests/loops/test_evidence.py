"""The sequential test of a place: what keyframes add to its log-odds, and when it is accepted or rejected."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Closure, ClosureVerdict, Keyframe, Proposal
from scanchain.loops.connectivity import Segments
from scanchain.loops.evidence import _OF_FIND as FOUND
from scanchain.loops.evidence import (
    LARGEST_RATIO,
    SequentialPlaceTest,
    compared,
    features,
    is_in_sight,
    log_ratio,
    pose_by,
)
from scanchain.odometry.odometry import first_match
from tests.support.graphs import graph_of
from tests.support.scenes import configured, square, stored


def keyframes_in(rooms, away_m=()):
    """Three keyframes of a map in a room of 8 m, and a log's, a meter apart, in rooms of these half widths."""
    sizes = [4.0] * 3 + list(rooms)
    at_m = [0.0] * 3 + (list(away_m) or [0.0] * len(rooms))
    return [
        Keyframe(k, k, k, stored(square(size)), lie.pose_2d(x_m, 0.0, 0.0), 1.0 * k)
        for k, (size, x_m) in enumerate(zip(sizes, at_m, strict=True))
    ]


def begun():
    segments = Segments()
    segments.start(3)
    return SequentialPlaceTest(segments), segments


def up_to(index, keyframes):
    """The keyframes up to one of them, and their poses."""
    known = keyframes[: index + 1]
    return known, np.array([each.T_odom_lidar for each in known])


def tried(*sources, y_m=0.0, overlap=0.95, verdict=ClosureVerdict.ACCEPTED):
    match = first_match(lie.pose_2d(0.0, y_m, 0.0), np.empty((0, 2)), configured(2).matching)
    return [Closure(0, source, match, overlap, verdict, "") for source in sources]


def test_a_closure_places_a_later_keyframe_along_the_odometry_since_its_source():
    keyframes = keyframes_in([4.0] * 4)
    T_source, ahead, T_target = (
        lie.pose_2d(*each) for each in ((1.0, 2.0, 0.5), (2.0, 0.3, 0.4), (5.0, 0.0, 1.0))
    )
    for k, T in ((3, T_source), (5, T_source @ ahead)):
        keyframes[k] = replace(keyframes[k], T_odom_lidar=T)
    (closure,) = tried(3, y_m=0.7)
    found = pose_by(closure, 5, keyframes, np.array([T_target]))
    np.testing.assert_allclose(found, T_target @ lie.pose_2d(0.0, 0.7, 0.0) @ ahead, atol=1e-12)


def test_keyframes_that_fit_one_place_join_a_log_to_a_map_once_they_are_enough():
    keyframes = keyframes_in([4.0] * 8)
    evidence, segments = begun()
    assert not evidence.update(tried(3, overlap=0.61), *up_to(3, keyframes))
    assert evidence.is_testing and not evidence.is_accepted
    assert not evidence.update(tried(4, overlap=0.61), *up_to(4, keyframes))
    assert not evidence.update(tried(5, y_m=3.0), *up_to(5, keyframes)), "it is at another pose"
    joining = [evidence.update(tried(source, overlap=0.61), *up_to(source, keyframes)) for source in range(6, 9)]
    assert [[each.source for each in closures] for closures in joining] == [[], [], [3, 4, 6, 7, 8]]
    assert not evidence.is_testing and evidence.bound == pytest.approx(np.log(1e3))
    assert segments.components(graph_of([lie.identity(2)] * 11)).tolist() == [0] * 3 + [1] * 8


def test_a_place_that_was_seen_through_is_dropped_however_well_the_scans_fit():
    keyframes = keyframes_in([9.0] * 8)
    evidence, _ = begun()
    for source in range(3, 9):
        assert not evidence.update(tried(source), *up_to(source, keyframes))
    assert evidence.is_rejected(keyframes[-1])
    evidence.reject(3)
    assert not evidence.is_testing and np.isnan(evidence.best)


def test_keyframes_closer_than_a_meter_count_for_the_path_between_them():
    apart, close = keyframes_in([4.0] * 8), keyframes_in([4.0] * 8)
    close = [replace(each, traveled_m=3.0 + 0.25 * each.index) for each in close]
    odds = []
    for keyframes in (apart, close):
        evidence, _ = begun()
        evidence.update(tried(3), *up_to(3, keyframes))
        evidence.update(tried(4), *up_to(4, keyframes))
        odds.append(evidence.log_odds)
    assert [each - FOUND[2] for each in odds] == pytest.approx([4.0, 2.5])


def test_keyframes_count_for_the_path_to_the_nearest_other_one_in_whatever_order_they_are_matched():
    keyframes = keyframes_in([4.0] * 4)
    at_m = {3: 3.0, 4: 9.0, 5: 3.25, 6: 6.0}  # where the fourth was not matched yet when the others were
    keyframes = [replace(each, traveled_m=at_m.get(each.index, 0.0)) for each in keyframes]
    for order, weights in (((3, 4, 5, 6), 3.25), ((6, 5, 4, 3), 3.25), ((4, 6, 3), 3.0)):
        evidence, _ = begun()
        evidence.update(tried(*order), keyframes, np.array([each.T_odom_lidar for each in keyframes]))
        assert evidence.log_odds - FOUND[2] == pytest.approx(weights * LARGEST_RATIO)


def test_the_longer_the_path_that_was_sought_the_more_a_place_has_to_show():
    keyframes = [replace(each, traveled_m=20.0 * each.index) for each in keyframes_in([4.0] * 8)]
    evidence, _ = begun()
    evidence.update(tried(3, overlap=0.61), *up_to(3, keyframes))
    assert evidence.bound == pytest.approx(np.log(1e3))
    log_odds = evidence.log_odds
    evidence.reject(3)
    assert evidence.best == log_odds, "that was cut short, and so is not certain"
    evidence.update(tried(7, overlap=0.61), *up_to(7, keyframes))
    assert evidence.bound == pytest.approx(np.log(1e3 * 80.0 / 8.0))


def test_what_is_joined_is_withdrawn_once_the_place_is_seen_through_and_not_before():
    keyframes = keyframes_in([4.0] * 6 + [9.0] * 12)
    evidence, _ = begun()
    for source in range(3, 7):
        evidence.update(tried(source), *up_to(source, keyframes))
    assert not evidence.is_testing
    holds = [evidence.update_joined(tried(source), *up_to(source, keyframes)) for source in range(9, 21)]
    assert holds[0] and holds[3] and not holds[-1]


def test_a_place_that_was_right_for_long_is_withdrawn_as_soon_as_one_that_was_right_for_a_while():
    keyframes = keyframes_in([4.0] * 40 + [9.0] * 12)
    evidence, _ = begun()
    for source in range(3, 7):
        evidence.update(tried(source), *up_to(source, keyframes))
    holds = [evidence.update_joined(tried(source), *up_to(source, keyframes)) for source in range(7, 55)]
    assert all(holds[:40]) and holds.index(False) < 46  # 36 of them match


def test_keyframes_far_from_the_last_match_do_not_count():
    keyframes = keyframes_in([4.0] * 3 + [9.0] * 3)
    keyframes = [replace(each, traveled_m=20.0 * each.index) for each in keyframes]
    evidence, _ = begun()
    evidence.update(tried(3, 4, 5), *up_to(5, keyframes))
    odds = [evidence.log_odds]
    for source in range(6, 9):
        closures = tried(source, overlap=0.1, verdict=ClosureVerdict.REJECTED)
        evidence.update_joined(closures, *up_to(source, keyframes))
        odds.append(evidence.log_odds)
    assert odds[0] > odds[1] > odds[2] == odds[3]


def test_another_pose_is_taken_once_more_keyframes_match_there_than_at_the_first():
    keyframes = keyframes_in([4.0] * 20)
    evidence, rival = begun()[0], begun()[0]
    evidence.update(tried(3, 4, 5), *up_to(5, keyframes))
    evidence.update_joined(tried(6, 7, 8, 9, 10), *up_to(10, keyframes))
    assert evidence.matches == 8.0
    joining = [
        rival.update(tried(source), *up_to(source, keyframes), least_matches=evidence.matches)
        for source in range(11, 20)
    ]
    assert not any(joining[:5]) and any(joining), "it needs about as many keyframes as the first had"
    evidence.reject(3)
    assert evidence.matches == 0.0
    evidence.continue_from(rival)
    assert evidence.matches == rival.matches and not evidence.is_testing


def test_a_place_that_was_given_is_believed_until_it_is_seen_through():
    keyframes = keyframes_in([4.0] * 2 + [9.0] * 12)
    evidence, _ = begun()
    evidence.accept()
    assert evidence.passes_at(range(3, len(keyframes)), *up_to(len(keyframes), keyframes)), "nothing was tried"
    holds = [evidence.update_joined(tried(source), *up_to(source, keyframes)) for source in range(3, 17)]
    assert all(holds[:6]) and not holds[-1]
    evidence.record(tried(*range(3, 17)))
    assert not evidence.passes_at(range(3, len(keyframes)), *up_to(len(keyframes), keyframes))


def test_places_proposed_elsewhere_say_nothing_about_a_place_that_is_joined():
    keyframes = keyframes_in([4.0] * 6)
    evidence, _ = begun()
    for source in range(3, 7):
        evidence.update(tried(source), *up_to(source, keyframes))
    before = evidence.log_odds
    elsewhere = [
        replace(each, proposed_by=Proposal.PLACE)
        for each in tried(8, y_m=9.0, overlap=0.1, verdict=ClosureVerdict.REJECTED)
    ]
    assert evidence.update_joined(elsewhere, *up_to(8, keyframes)) and evidence.log_odds == before


@pytest.mark.parametrize(("away_m", "holds"), [(0.0, False), (30.0, True)])
def test_what_does_not_match_counts_against_a_log_only_where_the_map_shows_it(away_m, holds):
    keyframes = keyframes_in([4.0] * 6 + [9.0] * 20, [0.0] * 6 + [away_m] * 20)
    evidence, _ = begun()
    evidence.record(tried(*range(3, 9)))
    at_wrong = tried(*range(9, 29), overlap=0.2, verdict=ClosureVerdict.REJECTED)
    evidence.record(at_wrong)
    assert evidence.passes_at(range(3, len(keyframes)), *up_to(len(keyframes), keyframes)) is holds
    assert np.isfinite(evidence.best) is np.bool_(holds)


def test_a_place_where_nothing_has_matched_for_fifty_meters_is_rejected():
    keyframes = keyframes_in([4.0] * 8)
    evidence, _ = begun()
    evidence.update(tried(3), *up_to(3, keyframes))
    assert [evidence.is_rejected(replace(keyframes[4], traveled_m=m)) for m in (52.5, 53.5)] == [False, True]


def test_within_one_log_fewer_keyframes_pass_at_their_final_poses_and_another_place_brings_its_own():
    keyframes = keyframes_in([4.0] * 8)
    evidence, other = begun()[0], begun()[0]
    other.record(tried(3, 4, 5))
    evidence.continue_from(other)
    passes = [
        evidence.passes_at(range(3, end), *up_to(5, keyframes), of_same_log=same)
        for end, same in ((6, True), (6, False), (5, True))
    ]
    assert passes == [True, False, False] and not begun()[0].passes_at(
        range(3, 6), *up_to(5, keyframes), of_same_log=True
    )


def test_free_space_is_compared_with_the_nearest_keyframe_far_enough_along_the_path():
    keyframes = keyframes_in([4.0, 9.0], [0.5, 0.0])[3:]  # the last one sees through the walls of the other
    counts = [compared(keyframes[1:], keyframes, path_m).tolist() for path_m in (0.0, 1.0, 2.0)]
    assert counts == [[800, 0], [0, 800], [0, 0]]


def test_a_rejected_place_forgets_what_was_tried_in_its_own_segment_alone():
    evidence, _ = begun()
    evidence.record(tried(1, 2, 3, 5))
    evidence.reject(3)
    assert sorted(evidence.tried) == [1, 2]


def test_a_keyframe_is_in_sight_of_the_nearest_other_one_if_that_views_enough_of_its_points():
    near, far, corner = keyframes_in([4.0] * 3, [0.5, 30.0, 0.0])[3:]
    corner = replace(corner, stored=stored(square(4.0)[:120]))
    assert is_in_sight(near, [corner]) is False  # of one that sees a seventh of the room
    assert [is_in_sight(corner, others) for others in ([near], [far, near], [far])] == [True, True, False]


@pytest.mark.parametrize(
    ("overlap", "agreeing", "contradicting", "expected"),
    [
        (1.0, 900, 0, (1.0, 0.0, 0.0)),
        (0.65, 900, 0, (0.5, 0.5, 0.0)),
        (0.2, 300, 600, (0.0, 1.0, 2.0 / 3.0)),
        (0.2, 50, 50, (0.0, 0.5, 0.25)),  # hardly in view
        (0.2, 0, 0, (0.0, 0.0, 0.0)),  # out of sight: it counts neither for nor against
    ],
)
def test_a_keyframe_counts_by_its_fit_and_by_what_is_in_view(overlap, agreeing, contradicting, expected):
    (closure,) = tried(3, overlap=overlap)
    assert features(closure, agreeing, contradicting, 1000) == pytest.approx(expected)
    ratio = log_ratio(closure, agreeing, contradicting, 1000)
    assert ratio == pytest.approx(np.clip(np.dot([2.8, -0.4, -4.9], expected), -LARGEST_RATIO, LARGEST_RATIO))
