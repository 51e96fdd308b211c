"""The verdict on a trajectory: its words, its error, and whether a lidar that does not move was at rest."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain.verdict import Judged, Kind, Segment, Verdict, judge
from tests.support.courses import POSES, N, chained, evidence, marked, wheels_of


def test_a_single_scan_is_not_trustworthy():
    judged = judge(evidence(POSES[:1]))
    assert judged.verdict is Verdict.NOT_TRUSTWORTHY and judged.segments == ()
    assert "one scan has no motion" in judged.reason


def test_states_are_counted_as_the_scans_have_them_in_the_verdict_and_within_a_segment():
    fit = np.where(np.arange(N) % 40 == 0, 0.4, 0.9)
    judged = judge(evidence(fit=fit, is_degenerate=marked(5, 8)))
    assert judged.verdict is Verdict.TRUSTWORTHY and "contradiction" not in judged.sentence
    assert judged.reasons[:2] == [
        "nothing to check in 1,200 scans",
        "30 fit the map badly and 4 leave a direction open, each over too short a path to move the trajectory",
    ]
    fit = np.where(marked(300, 340), 0.5, 0.9)
    fit[345] = 0.5  # alone
    (segment,) = judge(evidence(fit=fit)).segments
    assert segment.scans == int((fit[segment.first : segment.last + 1] < 0.6).sum())


def test_a_verdict_names_the_error_that_it_vouches_for_where_it_vouches():
    right = replace(evidence(), error="ATE 0.010 to 0.020 m")
    assert judge(right).sentence.startswith("trustworthy (ATE 0.010 to 0.020 m): nothing to check")
    doubted = replace(right, fit=np.where(marked(300, 330), 0.5, 0.9))
    assert judge(doubted).sentence.startswith("check these segments (otherwise ATE 0.010 to 0.020 m): ")
    wrong = replace(right, is_lost=marked(100, 1000))
    assert judge(wrong).sentence.startswith("not trustworthy: ")


def test_a_trajectory_is_trustworthy_only_with_an_error_bar_that_is_small_beside_its_extent():
    unknown = judge(evidence(bound_m=np.inf))
    assert unknown.verdict is Verdict.CHECK and "nothing bounds its error" in unknown.reason
    where = "most between 310 and 640 s, where a position is known to ±3 m"
    wide = judge(evidence(bound_m=20.04, uncertain=where))
    assert wide.verdict is Verdict.CHECK and "its error may be 21 m, more than " in wide.reason
    assert wide.reason.endswith(where)


def rest(motion=(0.0, 0.0, 0.0)):
    return chained(np.tile(motion, (200, 1)), np.random.default_rng(0), 0.001)


def test_the_error_of_a_lidar_that_stands_still_is_at_least_what_its_noise_leaves_open():
    still = np.repeat(POSES[:1], 200, axis=0)
    assert judge(evidence(still, open_m=0.0012)).error == "error below 0.0012 m"
    assert judge(evidence(rest(), open_m=0.0012)).error == "error below 0.015 m"


@pytest.mark.parametrize("open_scans", [8, 40])
def test_a_trajectory_that_does_not_move_is_at_rest_unless_scans_leave_a_direction_open(open_scans):
    judged = judge(evidence(rest(), is_degenerate=np.arange(201) % 200 < open_scans))
    if open_scans == 8:
        assert judged.verdict is Verdict.TRUSTWORTHY and judged.error == "error below 0.015 m"
        assert "does not move (stays within 0.015 m for 40.0 s)" in judged.reason
    else:
        assert judged.verdict is Verdict.CHECK and "the log does not determine which" in judged.reason
        assert "does not move" not in judged.reason
    assert "stays within" not in judge(evidence(rest((0.0, 0.0, 0.05)))).reason


@pytest.mark.parametrize(("bound_m", "verdict"), [(0.09, Verdict.TRUSTWORTHY), (0.11, Verdict.CHECK)])
def test_on_a_short_path_an_error_bar_of_a_tenth_of_a_meter_suffices(bound_m, verdict):
    path = chained(np.tile([0.02, 0.0, 0.0], (100, 1)), np.random.default_rng(0), 0.001)
    assert judge(evidence(path, bound_m=bound_m)).verdict is verdict


def test_a_few_seconds_of_slow_motion_are_no_rest():
    slow = chained(np.tile([0.03, 0.0, 0.0], (20, 1)), np.random.default_rng(0), 0.001)
    assert "stays within" not in judge(evidence(slow)).reason


def test_of_a_trajectory_that_does_not_move_the_wheels_say_whether_the_lidar_rested():
    is_open = np.ones(201, bool)
    still = judge(evidence(rest(), wheels=chained(np.zeros((200, 3)), np.random.default_rng(0))))
    assert still.verdict is Verdict.TRUSTWORTHY and "does not move" in still.reason
    moved = judge(evidence(rest(), wheels=wheels_of(rest((0.1, 0.0, 0.0))), is_degenerate=is_open))
    assert moved.verdict is not Verdict.TRUSTWORTHY and "does not move" not in moved.reason


def test_the_reasons_hold_every_segment_once_where_the_sentence_holds_the_largest():
    is_lost = np.any([marked(first, first + 15) for first in range(100, 600, 100)], axis=0)
    judged = judge(evidence(is_lost=is_lost))
    assert "; and 2 more" in judged.sentence
    assert sorted(judged.reasons) == sorted(each.text for each in judged.segments)
    other = Judged(Verdict.CHECK, "a; b", (Segment(Kind.LOST, 1, 2, 2, 0.1, 0.2),))
    assert other.reasons == ["a", "b", "scans 1 to 2 (0.1 to 0.2 s): lost"]


def test_a_command_fails_where_a_trajectory_is_not_trustworthy_or_if_strict_to_be_checked():
    assert [verdict.fails(strict=False) for verdict in Verdict] == [False, False, True]
    assert [verdict.fails(strict=True) for verdict in Verdict] == [False, True, True]
