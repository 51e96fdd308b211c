"""The check by wheel odometry: its innovations, which source slipped, and the error that it bounds."""

import re
from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Trajectory
from scanchain.errors import at_most
from scanchain.runs.evidence import evidence_of_trajectory
from scanchain.verdict import Closures, Kind, Verdict, apart_m, judge
from scanchain.verdict.wheels import Wheels, wheel_bound_m
from tests.support.courses import INTERVAL_S, POSES, N, chained, closed, course, evidence, marked, wheels_of


@pytest.mark.parametrize(
    "errors", [{}, {"scale": 0.9}, {"scale": 1.05}, {"drift_rad_m": 0.02}, {"share": 0.1}], ids=str
)
def test_wheels_with_errors_of_scale_heading_and_noise_doubt_nothing(dimension, errors):
    poses, _ = course(dimension)
    judged = judge(evidence(poses, wheels=wheels_of(poses, **errors)))
    assert judged.verdict is Verdict.TRUSTWORTHY and judged.segments == ()
    assert "wheels" in judged.reason


def stalled_wheels():
    wheels = wheels_of(POSES)
    for first in (300, 700, 900):
        wheels[first : first + 4] = wheels[first]
    return wheels


def jumping_wheels(jump_m, last=N):
    wheels = wheels_of(POSES)
    wheels[600:last, 0, 2] += jump_m
    return wheels


CALM = {
    "a lidar turned on the robot": lambda: evidence(POSES @ lie.pose_2d(0.3, 0.0, 0.04), wheels=wheels_of(POSES)),
    "wheels that stall and catch up": lambda: evidence(wheels=stalled_wheels()),
    "wheels that are elsewhere once": lambda: evidence(wheels=jumping_wheels(6.0, 601)),
    "wheels that are far away once": lambda: evidence(wheels=jumping_wheels(1e6, 601)),
}


@pytest.mark.parametrize("case", CALM)
def test_a_right_trajectory_is_trustworthy(case):
    assert judge(CALM[case]()).verdict is Verdict.TRUSTWORTHY


def slipped_at(first, last, **changes):
    """Scans that slip, and wheels that do not."""
    truth, slipped = course(slip=(first, last))
    return evidence(slipped, wheels=wheels_of(truth), **changes)


def closing(poses):
    pairs = [(10 + 5 * k, 610 + 5 * k) for k in range(4)]
    return [(pair, lie.between(poses[pair[0]], poses[pair[1]])) for pair in pairs]


FOUND = {
    "slip where scans are degenerate": (
        lambda: slipped_at(500, 530, is_degenerate=marked(480, 550)),
        Verdict.NOT_TRUSTWORTHY,
        {Kind.WHEELS, Kind.DEGENERATE},
        "not well measured: degenerate",
    ),
    "slip that agreeing loops confirm": (
        lambda: slipped_at(500, 530, closures=closing(course()[0])),
        Verdict.NOT_TRUSTWORTHY,
        {Kind.WHEELS, Kind.LOOPS},
        "4 loop closures between scans 25 and 610",
    ),
    "slip that no closure spans": (
        lambda: replace(slipped_at(800, 830), closures=closed(course(slip=(800, 830))[1])),
        Verdict.CHECK,
        {Kind.WHEELS},
        "wheels disagree",
    ),
}


@pytest.mark.parametrize("case", FOUND)
def test_a_wrong_or_doubtful_trajectory_is_judged_by_its_segments_with_a_reason(case):
    made, verdict, kinds, words = FOUND[case]
    judged = judge(made())
    assert judged.verdict is verdict and {each.kind for each in judged.segments} == kinds
    assert words in judged.reason


def test_a_slip_along_a_corridor_is_named_though_every_scan_is_ok(dimension):
    truth, slipped = course(dimension, slip=(500, 530))
    judged = judge(evidence(slipped, wheels=wheels_of(truth)))
    assert judged.verdict is Verdict.CHECK
    (segment,) = judged.segments
    assert segment.kind is Kind.WHEELS and 480 <= segment.first <= 505 and 525 <= segment.last <= 550
    assert 2.0 < segment.size_m < 3.2 and f"wheels disagree by {segment.size_m:.1f} m" in judged.sentence
    assert segment.start_s == pytest.approx(INTERVAL_S * segment.first)


def test_a_turn_that_the_matching_did_not_see_is_named():
    truth, _ = course()
    turned = truth.copy()
    turned[600:] = truth[600] @ lie.pose_2d(0.0, 0.0, 0.9) @ lie.inverse(truth[600]) @ truth[600:]
    (segment,) = (each for each in judge(evidence(turned, wheels=wheels_of(truth))).segments if each.size_rad)
    assert segment.kind is Kind.WHEELS and 0.8 < segment.size_rad < 1.0 and "deg" in segment.text
    assert segment.first <= 600 <= segment.last


