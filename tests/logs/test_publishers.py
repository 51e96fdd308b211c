"""Several publishers on one topic, by frame and clock; static transforms that disagree; clocks that jump."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import Config, LogConfig
from scanchain.data import Trajectory
from scanchain.evaluation import absolute_error, pair
from scanchain.logs import open_log
from scanchain.logs.doctor import examine
from scanchain.logs.info import describe
from scanchain.odometry import FrontEnd
from scanchain.settings import load_settings
from scanchain.slam import Slam
from tests.support import made
from tests.support.messages import says
from tests.support.naive_logs import (
    SECOND,
    STAMP_NS,
    cloud_said,
    laser_points,
    laser_scan,
    odometry,
    odometry_said,
    point_cloud,
    scan_said,
    transforms,
    transforms_said,
    write,
)
from tests.support.scenes import shared_data
from tests.support.several_lidars import LEFT, RIGHT, looped, turned, two_lasers

STEP_NS = SECOND // 10
HANGING = (*RIGHT[:5], np.pi)
ON_ITS_SIDE = (*RIGHT[:5], np.pi / 2)


def pose(x, y, yaw, roll):
    T = turned(yaw, flip=bool(roll))
    T[:3, 3] = x, y, 0.5
    return T


def at(k):
    return STAMP_NS + k * STEP_NS


def ranges(k):
    return 1.0 + 0.01 * k + 0.05 * np.arange(31)


def said_by(k, frame, values=None, *, stamp_ns=None, log_ns=None):
    data = laser_scan(
        at(k) if stamp_ns is None else stamp_ns, ranges(k) if values is None else values, frame=frame
    )
    return scan_said(at(k) if log_ns is None else log_ns, data)


def in_turn(count=40, *, frames=("left", "right")):
    return [said_by(k, frames[k % len(frames)]) for k in range(count)]


def read(path, **config):
    log = open_log(path, **config)
    return log, list(log.scans())


def diagnose(path):
    found = examine([path], lambda _: Config(), LogConfig(), lambda *_: None)
    return {finding.check: finding for finding in found.findings}


@pytest.mark.parametrize("right", [RIGHT, HANGING], ids=["upright", "upside down"])
@pytest.mark.parametrize("left", [LEFT, (*LEFT[:5], np.pi)], ids=["upright", "upside down"])
def test_each_message_has_the_mounting_of_its_own_frame(tmp_path, left, right):
    static = transforms_said(STAMP_NS, transforms(left, right))
    log, scans = read(write(tmp_path / "a.mcap", [static, *in_turn()]))
    assert len(scans) == 40 and not log.damage
    for k, scan in enumerate(scans):
        raw = np.column_stack([laser_points(ranges(k)), np.zeros(31), np.ones(31)])
        in_base = (raw @ pose(*(left, right)[k % 2][2:]).T)[:, :2]
        np.testing.assert_allclose(lie.transform(log.T_base_lidar, scan.points), in_base, atol=1e-5)
    (note,) = [line for line in log.notes if "frame right" in line]
    says(note, "moved to frame left")
    only_left, of_left = read(write(tmp_path / "b.mcap", [static, *in_turn()[::2]]))
    assert all(np.array_equal(a.points, b.points) for a, b in zip(scans[::2], of_left, strict=True))
    assert not any("frame right" in line for line in only_left.notes) and not of_left[3].others


def test_each_cloud_has_the_mounting_of_its_own_frame(tmp_path):
    rows = np.zeros(200, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")]))
    for name, values in zip("xyz", np.random.default_rng(0).uniform(-9.0, 9.0, (3, 200)), strict=True):
        rows[name] = values
    frames = ("left", "right")
    said = [cloud_said(at(k), point_cloud(at(k), rows, frame=frames[k % 2])) for k in range(20)]
    log, scans = read(write(tmp_path / "a.mcap", [transforms_said(STAMP_NS, transforms(LEFT, HANGING)), *said]))
    expected = np.column_stack([rows[name] for name in "xyz"])
    for k, scan in enumerate(scans):
        in_base = lie.transform(pose(*(LEFT, HANGING)[k % 2][2:]), expected)
        np.testing.assert_allclose(lie.transform(log.T_base_lidar, scan.points), in_base, atol=1e-5)


@pytest.mark.parametrize("right", [None, ON_ITS_SIDE], ids=["without a transform", "on its side"])
def test_a_frame_that_cannot_be_joined_is_left_out_counted_and_named_with_the_other(tmp_path, right):
    said = [said_by(k, "right" if k % 4 == 0 else "left") for k in range(40)]  # the first is not that with most
    static = transforms_said(STAMP_NS, transforms(*(each for each in (LEFT, right) if each)))
    path = write(tmp_path / "a.mcap", [static, *said], chunk_size=1_000_000)
    log, scans = read(path)
    assert len(scans) == 30 and log.mounting.T_base_lidar[0, 3] == 0.3
    says(log.damage[0], "10 of 40 messages of /scan left out", "frame right", "the one used is frame left")
    says(
        " ".join(log.notes),
        "frame right",
        "frame left",
        "no static transform" if right is None else "tilted by 90",
    )
    assert len(read(path, every=2)[1]) == 15  # of those that are used
    assert "frame right" in " ".join(describe([path], LogConfig())["notes"])


def test_empty_scans_of_another_publisher_do_not_end_a_run(tmp_path):
    nothing = np.full(31, np.inf)
    simulated = [
        said_by(k, "simulated", nothing, stamp_ns=900 * SECOND + k * STEP_NS, log_ns=at(k) + 20_000_000)
        for k in range(40)
    ]
    real = [said_by(k, "real") for k in range(2, 40)]
    log, scans = read(write(tmp_path / "a.mcap", sorted([*simulated, *real], key=lambda each: each.log_ns)))
    assert len(scans) == 38 and log.bad_scans == 0
    says(log.damage[0], "40 of 78 messages", "frame simulated (stamps 900.0 to 903.9 s, 0 % with returns)")
    says(log.damage[0], "the one used is frame real (stamps 1700000000.2 to 1700000003.9 s, 100 % with returns)")


def test_a_real_lidar_beside_a_simulators_empty_scans_is_read_without_a_flag():
    log, scans = read(shared_data("reports/two_publishers.db3"))
    assert len(scans) == 263 and log.mounting.note == ""
    says(" ".join(log.damage), "259 of 522", "frame laser_frame", "0 % with returns", "frame base_laser")


@pytest.mark.parametrize("other", [("base_link", "laser"), ("base_footprint", "laser")])
def test_of_static_transforms_that_disagree_the_latest_is_used_and_both_are_told(tmp_path, other):
    said = [
        transforms_said(STAMP_NS, transforms(("base_link", "laser", 0.1, 0.0, 0.0, 0.0))),
        transforms_said(STAMP_NS + 1, transforms(("base_link", "base_footprint", 0.0, 0.0, 0.0, 0.0))),
        transforms_said(STAMP_NS + 2, transforms((*other, 0.4, 0.0, np.pi / 2, 0.0))),
        *in_turn(frames=("laser",)),
    ]
    log, _ = read(write(tmp_path / "a.mcap", said))
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.4, 0.0, np.pi / 2), atol=1e-9)
    if other[0] == "base_link":
        says(" ".join(log.notes), "base_link → laser", "x 0.100 m", "x 0.400 m", "yaw 90 deg", "as in tf2")
    same = [
        said[0],
        transforms_said(STAMP_NS + 1, transforms(("base_link", "laser", 0.1, 0.0, 0.0, 0.0))),
        *said[3:],
    ]
    assert "tf_static" not in " ".join(read(write(tmp_path / "b.mcap", same))[0].notes)


def ate_m(log, scans):
    config = load_settings(2).config
    front_end = FrontEnd(config, log.T_base_lidar)
    poses = np.array([front_end.locate(scan).tracked.T_odom_lidar for scan in scans])
    estimate = Trajectory(np.array([scan.stamp_ns for scan in scans]), poses)
    return absolute_error(pair(estimate, log.ground_truth())).translation_m.rmse


@pytest.mark.parametrize(("width_deg", "is_flipped"), [(180.0, False), (180.0, True), (120.0, False)])
def test_lasers_that_look_apart_are_matched_as_one(tmp_path, width_deg, is_flipped):
    source = made.log("office", seconds=10)
    path = two_lasers(source, tmp_path / "two.mcap", width_deg=width_deg, is_flipped=is_flipped)
    assert ate_m(*read(path)) < 0.05


def test_the_report_of_two_lasers_is_as_good_as_one_laser():
    log, scans = read(shared_data("reports/f3_two_lasers.mcap"))
    assert len(scans) == 119 and ate_m(log, scans) < 0.02


# clocks


def stamped(shift_s, count=60, **options):
    """A drive whose stamps are shifted at each scan."""
    return [said_by(k, "laser", stamp_ns=at(k) + round(shift_s(k) * SECOND), **options) for k in range(count)]


@pytest.mark.parametrize(
    ("shift_s", "size", "cause"),
    [
        (lambda k: -2.9 if k >= 30 else 0.0, "-2.8 s", "played in a loop"),
        (lambda k: -400.0 if k >= 30 else 0.0, "-6.7 min", "set back"),
        (lambda k: 7.0 if k >= 30 else 0.0, "+7.1 s", "skipped a part"),
        (lambda k: 1e6 if k >= 30 else 0.0, "+11.6 days", "skipped a part"),
    ],
)
def test_a_clock_that_jumps_is_named_and_starts_a_segment(tmp_path, shift_s, size, cause):
    path = write(tmp_path / "a.mcap", stamped(shift_s))
    log, scans = read(path)
    assert [scan.index for scan in scans if scan.clock_jump_s] == [30]
    says(log.damage[0], "1 jump of the header stamps of /scan", size, "at scan 30", cause, "new segment")
    found = diagnose(path)
    assert found["stamps"].severity == "warning" and size in found["stamps"].found
    assert found["damage"].severity == "ok"
    every_third = [scan.index for scan in read(path, every=7)[1] if scan.clock_jump_s]
    assert every_third == [5]  # which is scan 35
    slam = Slam(load_settings(2).config, log.T_base_lidar)
    assert [k for k, scan in enumerate(scans) if slam.process(scan).starts_segment] == [30]


@pytest.mark.parametrize(
    "said",
    [
        stamped(lambda k: 9.0 if k in (20, 41) else -9.0 if k == 30 else 0.0),  # single wrong ones
        stamped(lambda k: -0.9 if 30 <= k < 34 else 0.0),  # as in Intel
        stamped(lambda k: float(np.random.default_rng(k).uniform(-0.5, 0.5))),
        [said_by(k, "laser", log_ns=max(at(k), at(40)) if k > 9 else at(k)) for k in range(80)],  # late, at once
        [said_by(k, "laser", log_ns=max(at(k), at(40)) if k > 9 else at(k)) for k in range(80) if not 12 < k < 35],
        [said_by(k + 50 * (k > 30), "laser") for k in range(60)],  # paused, by both clocks
        [said_by(k, "laser", log_ns=at(k + 50 * (k > 30))) for k in range(60)],  # played with a pause
        [said_by(k, "laser", stamp_ns=0 if k < 9 else None) for k in range(60)],  # before the first /clock
        [
            said_by(k, "laser", stamp_ns=at(k) - 20 * SECOND * (k < 2)) for k in range(60)
        ],  # the first ones are stale
        [
            said_by(k, "laser", stamp_ns=at(k + 90 * (k == 59)), log_ns=(1 << 64) - 90 + k if k > 57 else at(k))
            for k in range(60)
        ],  # damaged
    ],
    ids=[
        "wrong",
        "jitter",
        "noise",
        "late",
        "late and lost",
        "paused",
        "waited",
        "without clock",
        "stale",
        "damaged",
    ],
)
def test_stamps_that_are_wrong_late_or_paused_do_not_jump(tmp_path, said):
    log, scans = read(write(tmp_path / "a.mcap", said))
    assert not any(scan.clock_jump_s for scan in scans) and not log.jumps


def test_steps_back_of_the_stamps_are_counted_with_their_size_and_gaps_have_the_period(tmp_path):
    path = write(tmp_path / "a.mcap", stamped(lambda k: -0.35 if k in (20, 30) else 0.0))
    assert "2 steps back in the header stamps of /scan, by up to 0.25 s" in " ".join(read(path)[0].notes)
    finding = diagnose(path)["stamps"]
    assert (finding.severity, finding.found) == ("note", "2 steps back, by up to 0.25 s")
    assert "2.5 periods of 0.1 s" in diagnose(path)["gaps"].found


def test_laps_of_a_recording_played_in_a_loop_are_joined_and_never_trusted_in_silence(tmp_path, call):
    path = looped(made.log("office", seconds=6), tmp_path / "laps.mcap", laps=2)
    code, output, errors = call("run", path, "--out", tmp_path / "run", "--rerun", "off")
    assert code == 0 and "1 jump of the header stamps of /scan" in errors and "trustworthy (" not in output
    found = describe([path], LogConfig())
    assert found["problem"] == ""


def test_wheels_of_before_a_jump_are_none_of_the_scans_behind_it(tmp_path):
    said = []
    for k in range(60):
        stamp_ns = at(k % 30)
        said.append(odometry_said(at(k), odometry(stamp_ns, 5.0 * (k >= 30) + 0.01 * k, 0.0)))
        said.append(said_by(k, "laser", stamp_ns=stamp_ns + 50_000_000, log_ns=at(k) + 50_000_000))
    _, scans = read(write(tmp_path / "a.mcap", said))
    moved_m = [np.nan if scan.T_odom_base is None else scan.T_odom_base[0, 2] for scan in scans]
    assert np.isfinite(moved_m).sum() >= 58 and np.nanmax(moved_m[:30]) < 1.0 and np.nanmin(moved_m[30:]) > 5.0


def test_log_times_of_0_before_the_first_clock_neither_stretch_a_log_nor_move_its_parts(tmp_path):
    said = [said_by(k, "laser", log_ns=0 if k < 5 else None) for k in range(60)]
    path = write(tmp_path / "a.mcap", said)
    log, scans = read(path)
    assert log.duration_s == pytest.approx(5.4) and len(scans) == 60
    assert {scan.log_time_ns for scan in scans[:6]} == {at(5)}
    assert "5 messages of log time 0" in log.notes[0]
    assert len(read(path, start_s=1.0)[1]) == 45 and len(read(path, end_s=1.0)[1]) == 16
    finding = diagnose(path)["gaps"]
    assert (finding.severity, finding.fix) == ("ok", "")
    (topic,) = [each for each in describe([path], LogConfig())["topics"] if each["topic"] == "/scan"]
    assert topic["rate_hz"] == pytest.approx(59 / 5.4)
    healthy = [said_by(k, "laser", stamp_ns=k * STEP_NS, log_ns=k * STEP_NS) for k in range(20)]
    log, _ = read(write(tmp_path / "b.mcap", healthy))
    assert log.duration_s == pytest.approx(1.9) and "log time 0" not in " ".join(log.notes)
