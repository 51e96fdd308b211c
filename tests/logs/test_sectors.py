"""Messages that are sectors of a revolution are assembled to sweeps; other logs are read as they are."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from mcap.reader import make_reader

from scanchain import Odometry
from scanchain.config import Config, LogConfig
from scanchain.logs import open_log
from scanchain.logs.doctor import examine
from scanchain.simulation import SENSORS
from tests.support.messages import says
from tests.support.naive_logs import STAMP_NS, Said, laser_scan, point_cloud, scan_said, write
from tests.support.naive_logs import cloud_said as cloud
from tests.support.scenes import configured, shared_data
from tests.support.sectors import PERIOD_NS, Cut, cut, whole

SPATIAL, PLANAR = ("town", 3, "vlp-16"), ("office", 3, "all-around")


def read(path, **config):
    log = open_log(path, LogConfig(**config))
    return log, list(log.scans())


def raw(path):
    with path.open("rb") as stream:
        yield from make_reader(stream).iter_messages()


def sweeps(tmp_path, how, of=SPATIAL, **config):
    """The scans of the whole log, and the log that is cut with its scans."""
    source = whole(*of)
    return list(open_log(source).scans()), *read(cut(source, tmp_path / "cut.mcap", how), **config)


def assert_same(scans, expected, *, within_s=2e-6):
    assert len(scans) == len(expected)
    for scan, known in zip(scans, expected, strict=True):
        assert (scan.stamp_ns, scan.log_time_ns) == (known.stamp_ns, known.log_time_ns)
        assert scan.points.shape == known.points.shape
        assert np.allclose(scan.points, known.points, atol=1e-4)  # float32 of the angles of laser scans
        assert np.allclose(scan.times_s, known.times_s, atol=within_s)
        assert np.array_equal(scan.T_odom_base, known.T_odom_base)


@pytest.mark.parametrize("of", [SPATIAL, PLANAR], ids=["space", "plane"])
@pytest.mark.parametrize(
    "how",
    [
        Cut(30.0), Cut(90.0), Cut(120.0), Cut(180.0), Cut(5.0),
        Cut(30.0, unit="us"), Cut(90.0, unit="ms"), Cut(180.0, unit="s"),
    ],
    ids=str,
)  # fmt: skip
def test_sectors_make_the_sweeps_that_they_were_cut_from(tmp_path, how, of):
    if of is PLANAR and (how.times, how.unit) != ("message", "ns"):
        pytest.skip("beams of laser scans count from the stamp, in seconds")
    expected, log, scans = sweeps(tmp_path, how, of)
    assert log.scan_count == len(expected)
    assert_same(scans, expected)
    topic, count = log.topic, round(360 / how.width_deg)
    holds = f"{topic}: each message covers {how.width_deg:g}° of a revolution"
    assert f"{holds}: {count} messages are assembled to one sweep" in log.notes
    assert not any("azimuth" in note for note in log.notes)


def test_times_count_from_the_stamp_of_the_sweep_where_sectors_are_stamped_at_their_ends(tmp_path):
    expected, _, scans = sweeps(tmp_path, Cut(90.0, stamp="end"))
    assert len(scans) == len(expected)
    for scan, known in zip(scans, expected, strict=True):
        assert scan.stamp_ns == known.stamp_ns + PERIOD_NS // 4
        assert np.allclose(scan.times_s, known.times_s - 0.025, atol=2e-6)


UNTIMED = [Cut(w, times="none") for w in (5.0, 30.0, 90.0, 180.0)]


@pytest.mark.parametrize(
    "how", [*UNTIMED, Cut(30.0, times="sweep"), Cut(90.0, times="sweep", stamp="sweep")], ids=str
)
@pytest.mark.parametrize("of", [SPATIAL, PLANAR], ids=["space", "plane"])
def test_points_without_times_of_their_message_are_timed_by_their_place_in_the_revolution(tmp_path, how, of):
    expected, log, scans = sweeps(tmp_path, how, of)
    assert_same(scans, expected, within_s=3e-3)
    if of is SPATIAL:
        says(log.assumed_point_times(), "by the azimuth: clockwise, 0.1 s per turn")
        assert log.assumed_point_times() in log.notes


@pytest.mark.parametrize("how", [Cut(100.0), Cut(100.0, times="none"), Cut(7.0), Cut(150.0)], ids=str)
@pytest.mark.parametrize("of", [SPATIAL, PLANAR], ids=["space", "plane"])
def test_sectors_that_do_not_divide_the_revolution_are_split_at_its_end(tmp_path, how, of):
    expected, log, scans = sweeps(tmp_path, how, of)
    assert abs(log.scan_count - len(expected)) <= 1 and abs(len(scans) - len(expected)) <= 1
    both = (np.concatenate([scan.points for scan in each]) for each in (scans, expected))
    points, known = both
    assert np.allclose(points, known[: len(points)], atol=1e-4) and len(points) > 0.98 * len(known)
    stamps_ns = np.array([scan.stamp_ns for scan in scans])
    assert np.allclose(np.diff(stamps_ns), PERIOD_NS, rtol=0.05)
    for scan in scans[1:-1]:
        assert scan.times_s.min() > -0.005 and 0.09 < np.ptp(scan.times_s) < 0.105


def test_sectors_are_recognized_in_a_file_of_one_message_a_chunk(tmp_path):
    path = cut(whole(*PLANAR), tmp_path / "cut.mcap", Cut(30.0))
    said = [
        Said(channel.topic, schema.name, message.log_time, message.data) for schema, channel, message in raw(path)
    ]
    log = open_log(write(tmp_path / "chunks.mcap", said, chunk_size=1))
    assert log.scan_count == 30 and log.sectors.per_sweep == 12


def test_sectors_that_overlap_make_sweeps_too(tmp_path):
    expected, log, scans = sweeps(tmp_path, Cut(90.0, overlap_deg=15.0))
    assert [scan.stamp_ns for scan in scans] == [scan.stamp_ns for scan in expected]
    assert log.scan_count == len(expected)


def test_sweeps_behind_missing_sectors_begin_where_they_should(tmp_path):
    dropped = (5, 24, 12 * 6 + 11, *range(12 * 9 + 4, 12 * 9 + 7))
    expected, log, scans = sweeps(tmp_path, Cut(30.0, dropped=dropped))
    assert log.scan_count == len(scans) == len(expected)
    affected = {number // 12 for number in dropped}
    right = [k for k in range(len(scans)) if k not in affected]
    assert_same([scans[k] for k in right], [expected[k] for k in right])
    assert all(0.7 < len(scans[k].points) / len(expected[k].points) < 0.95 for k in affected)


def test_a_gap_of_more_than_a_revolution_ends_a_sweep(tmp_path):
    expected, log, scans = sweeps(tmp_path, Cut(30.0, dropped=tuple(range(12 * 9 + 2, 12 * 12 + 5))))
    assert_same(scans[:9], expected[:9])
    assert max(np.ptp(scan.times_s) for scan in scans) < 0.101  # no sweep across the gap
    assert abs(scans[9].stamp_ns - expected[12].stamp_ns - 5 * PERIOD_NS // 12) <= 1
    assert any(
        "1 sweep of /points left out" in note or "2 sweeps of /points left out" in note for note in log.notes
    )


def test_sectors_without_a_return_are_no_bad_scans(tmp_path):
    empty = (*range(7, 360, 12), 3, 100)
    for of in (SPATIAL, PLANAR):
        expected, log, scans = sweeps(tmp_path, Cut(30.0, empty=empty), of)
        assert len(scans) == len(expected) and log.damage == [] and log.bad_scans == 0
        assert [scan.stamp_ns for scan in scans] == [scan.stamp_ns for scan in expected]


def test_parts_and_every_count_sweeps(tmp_path):
    expected, log, scans = sweeps(tmp_path, Cut(30.0), every=3)
    assert_same(scans, expected[::3])
    assert log.scan_count == len(scans)
    assert_same(list(log.scans()), scans)  # as a run needs that resumes
    log, scans = read(tmp_path / "cut.mcap", start_s=1.0, end_s=2.0)
    assert abs(log.scan_count - len(scans)) <= 1 and 9 <= len(scans) <= 10
    assert all(np.ptp(scan.times_s) < 0.101 for scan in scans)
    assert min(len(scan.points) for scan in scans[:-1]) > 0.9 * len(expected[0].points)


def test_info_doctor_and_run_name_the_sectors_and_count_sweeps(call, tmp_path):
    path = cut(whole(*SPATIAL), tmp_path / "cut.mcap", Cut(90.0))
    line = "/points: each message covers 90° of a revolution: 4 messages are assembled to one sweep"
    code, output, _ = call("info", path)
    assert code == 0
    says(output, line, "120 messages", "/points: 3D, 30 scans")
    found = examine([path], lambda _: Config(), LogConfig(), lambda *_: None)
    assert line in found.notes
    findings = {finding.check: finding for finding in found.findings}
    assert {findings[name].severity for name in ("gaps", "wheels", "point times", "damage")} == {"ok"}
    says(findings["point times"].found, "a scan lasts 99.")
    code, output, _ = call("run", path, "--out", tmp_path / "run", "--rerun", "off")
    assert code == 0
    says(output, line, "scans          30 over")


@pytest.mark.parametrize("of", [SPATIAL, PLANAR], ids=["space", "plane"])
@pytest.mark.parametrize("times", ["message", "none"])
def test_a_run_and_doctor_name_the_azimuth_where_it_times_the_points_of_sectors_and_only_there(
    tmp_path, of, times
):
    path = cut(whole(*of), tmp_path / "cut.mcap", Cut(90.0, times=times))
    log, _ = read(path)
    found = {finding.check: finding.found for finding in _findings(path)}["point times"]
    for said in ("; ".join(log.notes), found):
        assert ("by the azimuth: " in said) == (times == "none") and "counts as measured at once" not in said


def _findings(path):
    return examine([path], lambda _: Config(), LogConfig(), lambda *_: None).findings


@pytest.mark.parametrize("width_deg", [30.0, 100.0])
def test_odometry_over_sectors_is_as_good_as_over_sweeps(tmp_path, width_deg):
    expected, log, scans = sweeps(tmp_path, Cut(width_deg))
    ends = []
    for each in (expected, scans):
        odometry = Odometry(configured(3), log.T_base_lidar)
        steps = [odometry.process(replace(scan, T_odom_base=None)) for scan in each[:20]]
        assert all(step.state == "ok" for step in steps)
        ends.append([step.T_odom_lidar for step in steps])
    assert np.allclose(*(np.array(poses)[:, :3, 3] for poses in ends), atol=0.03)


def rosette(tmp_path, scans_hz=100):
    """A solid-state lidar that draws a rosette ahead, in short messages."""
    rays, said = SENSORS["rosette"].rays, []
    points = np.concatenate([8.0 * rays(k).directions for k in range(3)]).astype("f4")
    for k, part in enumerate(np.array_split(points, 3 * scans_hz // 10)):
        rows = np.rec.fromarrays(part.T, dtype=[(name, "<f4") for name in "xyz"])
        stamp_ns = STAMP_NS + k * (1_000_000_000 // scans_hz)
        said.append(cloud(stamp_ns, point_cloud(stamp_ns, rows)))
    return write(tmp_path / "rosette.mcap", said)


def lasers(tmp_path, frames, turn=0.0):
    """Laser scans of 120° each, ahead or in turn around, in frames that alternate."""
    said = []
    for k in range(30):
        stamp_ns = STAMP_NS + k * 50_000_000
        data = laser_scan(
            stamp_ns, np.full(120, 5.0), first=k * turn - 1.0, step=np.pi / 180, frame=frames[k % len(frames)]
        )
        said.append(scan_said(stamp_ns, data))
    return write(tmp_path / "lasers.mcap", said)


HEALTHY = {
    "a sweep": lambda _: whole(*SPATIAL),
    "a laser all around": lambda _: whole(*PLANAR),
    "a laser of 270°": lambda _: whole("office", 3, "lms-270"),
    "a rosette": lambda _: whole("town", 3, "rosette"),
    "a rosette in short messages": rosette,
    "a laser ahead": lambda tmp_path: lasers(tmp_path, ["laser"]),
    "lasers in two frames": lambda tmp_path: lasers(tmp_path, ["front", "rear"], turn=np.pi),
    "a laser that turns slowly": lambda tmp_path: lasers(tmp_path, ["laser"], turn=0.6),
    "SICK": lambda _: shared_data("2d/mit_csail.mcap"),
    "two lasers": lambda _: shared_data("reports/f3_two_lasers.mcap"),
    "KITTI": lambda _: shared_data("3d/kitti_0001_first54.mcap"),
}


@pytest.mark.parametrize("made", HEALTHY.values(), ids=HEALTHY)
def test_other_lidars_are_read_message_by_message(tmp_path, made):
    log = open_log(made(tmp_path))
    assert log.sectors is None and not any("revolution" in note for note in log.notes)


@pytest.mark.parametrize("topic", ["/pandar_gt/points", "/pandar64/points"])
def test_neither_lidar_of_pandaset_is_assembled(topic):
    assert open_log(shared_data("3d/pandaset_002_sweeps30to55.mcap"), topic=topic).sectors is None


@pytest.mark.slow
def test_scans_that_slip_do_not_convict_the_wheels(tmp_path):
    log = open_log(cut(whole("town", 3, "os1-32"), tmp_path / "cut.mcap", Cut(30.0, times="none")))
    log.sectors = None  # as if they had not been recognized
    odometry = Odometry(configured(3), log.T_base_lidar)
    steps = [odometry.process(scan) for scan in islice(log.scans(), 300)]
    assert sum(step.state != "ok" for step in steps) > 100
    assert odometry.predictor.wheels.warnings() == ()
