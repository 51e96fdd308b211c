"""Evidence on a trajectory, what confirms it, and findings in words."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain.verdict import Check, Kind, Segment, merged
from scanchain.verdict.evidence import extent_m, listed
from scanchain_viz.colors import SEGMENT_COLORS
from tests.support.courses import INTERVAL_S, POSES, N, evidence, marked


def test_a_segment_shorter_than_a_digit_of_its_times_has_one_time():
    assert Segment(Kind.LOST, 7, 8, 2, 2262.91, 2262.94).text == "scans 7 to 8 (2262.9 s): lost"
    assert Segment(Kind.LOST, 7, 9, 3, 2262.9, 2263.1).text == "scans 7 to 9 (2262.9 to 2263.1 s): lost"


def test_every_kind_of_segment_has_a_color():
    assert set(SEGMENT_COLORS) == set(Kind) and len(set(SEGMENT_COLORS.values())) == len(Kind)


@pytest.mark.parametrize(
    ("kind", "size_m", "size_rad", "text"),
    [
        (Kind.WHEELS, 2.04, 0.09, "wheels disagree by 2.0 m"),
        (Kind.WHEELS, 2.04, 0.9, "wheels disagree by 2.0 m and 52 deg"),
        (Kind.WHEELS, 2.04, 3.2, "wheels disagree by 2.0 m and more than 180 deg"),
        (Kind.ACCELERATION, 2.5, None, "impossible acceleration, 2.5 m from where constant velocity leads"),
    ],
)
def test_the_size_of_a_contradiction_is_stated(kind, size_m, size_rad, text):
    assert Segment(kind, 7, 7, 1, 1.4, 1.4, size_m, size_rad).text == f"scan 7 (1.4 s): {text}"


def test_of_many_segments_the_largest_are_listed_and_the_others_counted():
    sizes_m = (1.0, 5.0, None, 3.0, 5.0)
    segments = [Segment(Kind.LOOPS, k, k, 10 + k, 0.0, 0.0, size_m) for k, size_m in enumerate(sizes_m)]
    assert listed(segments) == f"{segments[4].text}; {segments[1].text}; {segments[3].text}; and 2 more"
    assert listed(segments[2:]) == f"{segments[4].text}; {segments[3].text}; {segments[2].text}"


@pytest.mark.parametrize("gap", [0, 1, 10])
def test_marked_scans_are_merged_over_up_to_so_many_unmarked_ones(gap):
    rng = np.random.default_rng(gap)
    for share in np.linspace(0.0, 1.0, 40):
        is_marked = rng.random(60) < share**2
        naive = []
        for k in np.flatnonzero(is_marked).tolist():
            joins = naive and k - naive[-1].stop <= gap
            first = naive.pop().start if joins else k
            naive.append(slice(first, k + 1))
        assert merged(is_marked, gap) == naive


def test_a_finding_counts_the_marked_scans_within_it_and_has_their_times():
    segment = evidence().segment(Kind.LOST, slice(300, 331), marked(310, 400), 0.5)
    assert (segment.first, segment.last, segment.scans, segment.size_m) == (300, 330, 21, 0.5)
    assert (segment.start_s, segment.end_s) == pytest.approx((300 * INTERVAL_S, 330 * INTERVAL_S))


class Given(Check):
    """A check by another sensor whose values are given."""

    source, limit = "given", 3.0

    def __init__(self, values):
        self.values = values


def test_another_sensor_confirms_scans_where_it_agrees_and_parts_most_of_which_it_knows():
    values = np.ones(N)
    values[np.arange(N) % 3 == 0] = np.nan
    values[100], values[200:220:2] = 3.1, np.nan
    found = replace(evidence(), checks=(Check(evidence()), Given(values)))
    assert found.sensors == [found.checks[1]]
    assert np.array_equal(found.is_confirmed, values <= 3.0)
    assert found.is_confirmed_throughout(slice(0, 100)) and not found.is_confirmed_throughout(slice(0, 101))
    assert not found.is_confirmed_throughout(slice(200, 220))
    assert not replace(found, checks=found.checks[:1]).is_confirmed_throughout(slice(0, 100))


def test_a_scan_is_contradicted_only_where_its_points_should_determine_its_pose():
    fit = np.where(marked(100, 399), 0.4, 0.9)
    found = evidence(fit=fit, is_lost=marked(150, 199), is_degenerate=marked(250, 299))
    assert np.array_equal(found.is_contradicted, marked(100, 149) | marked(200, 249) | marked(300, 399))


def test_a_gap_is_an_interval_of_more_than_two_and_a_half_usual_ones():
    times_s = np.cumsum(np.where(np.arange(50) == 20, 0.52, np.where(np.arange(50) == 30, 0.48, INTERVAL_S)))
    assert np.flatnonzero(evidence(POSES[:50], seconds=times_s).is_after_gap).tolist() == [20]


def test_the_extent_is_the_largest_distance_from_the_first_known_pose():
    poses = POSES.copy()
    poses[:30], poses[1000] = np.nan, np.nan
    there = [pose[:-1, -1] for pose in poses if np.isfinite(pose).all()]
    assert extent_m(poses) == pytest.approx(max(np.linalg.norm(each - there[0]) for each in there))
