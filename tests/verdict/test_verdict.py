"""The verdict on made-up trajectories: right ones are trustworthy; slips, jumps and wrong loops are named."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest

from scanchain import lie
from scanchain.data import Trajectory
from scanchain.runs.overlay import read_overlay, write_overlay
from scanchain.runs.step_table import StepTable
from scanchain.runs.vouching import evidence_of, evidence_of_trajectory
from scanchain.verdict import (
    Closures,
    Evidence,
    Judged,
    Kind,
    Stretch,
    Verdict,
    WorstPlace,
    apart_m,
    check_overlap,
    check_velocity,
    check_wheels,
    judge,
    wheel_bound_m,
    worst_place,
)
from scanchain_viz.colors import STRETCH_COLORS
from tests.support.recordings import drive

N, STEP_M, INTERVAL_S = 1200, 0.1, 0.2


def course(dimension=2, slip=(0, 0), seed=0):
    """True poses around a block, twice, and those of a matching that stands still over the scans of ``slip``."""
    rng = np.random.default_rng(seed)
    k = 3 if dimension == 2 else 6
    motions = np.zeros((N - 1, k))
    motions[:, 0] = STEP_M
    motions[np.arange(N - 1) % 150 >= 140, k - 1] = np.pi / 20.0
    slipped = motions.copy()
    slipped[slice(*slip), 0] *= 0.1
    return chained(motions, rng, 0.002), chained(slipped, rng, 0.002)


def chained(motions, rng, noise_m=0.0):
    poses = [lie.identity(2 if motions.shape[1] == 3 else 3)]
    noise = rng.normal(0.0, noise_m, motions.shape) * (np.arange(motions.shape[1]) < 2)
    for motion in motions + noise:
        poses.append(poses[-1] @ lie.exp(motion))
    return np.array(poses)


POSES = course()[0]


def wheels_of(poses, seed=1, *, scale=1.0, drift_rad_m=0.0, share=0.02):
    """Wheel odometry with errors of scale and heading, and noise."""
    rng = np.random.default_rng(seed)
    motions = lie.log(lie.between(poses[:-1], poses[1:])) * scale
    motions[:, -1] += drift_rad_m * STEP_M
    return chained(motions * rng.normal(1.0, share, motions.shape), rng)


def evidence(poses=POSES, *, wheels=None, closures=(), **changes):
    n = len(poses)
    seconds = changes.pop("seconds", INTERVAL_S * np.arange(n))
    stamps_ns = (1e9 * seconds).astype(np.int64)
    unknown = np.full_like(poses, np.nan)
    ends = np.array([pair for pair, _ in closures], np.int64).reshape(-1, 2)
    T = np.array([T for _, T in closures]).reshape(-1, *poses.shape[1:])
    known = {
        "is_lost": np.zeros(n, bool),
        "is_degenerate": np.zeros(n, bool),
        "fit": np.full(n, 0.9),
        "starts_segment": np.zeros(n, bool),
        "is_copy": np.zeros(n, bool),
        "points": np.full(n, 500),
        "overlap": np.ones(n),
    }
    return Evidence(
        seconds=seconds,
        poses=poses,
        wheels=check_wheels(poses, unknown if wheels is None else wheels),
        velocity=check_velocity(stamps_ns, stamps_ns, poses),
        closures=Closures(ends[:, 0], ends[:, 1], T, np.zeros(len(ends), bool)),
        **known | changes,
    )


def marked(first, last):
    return (np.arange(N) >= first) & (np.arange(N) <= last)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(
    "errors", [{}, {"scale": 0.97}, {"scale": 1.05}, {"drift_rad_m": 0.02}, {"share": 0.1}], ids=str
)
def test_wheels_with_errors_of_scale_heading_and_noise_doubt_nothing(dimension, errors):
    poses, _ = course(dimension)
    judged = judge(evidence(poses, wheels=wheels_of(poses, **errors)))
    assert judged.verdict is Verdict.TRUSTWORTHY and judged.stretches == ()
    assert "wheels" in judged.reason


def test_wheels_on_a_robot_whose_lidar_is_turned_doubt_nothing():
    turned = lie.pose_2d(0.3, 0.0, 0.04)
    assert judge(evidence(POSES @ turned, wheels=wheels_of(POSES))).verdict is Verdict.TRUSTWORTHY


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_slip_along_a_corridor_is_named_though_every_scan_is_ok(dimension):
    truth, slipped = course(dimension, slip=(500, 530))
    judged = judge(evidence(slipped, wheels=wheels_of(truth)))
    assert judged.verdict is Verdict.CHECK
    (stretch,) = judged.stretches
    assert stretch.kind is Kind.WHEELS and 480 <= stretch.first <= 505 and 525 <= stretch.last <= 550
    assert 2.0 < stretch.size_m < 3.2 and f"wheels disagree by {stretch.size_m:.1f} m" in judged.sentence
    assert stretch.start_s == pytest.approx(INTERVAL_S * stretch.first)


def test_wheels_that_stall_and_catch_up_doubt_nothing():
    wheels = wheels_of(POSES)
    for first in (300, 700, 900):
        wheels[first : first + 4] = wheels[first]
    assert judge(evidence(wheels=wheels)).verdict is Verdict.TRUSTWORTHY


def test_a_slip_where_scans_are_degenerate_is_not_trustworthy():
    truth, slipped = course(slip=(500, 530))
    judged = judge(evidence(slipped, wheels=wheels_of(truth), is_degenerate=marked(480, 550)))
    assert judged.verdict is Verdict.NOT_TRUSTWORTHY and "not well measured: degenerate" in judged.reason


def test_a_turn_that_the_matching_did_not_see_is_named():
    truth, _ = course()
    turned = truth.copy()
    turned[600:] = truth[600] @ lie.pose_2d(0.0, 0.0, 0.9) @ lie.inverse(truth[600]) @ truth[600:]
    (stretch,) = (each for each in judge(evidence(turned, wheels=wheels_of(truth))).stretches if each.size_rad)
    assert stretch.kind is Kind.WHEELS and 0.8 < stretch.size_rad < 1.0 and "deg" in stretch.text
    assert stretch.first <= 600 <= stretch.last


def test_a_slip_that_agreeing_loops_confirm_is_not_trustworthy():
    truth, slipped = course(slip=(500, 530))
    pairs = [(10 + 5 * k, 610 + 5 * k) for k in range(4)]
    closures = [(pair, lie.between(truth[pair[0]], truth[pair[1]])) for pair in pairs]
    judged = judge(evidence(slipped, wheels=wheels_of(truth), closures=closures))
    assert judged.verdict is Verdict.NOT_TRUSTWORTHY
    assert "wheels disagree" in judged.reason and "4 loop closures between scans 25 and 610" in judged.reason


def closed(poses, *, by_m=0.01):
    """Six accepted closures around the middle of a course, as measured at these poses."""
    pairs = np.array([(10 + 5 * k, 610 + 5 * k) for k in range(6)])
    off = [lie.pose_2d(*each) for each in np.random.default_rng(3).normal(0.0, [by_m, by_m, 0.001], (6, 3))]
    T = lie.between(poses[pairs[:, 0]], poses[pairs[:, 1]]) @ np.array(off)
    return Closures(pairs[:, 0], pairs[:, 1], T, np.ones(6, bool))


def test_wheels_that_slip_are_the_suspect_where_closures_around_agree_with_the_scans():
    poses, stalled = course(slip=(300, 330))
    found = evidence(poses, wheels=wheels_of(stalled))  # the wheels stood still while the robot slid on
    alone = judge(found)
    assert alone.verdict is Verdict.CHECK and "wheels disagree" in alone.reason
    judged = judge(replace(found, closures=closed(poses)))
    assert judged.verdict is Verdict.TRUSTWORTHY and judged.stretches == ()
    start_s, end_s, size_m = map(float, re.findall(r"wheels slip at (.+) to (.+) s \((.+) m\)", judged.reason)[0])
    assert 54.0 < start_s < 62.0 and 64.0 < end_s < 72.0 and 2.0 < size_m < 3.5


def test_scans_that_slip_are_the_suspect_where_closures_around_agree_with_the_wheels():
    truth, slipped = course(slip=(300, 330))
    found = evidence(slipped, wheels=wheels_of(truth))
    judged = judge(replace(found, closures=closed(truth)))
    assert judged.verdict is Verdict.NOT_TRUSTWORTHY
    assert "scans slip at" in judged.reason and "wheels and loop closures agree with each other" in judged.reason
    (stretch,) = (each for each in judged.stretches if each.kind is Kind.SCANS_SLIP)
    assert stretch.first <= 300 and stretch.last >= 325 and 2.0 < stretch.size_m < 3.5


def test_closures_acquit_no_scans_that_are_badly_measured_and_none_that_they_do_not_span():
    poses, stalled = course(slip=(300, 330))
    found = replace(evidence(poses, wheels=wheels_of(stalled)), closures=closed(poses))
    doubtful = replace(found, is_degenerate=marked(290, 340))
    assert judge(doubtful).verdict is Verdict.NOT_TRUSTWORTHY
    poses, stalled = course(slip=(800, 830))
    beside = replace(evidence(poses, wheels=wheels_of(stalled)), closures=closed(poses))
    assert judge(beside).verdict is Verdict.CHECK


@pytest.mark.parametrize("jump_m", [6.0, 1e6])
def test_wheels_that_jump_are_wrong_without_closures(jump_m):
    wheels = wheels_of(POSES)
    wheels[600:, 0, 2] += jump_m
    judged = judge(evidence(wheels=wheels))
    assert judged.verdict is Verdict.TRUSTWORTHY and f"s ({jump_m:,.0f}"[:4] in judged.reason
    once = wheels_of(POSES)
    once[600, 0, 2] += jump_m
    assert judge(evidence(wheels=once)).verdict is Verdict.TRUSTWORTHY


def test_a_verdict_counts_states_as_the_scans_have_them():
    fit = np.where(np.arange(N) % 40 == 0, 0.4, 0.9)
    judged = judge(evidence(fit=fit, is_degenerate=marked(5, 8)))
    assert judged.verdict is Verdict.TRUSTWORTHY and "contradiction" not in judged.sentence
    assert "nothing to check in 1,200 scans: 1,166 ok, 30 contradicted, 4 degenerate; checked by" in judged.reason


def test_a_stretch_counts_every_contradicted_scan_within_it():
    fit = np.where(marked(300, 340), 0.5, 0.9)
    fit[345] = 0.5  # alone
    (stretch,) = judge(evidence(fit=fit)).stretches
    assert stretch.scans == int((fit[stretch.first : stretch.last + 1] < 0.6).sum())


@pytest.mark.parametrize("share", [0.3, 0.09])
def test_many_contradicted_scans_are_counted_as_in_the_summary_also_where_wheels_agree(share):
    fit = np.where(np.arange(N) < share * N, 0.4, 0.9)
    held = wheels_of(POSES)
    held[100:] = np.nan
    judged = judge(evidence(fit=fit, wheels=held))
    counted = f"{int((fit < 0.6).sum()):,} of 1,200 scans are contradicted"
    assert (counted in judged.reason) is (share > 0.1)


def test_a_verdict_names_the_error_that_it_vouches_for_where_it_vouches():
    right = replace(evidence(), error="ATE 0.010 to 0.020 m with 95 %")
    assert judge(right).sentence.startswith("trustworthy (ATE 0.010 to 0.020 m with 95 %): nothing to check")
    doubted = replace(right, fit=np.where(marked(300, 330), 0.5, 0.9))
    assert judge(doubted).sentence.startswith("check these stretches (otherwise ATE 0.010 to 0.020 m with 95 %): ")
    wrong = replace(right, is_lost=marked(100, 1000))
    assert judge(wrong).sentence.startswith("not trustworthy: ")


@pytest.mark.parametrize("error_m", [0.05, 0.5])
@pytest.mark.parametrize("dimension", [2, 3])
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
        (other, {}, f"ATE below {wheel_bound_m(estimate, other):.2g} m by wheels"),
        (other, {"ours": 0.001}, "ATE below 0.001 m by ours"),
    ):
        found = evidence_of_trajectory(trajectory, times_ns, wheels, np.full(N, 500), bounds)
        assert judge(found).error == error


@pytest.mark.parametrize(("count", "verdict"), [(2, Verdict.TRUSTWORTHY), (3, Verdict.CHECK)])
def test_rejected_closures_that_agree_with_each_other_are_a_finding_from_three_on(count, verdict):
    wrong = lie.pose_2d(2.0, 0.0, 0.0)
    pairs = [(10 + 5 * k, 610 + 5 * k) for k in range(count)]
    closures = [((i, j), lie.between(POSES[i], POSES[j] @ wrong)) for i, j in pairs]
    judged = judge(evidence(closures=closures))
    assert judged.verdict is verdict
    assert [each.kind for each in judged.stretches] == [Kind.LOOPS] * (count > 2)
    assert all(each.size_m == pytest.approx(2.0) for each in judged.stretches)


def test_rejected_closures_that_disagree_with_each_other_are_noise():
    closures = [
        ((10 + 5 * k, 610 + 5 * k), lie.pose_2d(*np.random.default_rng(k).uniform(-9.0, 9.0, 3))) for k in range(8)
    ]
    assert judge(evidence(closures=closures)).verdict is Verdict.TRUSTWORTHY


def test_a_jump_is_an_impossible_acceleration():
    moved = POSES.copy()
    moved[400:] = lie.pose_2d(2.5, 0.0, 0.0) @ POSES[400:]
    judged = judge(evidence(moved))
    assert judged.verdict is Verdict.NOT_TRUSTWORTHY
    assert [each.kind for each in judged.stretches] == [Kind.ACCELERATION]
    assert 399 <= judged.stretches[0].first <= 401
    starts = np.zeros(N, bool)
    starts[400] = True
    judged = judge(evidence(moved, starts_segment=starts))
    assert judged.verdict is Verdict.CHECK and Kind.DISCONNECTED in {each.kind for each in judged.stretches}


def test_stamps_that_jitter_and_step_back_accelerate_nothing():
    motions = np.tile([2.0, 0.0, 0.0], (300, 1))  # 10 m/s
    poses = chained(motions, np.random.default_rng(0))
    log_times_ns = (1e9 * INTERVAL_S * np.arange(301)).astype(np.int64)
    jitter_ns = np.random.default_rng(1).normal(0.0, 0.15e9, 301).astype(np.int64)
    assert np.nanmax(check_velocity(log_times_ns + jitter_ns, log_times_ns, poses)) < 1.0
    assert np.nanmax(check_velocity(log_times_ns, log_times_ns + jitter_ns, poses)) < 1.0


def test_stamps_that_stand_still_are_replaced_by_the_times_of_the_log():
    poses = chained(np.tile([2.0, 0.0, 0.0], (300, 1)), np.random.default_rng(0))
    times_ns = (1e9 * INTERVAL_S * np.arange(301)).astype(np.int64)
    with np.errstate(all="raise"):
        assert np.nanmax(check_velocity(np.zeros_like(times_ns), times_ns, poses)) < 0.1
        assert np.isnan(check_velocity(np.zeros_like(times_ns), np.zeros_like(times_ns), poses)).all()


def test_a_single_scan_is_not_trustworthy():
    assert judge(evidence(course()[0][:1])).verdict is Verdict.NOT_TRUSTWORTHY


def test_a_driver_that_was_stuck_is_a_stretch_unless_the_lidar_rested_or_wheels_agree():
    stuck = POSES.copy()
    stuck[501:521] = POSES[500]
    (stretch,) = judge(evidence(stuck, is_copy=marked(501, 520))).stretches[:1]
    assert (stretch.kind, stretch.first, stretch.last) == (Kind.COPIES, 501, 520)
    for at_an_end in (marked(N - 20, N - 1), marked(1, 20)):
        assert Kind.COPIES in {each.kind for each in judge(evidence(is_copy=at_an_end)).stretches}
    rested = np.concatenate([POSES[:500], np.repeat(POSES[500:501], 21, axis=0), POSES[501:]])[:N]
    for calm, last, wheels in ((rested, 519, None), (POSES, 505, None), (POSES, 520, wheels_of(POSES))):
        judged = judge(evidence(calm, is_copy=marked(501, last), wheels=wheels))
        assert judged.verdict is Verdict.TRUSTWORTHY


@pytest.mark.parametrize("dimension", [2, 3])
def test_wheels_that_turn_the_other_way_show_a_mirrored_lidar(dimension):
    poses, _ = course(dimension)
    motions = lie.log(lie.between(poses[:-1], poses[1:]))
    motions[:, [1, -1]] *= -1.0
    judged = judge(evidence(poses, wheels=wheels_of(chained(motions, np.random.default_rng(2)))))
    assert judged.verdict is Verdict.CHECK and "mirrored" in judged.reason
    assert "mirrored" not in judge(evidence(poses, wheels=wheels_of(poses))).reason


def test_missing_scans_accelerate_nothing():
    poses = chained(np.tile([2.0, 0.0, 0.0], (300, 1)), np.random.default_rng(0))
    stamps_ns = (1e9 * INTERVAL_S * np.arange(301)).astype(np.int64)
    there = np.delete(np.arange(301), slice(100, 112))
    assert np.nanmax(check_velocity(stamps_ns[there], stamps_ns[there], poses[there])) < 0.1


def test_a_short_interval_after_a_gap_accelerates_nothing():
    motions = np.tile([0.0, 0.0, 0.0], (60, 1))
    motions[30] = [1.9, 0.0, 0.0]  # over 16 s without scans
    intervals_s = np.full(60, 0.2)
    intervals_s[30:32] = 16.0, 0.08
    stamps_ns = (1e9 * np.concatenate([[0.0], np.cumsum(intervals_s)])).astype(np.int64)
    poses = chained(motions, np.random.default_rng(0))
    assert np.nanmax(check_velocity(stamps_ns, stamps_ns, poses)) < 1.0


@pytest.mark.parametrize("kind", [Kind.DEGENERATE, Kind.LOST, Kind.CONTRADICTED])
def test_a_stretch_of_doubtful_scans_is_to_be_checked_and_most_of_a_run_is_not_trustworthy(kind):
    def of(is_marked):
        changes = {
            Kind.DEGENERATE: {"is_degenerate": is_marked},
            Kind.LOST: {"is_lost": is_marked},
            Kind.CONTRADICTED: {"fit": np.where(is_marked, 0.4, 0.9)},
        }
        return judge(evidence(**changes[kind]))

    assert of(marked(300, 303)).verdict is Verdict.TRUSTWORTHY  # 0.4 m
    judged = of(marked(300, 330))
    assert judged.verdict is Verdict.CHECK
    assert [(each.kind, each.first, each.last) for each in judged.stretches] == [(kind, 300, 330)]
    assert of(marked(300, 1000)).verdict is Verdict.NOT_TRUSTWORTHY


def test_a_corridor_that_the_wheels_hold_is_to_be_checked_and_not_wrong():
    wheels = wheels_of(POSES)
    judged = judge(evidence(wheels=wheels, is_degenerate=marked(300, 1000)))
    assert judged.verdict is Verdict.CHECK and judged.stretches[0].scans == 701
    assert judge(evidence(wheels=wheels, is_degenerate=marked(300, 330))).verdict is Verdict.TRUSTWORTHY


@pytest.mark.parametrize("open_scans", [8, 40])
def test_a_trajectory_that_does_not_move_is_at_rest_unless_scans_leave_a_direction_open(open_scans):
    rng = np.random.default_rng(0)
    rested = chained(np.zeros((200, 3)), rng, 0.001)
    is_open = np.arange(201) % 200 < open_scans
    judged = judge(evidence(rested, is_degenerate=is_open))
    if open_scans == 8:
        assert judged.verdict is Verdict.TRUSTWORTHY and judged.error == "error below 0.015 m"
        assert "does not move (stays within 0.015 m for 40.0 s)" in judged.reason
    else:
        assert judged.verdict is Verdict.CHECK and "nothing in the log tells which" in judged.reason
        assert "does not move" not in judged.reason
    turning = chained(np.tile([0.0, 0.0, 0.05], (200, 1)), rng, 0.001)
    assert "stays within" not in judge(evidence(turning)).reason


def test_of_a_trajectory_that_does_not_move_the_wheels_say_whether_the_lidar_rested():
    rng = np.random.default_rng(0)
    rested, is_open = chained(np.zeros((200, 3)), rng, 0.001), np.ones(201, bool)
    still = judge(evidence(rested, wheels=chained(np.zeros((200, 3)), rng), is_degenerate=is_open & False))
    assert still.verdict is Verdict.TRUSTWORTHY and "does not move" in still.reason
    rolled = wheels_of(chained(np.tile([0.1, 0.0, 0.0], (200, 1)), rng))
    moved = judge(evidence(rested, wheels=rolled, is_degenerate=is_open))
    assert moved.verdict is not Verdict.TRUSTWORTHY and "does not move" not in moved.reason


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("scale", "verdict"), [(0.9, Verdict.TRUSTWORTHY), (1.4, Verdict.CHECK)])
def test_wheels_that_disagree_all_along_are_named_though_they_disagree_evenly(dimension, scale, verdict):
    poses, _ = course(dimension)
    judged = judge(evidence(poses, wheels=wheels_of(poses, scale=scale)))
    assert judged.verdict is verdict
    assert ("wheels disagree with the trajectory all along" in judged.reason) is (verdict is Verdict.CHECK)


def test_many_short_stretches_of_degenerate_scans_are_to_be_checked_though_wheels_hold_each():
    often = np.arange(N) % 30 < 9
    judged = judge(evidence(wheels=wheels_of(POSES), is_degenerate=often))
    assert judged.verdict is Verdict.CHECK and "360 of 1,200 scans are degenerate" in judged.reason
    seldom = np.arange(N) % 90 < 9
    assert judge(evidence(wheels=wheels_of(POSES), is_degenerate=seldom)).verdict is Verdict.TRUSTWORTHY


@pytest.mark.parametrize(("tried", "verdict"), [(9, Verdict.TRUSTWORTHY), (10, Verdict.CHECK)])
def test_revisited_places_that_do_not_look_as_mapped_are_to_be_checked(tried, verdict):
    pairs = [((10, 610), lie.between(POSES[10], POSES[610]))]
    found = evidence(closures=pairs)
    closures = replace(found.closures, is_accepted=np.array([True]), tried=tried)
    judged = judge(replace(found, closures=closures))
    assert judged.verdict is verdict
    assert judge(replace(found, closures=replace(closures, tried=4))).verdict is Verdict.TRUSTWORTHY


def test_segments_that_a_closure_joins_are_not_told():
    starts = marked(600, 600)
    parts = evidence(starts_segment=starts)
    (stretch,) = judge(parts).stretches
    assert (stretch.kind, stretch.first, stretch.last) == (Kind.DISCONNECTED, 600, N - 1)
    closures = Closures(np.array([10]), np.array([610]), lie.between(POSES[[10]], POSES[[610]]), np.array([True]))
    joined = evidence(starts_segment=starts)
    object.__setattr__(joined, "closures", closures)
    assert judge(joined).verdict is Verdict.TRUSTWORTHY


def test_a_scan_that_starts_a_segment_is_known_from_its_column_whatever_its_reason_says(tmp_path):
    table = StepTable()
    for step in drive(20, 3):
        table.append(replace(step, starts_segment=step.scan.index == 7, reason="a new map begins"))
    table.write(tmp_path / "steps.parquet", table.best_known)
    found = evidence_of(pq.ParquetFile(tmp_path / "steps.parquet").read(), None)
    assert np.flatnonzero(found.starts_segment).tolist() == [7]


def test_a_table_holds_the_figures_of_the_steps():
    table = StepTable()
    steps = [replace(step, reason=f"reason {step.scan.index % 3}") for step in drive(20, 2)]
    T_odom_base = lie.pose_2d(1.0, 2.0, 0.3)
    steps[9] = replace(steps[9], scan=replace(steps[9].scan, T_odom_base=T_odom_base))
    for step in steps:
        table.append(step)
    columns = table.columns
    assert len(table) == 20 and columns["has_wheels"].tolist() == [k == 9 for k in range(20)]
    assert table.texts("reason").to_pylist() == [step.reason for step in steps]
    np.testing.assert_array_equal(columns["T_odom_base"][9], T_odom_base)
    np.testing.assert_array_equal(columns["information"], [step.match.information for step in steps])
    np.testing.assert_array_equal(columns["timing"][:, 2], [step.timing.match_s for step in steps])


def test_the_worst_place_of_a_slip_lies_between_the_scans_before_and_after_it():
    truth, slipped = course(slip=(500, 530))
    found = evidence(slipped, wheels=wheels_of(truth))
    worst = worst_place(judge(found).stretches, found)
    assert worst.stretch.kind is Kind.WHEELS and worst.before < 505 and worst.after > 525
    assert worst_place((), found) is None


def test_the_worst_place_of_a_long_stretch_is_the_scan_that_is_contradicted_most():
    fit = np.where(marked(300, 700), 0.5, 0.9)
    fit[444] = 0.1
    found = evidence(fit=fit)
    worst = worst_place(judge(found).stretches, found)
    assert worst.stretch.kind is Kind.CONTRADICTED and (worst.before, worst.after) == (443, 444)


def test_the_worst_place_of_disagreeing_loops_are_its_two_passes():
    found = evidence()
    loops = Stretch(Kind.LOOPS, 100, 700, 4, 20.0, 140.0, 2.0)
    slip = Stretch(Kind.WHEELS, 300, 310, 11, 60.0, 62.0, 1.0)
    assert worst_place((slip, loops), found)[1:] == (100, 700)


@pytest.mark.parametrize(("kind", "seen"), [(Kind.WHEELS, "one side"), (Kind.LOOPS, "around")])
def test_an_overlay_holds_the_points_of_keyframes_near_the_worst_place(tmp_path, kind, seen):
    numbers = np.arange(0, N, 5)
    beside = np.array([[0.0, 1.0]])
    result = SimpleNamespace(
        trajectory=Trajectory(np.arange(N), POSES),
        keyframes=[SimpleNamespace(scan_index=int(k), points=beside) for k in numbers],
        T_world_keyframes=POSES[numbers],
    )
    stretch = Stretch(kind, 200, 205, 6, 40.0, 41.0, 1.0)
    write_overlay(tmp_path / "overlay.npz", WorstPlace(stretch, 199, 605), result)
    overlay = read_overlay(tmp_path / "overlay.npz")
    before, after = (
        numbers[(np.abs(STEP_M * (numbers - scan)) < 6.0) & ((side * (numbers - scan) >= 0) | (seen == "around"))]
        for scan, side in ((199, -1), (605, 1))
    )
    assert overlay.text == stretch.text and np.allclose(overlay.place, POSES[605, :2, 2])
    assert abs(len(overlay.before) - len(before)) <= 2 and abs(len(overlay.after) - len(after)) <= 2
    assert np.isclose(overlay.before, lie.transform(POSES[before[3]], beside), atol=1e-4).all(axis=1).any()


def test_without_a_keyframe_near_it_an_overlay_has_the_nearest(tmp_path):
    keyframe = SimpleNamespace(scan_index=0, points=np.array([[1.0, 2.0]]))
    result = SimpleNamespace(
        trajectory=Trajectory(np.arange(N), POSES), keyframes=[keyframe], T_world_keyframes=POSES[:1]
    )
    stretch = Stretch(Kind.LOST, 800, 820, 21, 160.0, 164.0)
    write_overlay(tmp_path / "overlay.npz", WorstPlace(stretch, 799, 820), result)
    overlay = read_overlay(tmp_path / "overlay.npz")
    assert len(overlay.before) == len(overlay.after) == 1


@pytest.mark.parametrize("count", [0, 1, 3, 4, 10, 11, 12, 60])
def test_the_usual_overlap_is_the_median_of_up_to_ten_scans_before(count):
    share = np.random.default_rng(count).random(count)
    naive = [np.nan if k < 3 else share[k] / np.median(share[max(k - 10, 0) : k]) for k in range(count)]
    assert np.array_equal(check_overlap(share), naive, equal_nan=True)


def test_a_lidar_that_was_carried_elsewhere_is_named_though_the_wheels_agree():
    share = np.full(N, 0.98)
    share[600] = 0.4  # of the points have a correspondence; the next scans match the one that was inserted
    judged = judge(evidence(wheels=wheels_of(POSES), overlap=check_overlap(share)))
    assert judged.verdict is Verdict.CHECK
    assert [(each.kind, each.first, each.last) for each in judged.stretches] == [(Kind.OVERLAP, 600, 600)]


def test_overlap_that_shrinks_slowly_doubts_nothing():
    share = np.linspace(1.0, 0.3, N)
    assert judge(evidence(overlap=check_overlap(share))).verdict is Verdict.TRUSTWORTHY


def test_one_contradicted_scan_after_a_gap_is_to_be_checked_unless_wheels_agree():
    kept = ~marked(300, 315)
    changes = {"fit": np.where(marked(316, 316), 0.4, 0.9)[kept], "seconds": INTERVAL_S * np.flatnonzero(kept)}
    (stretch,) = judge(evidence(POSES[kept], **changes)).stretches
    assert (stretch.kind, stretch.first, stretch.last) == (Kind.CONTRADICTED, 300, 300)
    wheels = wheels_of(POSES)[kept]
    assert judge(evidence(POSES[kept], wheels=wheels, **changes)).verdict is Verdict.TRUSTWORTHY


def test_degenerate_scans_between_which_others_measure_the_pose_are_passed():
    mostly = marked(300, 360) & (np.arange(N) % 8 != 0)  # 0.7 m at a time
    assert judge(evidence(is_degenerate=mostly)).verdict is Verdict.TRUSTWORTHY


def test_a_lidar_that_seems_to_stand_after_a_gap_at_speed_is_to_be_checked():
    poses, _ = course()
    poses[316:] = poses[299] @ lie.inverse(poses[315]) @ poses[316:]  # as if the gap had lasted a moment
    kept = ~marked(300, 315)
    changes = {"fit": np.where(marked(316, 316), 0.4, 0.9)[kept], "seconds": INTERVAL_S * np.flatnonzero(kept)}
    (stretch,) = judge(evidence(poses[kept], **changes)).stretches
    assert (stretch.kind, stretch.first) == (Kind.CONTRADICTED, 300)


def test_a_stretch_shorter_than_a_digit_of_its_times_has_one_time():
    assert Stretch(Kind.LOST, 7, 8, 2, 2262.91, 2262.94).text == "scans 7 to 8 (2262.9 s): lost"
    assert Stretch(Kind.LOST, 7, 9, 3, 2262.9, 2263.1).text == "scans 7 to 9 (2262.9 to 2263.1 s): lost"


def test_stretches_that_the_reason_names_are_not_listed_again():
    stretches = tuple(Stretch(Kind.LOST, 10 * k, 10 * k + 4 + k, 5 + k, float(k), k + 0.5) for k in range(5))
    judged = Judged(Verdict.CHECK, "; ".join(each.text for each in stretches[2:]) + "; and 2 more", stretches)
    assert judged.unnamed == stretches[:2]


def test_every_kind_of_stretch_has_a_color():
    assert set(STRETCH_COLORS) == set(Kind) and len(set(STRETCH_COLORS.values())) == len(Kind)
