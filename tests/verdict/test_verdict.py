"""The verdict on made-up trajectories: right ones are trustworthy; slips, jumps and wrong loops are named."""

import re
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from scanchain import lie
from scanchain.data import Trajectory
from scanchain.errors import at_most
from scanchain.runs.evidence import evidence_of, evidence_of_trajectory
from scanchain.runs.step_table import steps_table, write_table
from scanchain.steps import Steps
from scanchain.verdict import CHECKS, Check, Closures, Evidence, Kind, Segment, Verdict, apart_m, judge
from scanchain.verdict.scans import check_overlap, check_velocity
from scanchain.verdict.wheels import wheel_bound_m
from scanchain_viz.colors import SEGMENT_COLORS, color_of_kind
from tests.benchmarks import vouching
from tests.benchmarks.vouching_logs import Case, LogSpec
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
    ends = np.array([pair for pair, _ in closures], np.int64).reshape(-1, 2)
    T = np.array([T for _, T in closures]).reshape(-1, *poses.shape[1:])
    known = {
        "is_lost": np.zeros(n, bool),
        "is_degenerate": np.zeros(n, bool),
        "fit": np.full(n, 0.9),
        "starts_segment": np.zeros(n, bool),
        "is_copy": np.zeros(n, bool),
        "points": np.full(n, 500),
        "inlier_share": np.ones(n),
        "bound_m": 0.02,
        "sources": {} if wheels is None else {"wheel": wheels},
    }
    return Evidence(
        stamps_ns=stamps_ns,
        log_times_ns=stamps_ns,
        poses=poses,
        closures=Closures(ends[:, 0], ends[:, 1], T, np.zeros(len(ends), bool)),
        **known | changes,
    )


def marked(first, last):
    return (np.arange(N) >= first) & (np.arange(N) <= last)


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


def lasting_wheels(count):
    """Wheels of the first scans alone."""
    wheels = wheels_of(POSES)
    wheels[count:] = np.nan
    return wheels


def jumping_wheels(jump_m, last=N):
    wheels = wheels_of(POSES)
    wheels[600:last, 0, 2] += jump_m
    return wheels


def disagreeing():
    """Closures that contradict the trajectory and each other."""
    return [
        ((10 + 5 * k, 610 + 5 * k), lie.pose_2d(*np.random.default_rng(k).uniform(-9.0, 9.0, 3))) for k in range(8)
    ]


def rest(motion=(0.0, 0.0, 0.0)):
    return chained(np.tile(motion, (200, 1)), np.random.default_rng(0), 0.001)


def closed(poses, *, by_m=0.01):
    """Six accepted closures around the middle of a course, as measured at these poses."""
    pairs = np.array([(10 + 5 * k, 610 + 5 * k) for k in range(6)])
    off = [lie.pose_2d(*each) for each in np.random.default_rng(3).normal(0.0, [by_m, by_m, 0.001], (6, 3))]
    T = lie.between(poses[pairs[:, 0]], poses[pairs[:, 1]]) @ np.array(off)
    return Closures(pairs[:, 0], pairs[:, 1], T, np.ones(6, bool))


def shares(value, at):
    share = np.full(N, 0.98)
    share[at] = value
    return share