def test_of_wheels_and_scans_that_suspect_slipped_which_closures_around_contradict():
    truth, slipped = course(slip=(300, 330))
    stood = evidence(truth, wheels=wheels_of(slipped))  # the wheels stood still while the robot slid on
    assert judge(stood).verdict is Verdict.CHECK and "wheels disagree" in judge(stood).reason
    judged = judge(replace(stood, closures=closed(truth)))
    assert judged.verdict is Verdict.TRUSTWORTHY and judged.segments == ()
    start_s, end_s, size_m = map(float, re.findall(r"wheels slip at (.+) to (.+) s \((.+) m\)", judged.reason)[0])
    assert 54.0 < start_s < 62.0 and 64.0 < end_s < 72.0 and 2.0 < size_m < 3.5
    doubtful = replace(stood, closures=closed(truth), is_degenerate=marked(290, 340))  # may be of look-alikes
    assert judge(doubtful).verdict is Verdict.NOT_TRUSTWORTHY
    judged = judge(replace(slipped_at(300, 330), closures=closed(truth)))
    assert judged.verdict is Verdict.NOT_TRUSTWORTHY
    assert "scans slip at" in judged.reason and "wheels and loop closures agree with each other" in judged.reason
    (segment,) = (each for each in judged.segments if each.kind is Kind.SCANS_SLIP)
    assert segment.first <= 300 and segment.last >= 325 and 2.0 < segment.size_m < 3.5


def test_which_slipped_does_not_depend_on_the_direction_in_which_closures_are_measured():
    truth, slipped = course(slip=(300, 330))
    there, here = 10 + 5 * np.arange(6), 625 + 5 * np.arange(6)  # 1.5 m farther along the second lap
    ahead = Closures(there, here, lie.between(truth[there], truth[here]), np.ones(6, bool))
    back = Closures(here, there, lie.inverse(ahead.T_target_source), np.ones(6, bool))
    stood = evidence(truth, wheels=wheels_of(slipped))
    reasons = [judge(replace(stood, closures=closures)).reason for closures in (ahead, back)]
    assert "wheels slip at" in reasons[0] and reasons[0] == reasons[1]


def test_motions_are_not_compared_around_scans_whose_wheels_are_unknown():
    wheels = wheels_of(POSES)
    wheels[640:700] = np.nan
    values = Wheels(evidence(wheels=wheels)).values
    assert np.isnan(values[marked(625, 715)]).all()  # 2 m to either side, nearly
    assert np.isfinite(values[marked(100, 600) | marked(750, 1100)]).all()


@pytest.mark.parametrize("jump_m", [6.0, 1e6])
def test_wheels_that_jump_are_wrong_without_closures(jump_m):
    judged = judge(evidence(wheels=jumping_wheels(jump_m)))
    assert judged.verdict is Verdict.TRUSTWORTHY and f"s ({jump_m:,.0f}"[:4] in judged.reason


@pytest.mark.parametrize("error_m", [0.05, 0.5])
def test_the_error_of_another_tool_is_below_its_distance_to_an_independent_estimate(dimension, error_m):
    truth, _ = course(dimension)
    rng = np.random.default_rng(4)
    level = np.arange(3 * dimension - 3) < 2
    errors = (rng.normal(0.0, error_m / 20.0, (N, len(level))) * level for _ in range(2))
    estimate, other = (truth @ lie.exp(np.cumsum(error, axis=0)) for error in errors)
    positions = [poses[:, :-1, -1] for poses in (estimate, other, truth)]
    bound_m, true_m = apart_m(positions[0], positions[1]), apart_m(positions[0], positions[2])
    assert 0.5 * true_m < bound_m < 4.0 * true_m
    assert wheel_bound_m(estimate, other) == pytest.approx(bound_m, rel=0.2)
    unknown = np.full_like(truth, np.nan)
    times_ns = (1e9 * INTERVAL_S * np.arange(N)).astype(np.int64)
    trajectory = Trajectory(times_ns, estimate)
    for wheels, bounds, error in (
        (unknown, {}, "no jump above 0.67 m, drift unchecked"),
        (other, {}, f"ATE below {at_most(wheel_bound_m(estimate, other))} m by wheels"),
        (other, {"ours": 0.001}, "ATE below 0.0010 m by ours"),
    ):
        found = evidence_of_trajectory(trajectory, times_ns, wheels, np.full(N, 500), bounds)
        assert judge(found).error == error


def test_positions_are_as_far_apart_as_a_rigid_motion_leaves_them_also_along_a_line(dimension):
    rng = np.random.default_rng(6)
    T = lie.exp(rng.normal(0.0, 1.0, 3 * dimension - 3))
    positions = rng.normal(0.0, 5.0, (40, dimension))
    assert apart_m(positions, lie.transform(T, positions)) < 1e-9
    off = np.where(np.arange(40) % 2, 0.3, -0.3)[:, None] * np.eye(dimension)[0]
    line = np.arange(40)[:, None] // 2 * np.eye(dimension)[1]
    assert apart_m(line, line + off + 7.0) == pytest.approx(0.3, rel=0.01)


def test_wheels_that_turn_the_other_way_or_disagree_all_along_are_named(dimension):
    poses, _ = course(dimension)
    motions = lie.log(lie.between(poses[:-1], poses[1:]))
    motions[:, [1, -1]] *= -1.0
    mirrored = judge(evidence(poses, wheels=wheels_of(chained(motions, np.random.default_rng(2)))))
    assert mirrored.verdict is Verdict.CHECK and "mirrored" in mirrored.reason
    assert ("--log.upside_down" in mirrored.reason, "--log.lidar_pose" in mirrored.reason) == (
        dimension == 2,
        dimension == 3,
    )
    evenly = judge(evidence(poses, wheels=wheels_of(poses, scale=1.4)))
    assert evenly.verdict is Verdict.CHECK and "mirrored" not in evenly.reason
    assert "wheels disagree with the trajectory all along" in evenly.reason
