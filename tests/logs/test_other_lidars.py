"""Several lidars on topics of their own in one run: frames, times, absences, and what cannot be combined."""

import json

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import Config, LogConfig, PreprocessConfig
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import absolute_error, pair
from scanchain.logs import open_log
from scanchain.logs.doctor import examine
from scanchain.odometry import FrontEnd
from scanchain.preprocess import sweep_of
from scanchain.settings import load_settings
from tests.support import made
from tests.support.messages import says
from tests.support.naive_logs import (
    SECOND,
    STAMP_NS,
    cloud_said,
    laser_points,
    laser_scan,
    point_cloud,
    scan_said,
    transforms,
    transforms_said,
    write,
)
from tests.support.scenes import shared_data
from tests.support.several_lidars import LEFT, RIGHT, on_own_topics, turned, two_lasers

STEP_NS = SECOND // 10
BOTH = ("/left", "/right")
BEAM_S = 0.003  # of 31 beams


def ranges(k):
    return 1.0 + 0.01 * k + 0.05 * np.arange(31)


def said_by(frame, k, *, step_ns=STEP_NS, shift_ns=0, late_ns=0, values=None, beam_s=BEAM_S):
    """The k-th scan of a laser of 31 beams in 93 ms, its clock shifted, logged late."""
    stamp_ns = STAMP_NS + k * step_ns + shift_ns
    data = laser_scan(stamp_ns, ranges(k) if values is None else values, frame=frame, beam_s=beam_s)
    return scan_said(stamp_ns + SECOND // 10 + late_ns, data, f"/{frame}")


def lefts(count=40):
    return [said_by("left", k) for k in range(count)]


def logged(folder, *said, static=(LEFT, RIGHT)):
    fixed = [transforms_said(STAMP_NS, transforms(*static))] if static else []
    path = write(folder / "a.mcap", sorted([*fixed, *said], key=lambda each: each.log_ns), chunk_size=4000)
    return path


def read(path, topic=BOTH, **config):
    log = open_log(path, topic=topic, **config)
    return log, list(log.scans())


def instants(scans):
    """Times of all points of the second lidar, seconds after the first stamp."""
    return np.concatenate(
        [1e-9 * (scan.stamp_ns - STAMP_NS) + each.times_s for scan in scans for each in scan.others]
    )


def test_points_of_the_others_come_in_the_frame_of_the_first_at_their_own_instants(tmp_path):
    rights = [said_by("right", k, shift_ns=30_000_000) for k in range(40)]
    log, scans = read(logged(tmp_path, *lefts(), *rights))
    assert len(scans) == 40 and log.topics == "/left, /right" and not log.damage
    T_left_right = np.linalg.inv(pose(LEFT)) @ pose(RIGHT)
    says(" ".join(log.notes), "/right is used too, moved to frame left: it is at x")
    for scan in scans[1:-1]:
        (*_, last) = scan.others
        np.testing.assert_allclose(last.origin, T_left_right[:2, 3], atol=1e-6)
        k = round((scan.stamp_ns - STAMP_NS) / STEP_NS)
        raw = np.column_stack([laser_points(ranges(k)), np.zeros(31), np.ones(31)])
        seen = (raw @ T_left_right.T)[: len(last.points), :2]
        np.testing.assert_allclose(last.points, seen, atol=1e-5)
        np.testing.assert_allclose(last.times_s, 0.03 + BEAM_S * np.arange(len(last.points)), atol=1e-6)
    alone, of_left = read(logged(tmp_path, *lefts()), "/left")
    assert all(np.array_equal(a.points, b.points) for a, b in zip(scans, of_left, strict=True))
    assert not of_left[3].others and alone.topics == "/left"


def pose(entry):
    T = turned(entry[4], flip=bool(entry[5]))
    T[:3, 3] = entry[2], entry[3], 0.5
    return T


@pytest.mark.parametrize("period_s", [0.02, 0.05, 0.09, 0.1, 0.11, 0.2])
def test_every_point_of_another_lidar_is_used_once_in_the_scan_nearest_in_time(tmp_path, period_s):
    step_ns, beam_s = round(period_s * SECOND), min(BEAM_S, 0.03 * period_s)
    count = round(4.0 / period_s)
    rights = [said_by("right", k, step_ns=step_ns, shift_ns=37_000_000, beam_s=beam_s) for k in range(count)]
    _, scans = read(logged(tmp_path, *lefts(), *rights))
    sent = (37_000_000 * 1e-9 + period_s * np.arange(count)[:, None] + beam_s * np.arange(31)).ravel()
    middle_s = 0.045
    used = sent[np.abs(sent - np.clip(sent, middle_s, middle_s + 3.9)) <= 0.125]
    np.testing.assert_allclose(np.sort(instants(scans)), np.sort(used), atol=1e-5)
    for scan in scans:
        assert all(np.abs(each.times_s - middle_s).max() < 0.051 for each in scan.others if scan.index < 39)
        assert sweep_of(scan, load_settings(2).config.preprocess).middle_s == pytest.approx(middle_s)


@pytest.mark.parametrize("every", [1, 3])
def test_a_lidar_that_is_missing_for_a_while_is_told_with_the_scans_and_the_time(tmp_path, every):
    rights = [said_by("right", k) for k in range(60) if not 10 <= k < 30 and k not in (5, 45, 46, 47)]
    path = logged(tmp_path, *lefts(60), *rights)
    log, scans = read(path, every=every)
    assert len(scans) == 60 // every
    assert {scan.index for scan in scans if not scan.others} >= {k // every for k in range(12, 28, every)}
    (note,) = log.together.absences()
    says(note, "23 of 60 scans of /left without /right", "for up to 2.1 s", "0.9 s after the first scan")
    assert note in log.notes
    (found,) = [each for each in diagnose(path).findings if each.check == "lidars"]
    assert found.severity == "warning" and found.found == note


def diagnose(path):
    return examine([path], lambda _: Config(), LogConfig(topic="/left,/right"), lambda *_: None)


def test_a_lidar_that_stops_does_not_hold_back_the_scans_of_the_first(tmp_path):
    path = logged(tmp_path, *lefts(400), *(said_by("right", k) for k in range(20)))
    log = open_log(path, topic=BOTH)
    scans = log.scans()
    received = [next(scans) for _ in range(200)]
    assert all(scan.others for scan in received[:19]) and not any(scan.others for scan in received[21:])
    assert sum(1 for _ in scans) == 200
    says(log.together.absences()[0], "380 of 400 scans of /left without /right")


def test_a_slower_lidar_is_not_missing(tmp_path):
    log, scans = read(logged(tmp_path, *lefts(), *(said_by("right", k, step_ns=3 * STEP_NS) for k in range(14))))
    assert not log.together.absences() and any(not scan.others for scan in scans)
    (found,) = [each for each in diagnose(log.paths[0]).findings if each.check == "lidars"]
    assert found.severity == "ok"


@pytest.mark.parametrize(("late_s", "is_used"), [(-0.09, True), (0.4, True), (0.9, False)])
def test_scans_wait_for_the_others_that_are_logged_late(tmp_path, late_s, is_used):
    rights = [said_by("right", k, late_ns=round(late_s * SECOND)) for k in range(40)]
    log, scans = read(logged(tmp_path, *lefts(), *rights))
    assert len(scans) == 40 and all(bool(scan.others) is is_used for scan in scans[:-1])
    assert is_used or "not used: no point is within 0.125 s of a scan" in log.together.absences()[0]


def test_unusable_messages_of_another_lidar_are_left_out_and_told(tmp_path):
    rights = [said_by("right", k, values=np.full(31, np.inf) if k == 7 else None) for k in range(40)]
    rights[9].data = rights[9].data[:60]
    log, scans = read(logged(tmp_path, *lefts(), *rights))
    assert len(scans) == 40 and log.bad_scans == 0
    says(log.damage[0], "2 messages of /right left out (the first: no valid point")


OLDER = [said_by("right", k, shift_ns=-9 * SECOND, late_ns=9 * SECOND) for k in range(9)]
ON_ITS_SIDE = (*RIGHT[:5], np.pi / 2)
CLOUDS = [
    cloud_said(
        STAMP_NS + k * STEP_NS,
        point_cloud(
            STAMP_NS,
            np.array([(1, 2, 3), (4, 5, 6), (7, 8, 2)], [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]),
            frame="right",
        ),
        "/right",
    )
    for k in range(4)
]


@pytest.mark.parametrize(
    ("static", "rights", "why"),
    [
        ((LEFT,), [said_by("right", 0)], "no static transform leads to frame left"),
        ((LEFT, ON_ITS_SIDE), [said_by("right", 0)], "tilted by 90 deg"),
        ((LEFT, RIGHT), OLDER, "its clock is 9.0 s behind that of frame left"),
        ((LEFT, RIGHT), CLOUDS, "cannot be combined with /left: one is planar, the other is not"),
        ((LEFT, RIGHT), [scan_said(STAMP_NS, b"12345678", "/right")], "no message of it can be understood"),
        ((LEFT, RIGHT), [], "has no topic /right; choose log__topic from: /left"),
    ],
    ids=["no transform", "tilted", "clock", "3D", "malformed", "absent"],
)  # fmt: skip
def test_a_lidar_that_cannot_be_combined_is_refused_in_one_line(tmp_path, static, rights, why):
    path = logged(tmp_path, *lefts(20), *rights, static=static)
    with pytest.raises(InputError) as refused:
        open_log(path, topic=BOTH)
    says(str(refused.value), "/right", why)
    assert "\n" not in str(refused.value)
    assert len(read(path, "/left")[1]) == 20


def test_lasers_on_topics_of_their_own_are_matched_as_one(tmp_path):
    one_topic = two_lasers(made.log("office", seconds=10), tmp_path / "one.mcap", width_deg=180.0)
    path = on_own_topics(one_topic, tmp_path / "two.mcap")
    both, left = (ate_m(*read(path, topic)) for topic in (BOTH, "/left"))
    assert both < 0.05 and both < left


def test_the_report_of_two_lasers_is_as_good_with_two_topics(tmp_path):
    path = on_own_topics(shared_data("reports/f3_two_lasers.mcap"), tmp_path / "two.mcap")
    assert ate_m(*read(path, ("/laser_left", "/laser_right"))) < 0.02


def ate_m(log, scans):
    config = load_settings(log.dimension).config
    front_end = FrontEnd(config, log.T_base_lidar)
    poses = np.array([front_end.locate(scan).tracked.T_odom_lidar for scan in scans])
    estimate = Trajectory(np.array([scan.stamp_ns for scan in scans]), poses)
    return absolute_error(pair(estimate, log.ground_truth()).after_start).translation_m.rmse


def test_a_spinning_and_a_forward_lidar_together_are_at_least_as_accurate_as_the_better_one():
    path, topics = shared_data("3d/pandaset_002_sweeps30to55.mcap"), ("/pandar64/points", "/pandar_gt/points")
    alone = [ate_m(*read(path, topic)) for topic in topics]
    assert ate_m(*read(path, topics)) <= min(alone) <= 0.0086
    assert ate_m(*read(path, topics[::-1])) <= 0.0086


def test_returns_from_the_housing_of_another_lidar_are_cropped_by_its_own_range(tmp_path):
    near = np.where(np.arange(31) < 5, 0.2, 3.0)
    rights = [said_by("right", k, values=near) for k in range(10)]
    _, scans = read(logged(tmp_path, *lefts(10), *rights))
    sweep = sweep_of(scans[4], PreprocessConfig(min_range_m=0.5))
    origin = scans[4].others[0].origin
    of_right = sweep.points[sweep.own :]
    assert len(of_right) and np.linalg.norm(of_right - origin, axis=1).min() > 2.9


def test_run_info_and_convert_take_several_topics(call, tmp_path):
    rights = [said_by("right", k) for k in range(20)]
    third = [scan_said(each.log_ns, each.data, "/third") for each in rights]
    path = logged(tmp_path, *lefts(20), *rights, *third)
    both = ("--topic", "/left", "--topic", "/right")
    code, output, _ = call("info", path, *both)
    assert code == 0 and "lidar     /left, /right: 2D, 20 scans" in output
    code, output, _ = call(
        "run", path, *both, "--out", tmp_path / "run", "--rerun", "off", "--error-bars", "quick"
    )
    assert code == 0 and "/left, /right (no wheel odometry" in output
    settings = json.loads((tmp_path / "run" / "run.json").read_text())
    assert "/left,/right" in json.dumps(settings)
    code, output, _ = call("convert", path, tmp_path / "both.mcap", *both)
    assert code == 0 and "/left" in output and "/right" in output and "/third" not in output
    again, scans = read(tmp_path / "both.mcap", "/left, /right")
    assert again.topics == "/left, /right" and scans[3].others
    assert lie.apart(again.T_base_lidar, lie.pose_2d(0.3, 0.1, 0.5))[0] < 1e-6
