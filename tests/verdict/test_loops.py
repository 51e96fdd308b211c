"""The checks by loop closures: groups that contradict a trajectory, few of them, and segments that none joins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from scanchain import lie
from scanchain.verdict import Closures, Kind, Verdict, judge
from scanchain.verdict.loops import Connections, contradicting_groups
from tests.support.courses import INTERVAL_S, POSES, N, closed, evidence, marked


def test_closures_that_disagree_with_each_other_are_no_finding():
    disagreeing = [
        ((10 + 5 * k, 610 + 5 * k), lie.pose_2d(*np.random.default_rng(k).uniform(-9.0, 9.0, 3))) for k in range(8)
    ]
    assert judge(evidence(closures=disagreeing)).verdict is Verdict.TRUSTWORTHY


@pytest.mark.parametrize(("count", "verdict"), [(2, Verdict.TRUSTWORTHY), (3, Verdict.CHECK)])
def test_rejected_closures_that_agree_with_each_other_are_a_finding_from_three_on(count, verdict):
    wrong = lie.pose_2d(2.0, 0.0, 0.0)
    pairs = [(10 + 5 * k, 610 + 5 * k) for k in range(count)]
    closures = [((i, j), lie.between(POSES[i], POSES[j] @ wrong)) for i, j in pairs]
    judged = judge(evidence(closures=closures))
    assert judged.verdict is verdict
    assert [each.kind for each in judged.segments] == [Kind.LOOPS] * (count > 2)
    assert all(each.size_m == pytest.approx(2.0) for each in judged.segments)


def test_a_group_of_closures_whose_ends_overlap_lies_between_the_outermost():
    wrong = lie.pose_2d(2.0, 0.0, 0.0)
    closures = [((i, i + 10), lie.between(POSES[i], POSES[i + 10] @ wrong)) for i in (10, 16, 22)]
    (group,) = contradicting_groups(evidence(closures=closures).closures, POSES, INTERVAL_S * np.arange(N))
    assert (group.first, group.last) == (10, 32)


@pytest.mark.parametrize(("apart", "verdict"), [(40, Verdict.CHECK), (60, Verdict.TRUSTWORTHY)])
def test_closures_more_than_ten_meters_apart_along_both_paths_are_no_group(apart, verdict):
    pairs = [(5 + apart * k, 605 + apart * k) for k in range(3)]
    wrong = [((i, j), lie.between(POSES[i], POSES[j] @ lie.pose_2d(2.0, 0.0, 0.0))) for i, j in pairs]
    assert judge(evidence(closures=wrong)).verdict is verdict


@pytest.mark.parametrize(("off_m", "verdict"), [(0.3, Verdict.CHECK), (0.6, Verdict.TRUSTWORTHY)])
def test_closures_that_differ_by_more_than_odometry_between_them_allows_are_no_group(off_m, verdict):
    pairs = [(5 + 40 * k, 605 + 40 * k) for k in range(3)]  # 8 m from one to the next
    wrong = [
        ((i, j), POSES[i], POSES[j] @ lie.pose_2d(2.0 + off_m * k, 0.0, 0.0)) for k, (i, j) in enumerate(pairs)
    ]
    closures = [(pair, lie.between(*poses)) for pair, *poses in wrong]
    assert judge(evidence(closures=closures)).verdict is verdict


def test_a_group_lies_between_its_ends_whichever_of_its_scans_is_the_source():
    wrong = lie.pose_2d(2.0, 0.0, 0.0)
    pairs = [(10 + 5 * k, 610 + 5 * k) for k in range(4)]
    there = evidence(closures=[((i, j), lie.between(POSES[i], POSES[j] @ wrong)) for i, j in pairs]).closures
    back = replace(
        there, target=there.source, source=there.target, T_target_source=lie.inverse(there.T_target_source)
    )
    for closures in (there, back):
        (group,) = contradicting_groups(closures, POSES, INTERVAL_S * np.arange(N))
        assert (group.kind, group.first, group.last, group.scans) == (Kind.LOOPS, 25, 610, 4)
        assert (group.start_s, group.end_s, group.size_m) == pytest.approx((5.0, 122.0, 2.0))


@pytest.mark.parametrize(
    ("tried", "verdict"), [(4, Verdict.TRUSTWORTHY), (9, Verdict.TRUSTWORTHY), (10, Verdict.CHECK)]
)
def test_revisited_places_that_do_not_look_as_mapped_are_to_be_checked(tried, verdict):
    found = evidence(closures=[((10, 610), lie.between(POSES[10], POSES[610]))])
    closures = replace(found.closures, is_accepted=np.array([True]), tried=tried)
    assert judge(replace(found, closures=closures)).verdict is verdict


def test_a_segment_is_disconnected_unless_a_closure_joins_it():
    apart = evidence(starts_segment=marked(600, 600))
    assert judge(replace(apart, closures=closed(POSES))).verdict is Verdict.TRUSTWORTHY
    judged = judge(apart)
    assert judged.verdict is Verdict.CHECK and [each.kind for each in judged.segments] == [Kind.DISCONNECTED]
    assert "scans 600 to 1,199" in judged.reason


def test_segments_are_connected_along_chains_of_accepted_closures():
    rng = np.random.default_rng(5)
    for count in range(12):
        starts = np.isin(np.arange(N), rng.choice(np.arange(1, N), 9, replace=False))
        ends, is_accepted = rng.integers(0, N, (2, count)), rng.random(count) < 0.7
        found = evidence(starts_segment=starts)
        closures = Closures(*ends, np.tile(np.eye(3), (count, 1, 1)), is_accepted)
        found = replace(found, closures=closures)
        of_scan = np.cumsum(starts)
        links = of_scan[ends[:, is_accepted]]
        graph = coo_matrix((np.ones(links.shape[1]), tuple(links)), (10, 10))
        label = connected_components(graph, directed=False)[1]
        wanted = [np.flatnonzero(of_scan == k)[[0, -1]].tolist() for k in np.flatnonzero(label != label[0])]
        segments = Connections(found).segments(found, [])
        assert [[each.first, each.last] for each in segments] == wanted
