"""The checks of the scans themselves: their states, overlap and accelerations, and copies of one scan."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.verdict import Kind, Verdict, judge, smallest_jump_m
from scanchain.verdict.scans import Velocity, check_overlap, check_velocity
from tests.support.courses import INTERVAL_S, POSES, N, chained, evidence, marked, wheels_of


def lasting_wheels(count):
    """Wheels of the first scans alone."""
    wheels = wheels_of(POSES)
    wheels[count:] = np.nan
    return wheels


def shares(value, at):
    share = np.full(N, 0.98)
    share[at] = value
    return share


CALM = {
    "degenerate for 3 m where the wheels hold": lambda: evidence(
        wheels=wheels_of(POSES), is_degenerate=marked(300, 330)
    ),
    "degenerate between scans that measure": lambda: evidence(
        is_degenerate=marked(300, 360) & (np.arange(N) % 8 != 0)
    ),
    "degenerate now and then": lambda: evidence(wheels=wheels_of(POSES), is_degenerate=np.arange(N) % 90 < 9),
    "degenerate for 0.4 m": lambda: evidence(is_degenerate=marked(300, 303)),
    "lost for 0.4 m": lambda: evidence(is_lost=marked(300, 303)),
    "contradicted for 0.4 m": lambda: evidence(fit=np.where(marked(300, 303), 0.4, 0.9)),
    "an overlap that shrinks slowly": lambda: evidence(inlier_share=np.linspace(1.0, 0.3, N)),
    "copies at rest": lambda: evidence(
        np.concatenate([POSES[:500], np.repeat(POSES[500:501], 21, axis=0), POSES[501:]])[:N],
        is_copy=marked(501, 519),
    ),
    "five copies": lambda: evidence(is_copy=marked(501, 505)),
    "copies while the wheels agree": lambda: evidence(is_copy=marked(501, 520), wheels=wheels_of(POSES)),
}


@pytest.mark.parametrize("case", CALM)
def test_a_right_trajectory_is_trustworthy(case):
    assert judge(CALM[case]()).verdict is Verdict.TRUSTWORTHY


def jumped():
    return np.concatenate([POSES[:400], lie.pose_2d(2.5, 0.0, 0.0) @ POSES[400:]])


def stuck():
    return np.concatenate([POSES[:501], np.repeat(POSES[500:501], 20, axis=0), POSES[521:]])


CHECK, WRONG = Verdict.CHECK, Verdict.NOT_TRUSTWORTHY
FOUND = {
    "impossible acceleration": (lambda: evidence(jumped()), WRONG, {Kind.ACCELERATION}, "acceleration"),
    "a jump where a segment starts": (
        lambda: evidence(jumped(), starts_segment=marked(400, 400)), CHECK, {Kind.DISCONNECTED}, "disconnected"
    ),
    "degenerate": (
        lambda: evidence(is_degenerate=marked(300, 330)), CHECK, {Kind.DEGENERATE}, "scans 300 to 330"
    ),
    "lost": (lambda: evidence(is_lost=marked(300, 330)), CHECK, {Kind.LOST}, "scans 300 to 330"),
    "contradicted": (
        lambda: evidence(fit=np.where(marked(300, 330), 0.4, 0.9)), CHECK, {Kind.CONTRADICTED}, "scans 300 to 330"
    ),
    "mostly degenerate": (
        lambda: evidence(is_degenerate=marked(300, 1000)), WRONG, {Kind.DEGENERATE}, "701 of 1,200 scans"
    ),
    "mostly lost": (lambda: evidence(is_lost=marked(300, 1000)), WRONG, {Kind.LOST}, "701 lost"),
    "mostly contradicted, in part where wheels agree": (
        lambda: evidence(fit=np.where(marked(0, 360), 0.4, 0.9), wheels=lasting_wheels(100)), WRONG,
        {Kind.CONTRADICTED}, "361 of 1,200 scans are contradicted",
    ),
    "a corridor that the wheels hold": (
        lambda: evidence(wheels=wheels_of(POSES), is_degenerate=marked(300, 1000)), CHECK, {Kind.DEGENERATE},
        "those of the prediction, by wheels where these are used",
    ),
    "often degenerate though the wheels hold": (
        lambda: evidence(wheels=wheels_of(POSES), is_degenerate=np.arange(N) % 30 < 9), CHECK, set(),
        "360 of 1,200 scans are degenerate",
    ),
    "a lidar carried elsewhere": (
        lambda: evidence(wheels=wheels_of(POSES), inlier_share=shares(0.4, 600)), CHECK, {Kind.OVERLAP},
        "scan 600 (120.0 s): overlap lost",
    ),
    "a segment that starts where nothing is known": (
        lambda: evidence(inlier_share=shares(0.4, 600), starts_segment=marked(600, 600)), CHECK,
        {Kind.DISCONNECTED}, "disconnected",
    ),
    "a driver that was stuck": (
        lambda: evidence(stuck(), is_copy=marked(501, 520)), WRONG, {Kind.COPIES, Kind.ACCELERATION}, ""
    ),
    "copies at the end": (lambda: evidence(is_copy=marked(N - 20, N - 1)), CHECK, {Kind.COPIES}, ""),
    "copies at the beginning": (lambda: evidence(is_copy=marked(1, 20)), CHECK, {Kind.COPIES}, ""),
}  # fmt: skip


@pytest.mark.parametrize("case", FOUND)
def test_a_wrong_or_doubtful_trajectory_is_judged_by_its_segments_with_a_reason(case):
    made, verdict, kinds, words = FOUND[case]
    judged = judge(made())
    assert judged.verdict is verdict and {each.kind for each in judged.segments} == kinds
    assert words in judged.reason


TIMES_NS = (1e9 * INTERVAL_S * np.arange(301)).astype(np.int64)
JITTER_NS = np.random.default_rng(1).normal(0.0, 0.15e9, 301).astype(np.int64)
KEPT = np.delete(np.arange(301), slice(100, 112))


@pytest.mark.parametrize(
    ("stamps_ns", "log_times_ns", "there", "largest"),
    [
        (TIMES_NS + JITTER_NS, TIMES_NS, slice(None), 1.0),
        (TIMES_NS, TIMES_NS + JITTER_NS, slice(None), 1.0),
        (np.zeros_like(TIMES_NS), TIMES_NS, slice(None), 0.1),
        (TIMES_NS, TIMES_NS, KEPT, 0.1),
    ],
)
def test_clocks_that_jitter_stand_still_or_leave_scans_out_accelerate_nothing(
    stamps_ns, log_times_ns, there, largest
):
    poses = chained(np.tile([2.0, 0.0, 0.0], (300, 1)), np.random.default_rng(0))  # 10 m/s
    with np.errstate(all="raise"):
        assert np.nanmax(check_velocity(stamps_ns[there], log_times_ns[there], poses[there])) < largest
        assert np.isnan(check_velocity(np.zeros_like(TIMES_NS), np.zeros_like(TIMES_NS), poses)).all()


def test_a_short_interval_after_a_gap_accelerates_nothing():
    motions = np.tile([0.0, 0.0, 0.0], (60, 1))
    motions[30] = [1.9, 0.0, 0.0]  # over 16 s without scans
    intervals_s = np.full(60, 0.2)
    intervals_s[30:32] = 16.0, 0.08
    stamps_ns = (1e9 * np.concatenate([[0.0], np.cumsum(intervals_s)])).astype(np.int64)
    poses = chained(motions, np.random.default_rng(0))
    assert np.nanmax(check_velocity(stamps_ns, stamps_ns, poses)) < 1.0


@pytest.mark.parametrize(("times", "is_found"), [(0.98, False), (1.02, True)])
def test_the_smallest_jump_is_the_one_that_is_found(times, is_found):
    poses = chained(np.tile([0.5, 0.0, 0.0], (60, 1)), np.random.default_rng(0))
    poses[30:, 0, 2] += times * smallest_jump_m(TIMES_NS[:61] * 1e-9)
    innovation = check_velocity(TIMES_NS[:61], TIMES_NS[:61], poses)
    assert (np.nanmax(innovation) > Velocity.limit) == is_found


@pytest.mark.parametrize(("turn_rad", "is_found"), [(0.5, False), (3.0, True)])
def test_a_turn_that_no_vehicle_makes_is_found_where_it_does_not_move_the_lidar(turn_rad, is_found):
    motions = np.zeros((60, 3))
    motions[30, 2] = turn_rad
    poses = chained(motions, np.random.default_rng(0))
    innovation = check_velocity(TIMES_NS[:61], TIMES_NS[:61], poses)
    assert (np.nanmax(innovation) > Velocity.limit) == is_found


@pytest.mark.parametrize("count", [0, 1, 3, 4, 10, 11, 12, 60])
def test_the_usual_overlap_is_the_median_of_up_to_ten_scans_before(count):
    share = np.random.default_rng(count).random(count)
    naive = [np.nan if k < 3 else share[k] / np.median(share[max(k - 10, 0) : k]) for k in range(count)]
    assert np.array_equal(check_overlap(share), naive, equal_nan=True)


def test_after_a_gap_one_contradicted_scan_is_to_be_checked_unless_wheels_agree_even_if_the_lidar_seems_to_stand():
    kept, poses = ~marked(300, 315), POSES.copy()
    poses[316:] = poses[299] @ lie.inverse(poses[315]) @ poses[316:]  # as if the gap had lasted a moment
    changes = {"fit": np.where(marked(316, 316), 0.4, 0.9)[kept], "seconds": INTERVAL_S * np.flatnonzero(kept)}
    for there in (POSES, poses):
        (segment,) = judge(evidence(there[kept], **changes)).segments
        assert (segment.kind, segment.first, segment.last) == (Kind.CONTRADICTED, 300, 300)
    wheels = wheels_of(POSES)[kept]
    assert judge(evidence(POSES[kept], wheels=wheels, **changes)).verdict is Verdict.TRUSTWORTHY