CALM = {
    "a lidar turned on the robot": lambda: evidence(POSES @ lie.pose_2d(0.3, 0.0, 0.04), wheels=wheels_of(POSES)),
    "wheels that stall and catch up": lambda: evidence(wheels=stalled_wheels()),
    "wheels that are elsewhere once": lambda: evidence(wheels=jumping_wheels(6.0, 601)),
    "wheels that are far away once": lambda: evidence(wheels=jumping_wheels(1e6, 601)),
    "closures that disagree with each other": lambda: evidence(closures=disagreeing()),
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
    "a segment that a closure joins": lambda: replace(
        evidence(starts_segment=marked(600, 600)), closures=closed(POSES)
    ),
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


def jumped():
    return np.concatenate([POSES[:400], lie.pose_2d(2.5, 0.0, 0.0) @ POSES[400:]])


def stuck():
    return np.concatenate([POSES[:501], np.repeat(POSES[500:501], 20, axis=0), POSES[521:]])


CHECK, WRONG = Verdict.CHECK, Verdict.NOT_TRUSTWORTHY
FOUND = {
    "slip where scans are degenerate": (
        lambda: slipped_at(500, 530, is_degenerate=marked(480, 550)), WRONG, {Kind.WHEELS, Kind.DEGENERATE},
        "not well measured: degenerate",
    ),
    "slip that agreeing loops confirm": (
        lambda: slipped_at(500, 530, closures=closing(course()[0])), WRONG, {Kind.WHEELS, Kind.LOOPS},
        "4 loop closures between scans 25 and 610",
    ),
    "slip that no closure spans": (
        lambda: replace(slipped_at(800, 830), closures=closed(course(slip=(800, 830))[1])), CHECK, {Kind.WHEELS},
        "wheels disagree",
    ),
    "impossible acceleration": (lambda: evidence(jumped()), WRONG, {Kind.ACCELERATION}, "acceleration"),
    "a jump where a segment starts": (
        lambda: evidence(jumped(), starts_segment=marked(400, 400)), CHECK, {Kind.DISCONNECTED}, "disconnected"
    ),
    "a single scan": (lambda: evidence(POSES[:1]), WRONG, set(), "one scan has no motion"),
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
    "a driver that was stuck": (
        lambda: evidence(stuck(), is_copy=marked(501, 520)), WRONG, {Kind.COPIES, Kind.ACCELERATION}, ""
    ),
    "copies at the end": (lambda: evidence(is_copy=marked(N - 20, N - 1)), CHECK, {Kind.COPIES}, ""),
    "copies at the beginning": (lambda: evidence(is_copy=marked(1, 20)), CHECK, {Kind.COPIES}, ""),
    "segments apart": (
        lambda: evidence(starts_segment=marked(600, 600)), CHECK, {Kind.DISCONNECTED}, "scans 600 to 1,199"
    ),
}  # fmt: skip


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


@pytest.mark.parametrize("jump_m", [6.0, 1e6])
def test_wheels_that_jump_are_wrong_without_closures(jump_m):
    judged = judge(evidence(wheels=jumping_wheels(jump_m)))
    assert judged.verdict is Verdict.TRUSTWORTHY and f"s ({jump_m:,.0f}"[:4] in judged.reason


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


@pytest.mark.parametrize(("count", "verdict"), [(2, Verdict.TRUSTWORTHY), (3, Verdict.CHECK)])
def test_rejected_closures_that_agree_with_each_other_are_a_finding_from_three_on(count, verdict):
    wrong = lie.pose_2d(2.0, 0.0, 0.0)
    pairs = [(10 + 5 * k, 610 + 5 * k) for k in range(count)]
    closures = [((i, j), lie.between(POSES[i], POSES[j] @ wrong)) for i, j in pairs]
    judged = judge(evidence(closures=closures))
    assert judged.verdict is verdict
    assert [each.kind for each in judged.segments] == [Kind.LOOPS] * (count > 2)
    assert all(each.size_m == pytest.approx(2.0) for each in judged.segments)


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


def test_wheels_that_turn_the_other_way_or_disagree_all_along_are_named(dimension):
    poses, _ = course(dimension)
    motions = lie.log(lie.between(poses[:-1], poses[1:]))
    motions[:, [1, -1]] *= -1.0
    mirrored = judge(evidence(poses, wheels=wheels_of(chained(motions, np.random.default_rng(2)))))
    assert mirrored.verdict is Verdict.CHECK and "mirrored" in mirrored.reason
    evenly = judge(evidence(poses, wheels=wheels_of(poses, scale=1.4)))
    assert evenly.verdict is Verdict.CHECK and "mirrored" not in evenly.reason
    assert "wheels disagree with the trajectory all along" in evenly.reason


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


def test_of_a_trajectory_that_does_not_move_the_wheels_say_whether_the_lidar_rested():
    is_open = np.ones(201, bool)
    still = judge(evidence(rest(), wheels=chained(np.zeros((200, 3)), np.random.default_rng(0))))
    assert still.verdict is Verdict.TRUSTWORTHY and "does not move" in still.reason
    moved = judge(evidence(rest(), wheels=wheels_of(rest((0.1, 0.0, 0.0))), is_degenerate=is_open))
    assert moved.verdict is not Verdict.TRUSTWORTHY and "does not move" not in moved.reason


@pytest.mark.parametrize(("tried", "verdict"), [(4, Verdict.TRUSTWORTHY), (9, Verdict.TRUSTWORTHY), (10, CHECK)])
def test_revisited_places_that_do_not_look_as_mapped_are_to_be_checked(tried, verdict):
    found = evidence(closures=[((10, 610), lie.between(POSES[10], POSES[610]))])
    closures = replace(found.closures, is_accepted=np.array([True]), tried=tried)
    assert judge(replace(found, closures=closures)).verdict is verdict


def test_a_table_holds_the_figures_of_the_steps(tmp_path):
    table = Steps()
    steps = [
        replace(step, reason=f"a new map begins {step.scan.index % 3}", starts_segment=step.scan.index == 7)
        for step in drive(20, 2)
    ]
    T_odom_base = lie.pose_2d(1.0, 2.0, 0.3)
    steps[9] = replace(steps[9], scan=replace(steps[9].scan, T_odom_base=T_odom_base))
    for step in steps:
        table.append(step)
    columns = table.columns
    assert len(table) == 20 and columns["has_wheels"].tolist() == [k == 9 for k in range(20)]
    np.testing.assert_array_equal(columns["T_odom_base"][9], T_odom_base)
    np.testing.assert_array_equal(columns["information"], [step.match.information for step in steps])
    np.testing.assert_array_equal(columns["timing"][:, 2], [step.timing.match_s for step in steps])
    write_table(tmp_path / "steps.parquet", steps_table(table, table.trajectory("T_world_lidar")))
    written = pq.ParquetFile(tmp_path / "steps.parquet").read()
    assert written["reason"].to_pylist() == [step.reason for step in steps]
    found = evidence_of(written, None)
    assert np.flatnonzero(found.starts_segment).tolist() == [7]


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


def test_a_segment_shorter_than_a_digit_of_its_times_has_one_time():
    assert Segment(Kind.LOST, 7, 8, 2, 2262.91, 2262.94).text == "scans 7 to 8 (2262.9 s): lost"
    assert Segment(Kind.LOST, 7, 9, 3, 2262.9, 2263.1).text == "scans 7 to 9 (2262.9 to 2263.1 s): lost"


class Heights(Check):
    """A check of an altimeter, as one would be added: poses of the lidar by another sensor."""

    name, kind, column, source, limit = "heights", "heights disagree", "height_innovation", "height", 3.0

    def __init__(self, evidence):
        off_m = evidence.poses[:, 1, -1] - evidence.sources[self.source][:, 1, -1]
        self.values = np.abs(off_m) / 0.1


def test_a_new_check_is_a_class_and_a_line_of_the_table(monkeypatch):
    monkeypatch.setattr("scanchain.verdict.judging.CHECKS", (*CHECKS, Heights))
    assert "heights" in judge(evidence(sources={"height": POSES})).reason
    off = POSES + marked(300, 330)[:, None, None] * np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    judged = judge(evidence(sources={"height": off}))
    assert judged.verdict is CHECK and judged.reason == "scans 300 to 330 (60.0 to 66.0 s): heights disagree"
    assert color_of_kind(judged.segments[0].kind) == color_of_kind("another kind of one's own")


def test_every_kind_of_segment_has_a_color():
    assert set(SEGMENT_COLORS) == set(Kind) and len(set(SEGMENT_COLORS.values())) == len(Kind)


def test_a_kidnapping_is_wrong_and_flagged_and_the_rest_right(tmp_path, capsys):
    log = LogSpec("office", "lms-270", "kidnapped", duration_s=8.0, dimension=2)
    case = Case(log, "no wheels")
    (row,) = vouching.measured([case], tmp_path)
    counts = row["counts"]
    assert (counts["wrong flagged"] >= 5, counts["wrong silent"]) == (True, 0)
    assert counts["right ok"] >= 40 and row["verdict"] != "trustworthy"
    (again,) = vouching.measured([case], tmp_path)
    assert again == row
    vouching.table([row])
    assert f"| 2D kidnapped | 1 | {counts['wrong flagged']} of" in capsys.readouterr().out
