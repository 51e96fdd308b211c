"""From files to scans: containers, order, prior, mounting, selection; then the real logs."""

import itertools
import threading
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import IndexType

from scanchain import lie
from scanchain.__main__ import main
from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log, stream
from scanchain.logs.info import describe
from scanchain.logs.opening import index_files
from tests.support import made
from tests.support.messages import says
from tests.support.naive_logs import (
    SECOND,
    STAMP_NS,
    cloud_said,
    decoded,
    laser_points,
    laser_scan,
    odometry,
    odometry_said,
    office,
    point_cloud,
    scan_said,
    transforms,
    transforms_said,
    write,
)
from tests.support.recorders import read
from tests.support.scenes import shared_data


def assert_office(log, scans, count=40):
    assert (log.dimension, log.topic, log.scan_count, len(scans)) == (2, "/scan", count, count)
    assert [scan.index for scan in scans] == list(range(count))
    assert log.damage == () or list(log.damage) == []
    for k, scan in enumerate(scans):
        assert scan.stamp_ns == scan.log_time_ns == STAMP_NS + k * SECOND // 10
        assert scan.points.dtype == np.float32 and scan.points.flags.c_contiguous
        np.testing.assert_allclose(scan.points, laser_points(1.0 + k / 100 + 0.05 * np.arange(31)), atol=1e-6)
        assert scan.times_s.shape == (0,) and scan.dropped == 0
        np.testing.assert_allclose(scan.T_odom_base, lie.pose_2d(0.1 * k, 0.0, 0.01 * k), atol=1e-12)


CONTAINERS = [
    *({"compression": each, "summary": summary} for each in ("none", "lz4", "zstd") for summary in (0, 1)),
    {"repeat_channels": False},
    {"repeat_schemas": False},
    {"repeat_channels": False, "repeat_schemas": False},
    {"use_statistics": False},
    {"index_types": IndexType.NONE},
    {"index_types": IndexType.CHUNK, "use_statistics": False},
    {"use_summary_offsets": False},
    {"crcs": False},
    {"chunk_size": 100},
    {"chunk_size": 10_000_000},
    {"enable_data_crcs": True},
    {"encoding": "ros2idl"},
    {"encoding": "ros2msg", "rename": lambda kind: kind.replace("/msg/", "/")},
]


@pytest.mark.parametrize("options", CONTAINERS, ids=lambda options: " ".join(options))
@pytest.mark.parametrize("chunked", [True, False])
def test_every_container_gives_the_same_scans(tmp_path, chunked, options):
    log, scans = read(write(tmp_path / "a.mcap", office(), chunked=chunked, **options))
    assert_office(log, scans)
    assert log.odometry_topic and log.duration_s == pytest.approx(3.9)
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.2, 0.1, 0.3), atol=1e-12)


def test_messages_come_by_log_time_even_where_chunks_overlap(tmp_path):
    said = office()
    shuffled = [said[i] for i in np.random.default_rng(1).permutation(len(said))]
    for chunked in (True, False):
        assert_office(*read(write(tmp_path / f"{chunked}.mcap", shuffled, chunked=chunked, chunk_size=600)))


def test_several_files_are_one_log_whatever_their_order_and_ids(tmp_path):
    said = office()
    first = write(tmp_path / "0.mcap", said[:31])
    second = write(tmp_path / "1.mcap", [said[32], said[31], *said[33:]], compression="lz4", chunked=False)
    assert_office(*read(first, second))
    assert_office(*read(second, first))
    assert read(second, first)[0].damage == []


def test_interleaved_files_with_equal_times_keep_the_order_of_the_files(tmp_path):
    near = [scan_said(STAMP_NS + k * SECOND, laser_scan(STAMP_NS, [1.0, 1.0])) for k in range(5)]
    far = [scan_said(STAMP_NS + k * SECOND, laser_scan(STAMP_NS, [2.0, 2.0])) for k in range(5)]
    log, scans = read(write(tmp_path / "near.mcap", near), write(tmp_path / "far.mcap", far))
    assert "near.mcap and far.mcap both contain /scan for 4.0 s" in log.damage[-1]
    ranges = [np.linalg.norm(scan.points[0]) for scan in scans]
    assert ranges == pytest.approx([1.0, 2.0] * 5)
    assert [scan.log_time_ns for scan in scans] == sorted(scan.log_time_ns for scan in scans)


def test_a_channel_announced_in_an_empty_chunk_does_not_stretch_the_log(tmp_path):
    path = write(tmp_path / "a.mcap", office(), announced=[odometry_said(0, b"", "/other")], chunk_size=1)
    log, scans = read(path, odometry_topic="/odom")
    assert log.duration_s == pytest.approx(3.9)
    assert_office(log, scans)


def test_start_end_and_every_choose_scans_by_log_time(tmp_path):
    path = write(tmp_path / "a.mcap", office())
    log, scans = read(path, start_s=1.0, end_s=2.0)
    assert [scan.stamp_ns - STAMP_NS for scan in scans] == [k * SECOND // 10 for k in range(10, 21)]
    assert log.scan_count == 11
    log, scans = read(path, start_s=0.5, every=3)
    assert [scan.stamp_ns - STAMP_NS for scan in scans] == [k * SECOND // 10 for k in range(5, 40, 3)]
    assert log.scan_count == len(scans) == 12
    assert [scan.index for scan in scans] == list(range(12))


def test_the_log_can_be_read_again_and_closed_early_and_is_read_only_a_few_chunks_ahead(tmp_path, monkeypatch):
    path, opened, real = write(tmp_path / "a.mcap", office(400), chunk_size=500), [], stream.read_block
    monkeypatch.setattr(stream, "read_block", lambda *args: opened.append(1) or real(*args))
    before = threading.active_count()
    log = open_log(path)
    iterator = log.scans()
    assert [scan.index for scan in itertools.islice(iterator, 3)] == [0, 1, 2]
    iterator.close()
    assert threading.active_count() == before and len(opened) <= 18  # three to see that it looks one way
    assert len(list(log.scans())) == len(list(log.scans())) == 400


def test_a_gap_between_two_files_is_a_note_and_one_of_more_than_a_day_refused(tmp_path):
    hour_ns = 3600 * SECOND
    first = write(tmp_path / "b.mcap", office(40))

    def after(gap_ns, **config):
        return open_log([write(tmp_path / "a.mcap", office(40, begin_ns=STAMP_NS + gap_ns)), first], **config)

    note = next(note for note in after(23 * hour_ns).notes if note.startswith("no message for "))
    assert note.startswith("no message for 23.0 h from 3.9 s on between b.mcap and a.mcap; read as one log")
    for log in (after(23 * hour_ns, end_s=3.0), after(23 * hour_ns, start_s=23 * 3600.0), after(10 * SECOND)):
        assert not any("no message" in note for note in log.notes)
    year_ns = 8766 * hour_ns
    line = r"b.mcap ends 2.0 years before .*a.mcap begins, so they are not parts of one log; run each separately"
    with pytest.raises(InputError, match=line):
        after(2 * year_ns)
    assert line[:6] in describe([tmp_path], LogConfig())["problem"]
    assert after(2 * year_ns, end_s=3.0).scan_count < 40
    mounts = transforms_said(STAMP_NS - year_ns, transforms(("base_link", "laser", 0.2, 0.1, 0.3, 0.0)))
    calibration = write(tmp_path / "calibration.mcap", [mounts])  # which holds no scan
    assert open_log([calibration, first]).scan_count == 40


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="needs Linux to say what is in memory")
def test_what_has_been_read_of_a_file_does_not_stay_in_memory(tmp_path):
    path = made.log("town", tmp_path, seconds=3, sensor="os1-32")
    log = open_log(path)
    assert sum(1 for _ in log.scans()) == 30
    lines = iter(Path("/proc/self/smaps").read_text().splitlines())
    next(line for line in lines if line.endswith(str(path)))
    resident_kib = next(int(entry.split()[1]) for entry in lines if entry.startswith("Rss:"))
    assert 1024 * resident_kib < 0.2 * path.stat().st_size


def blinded(*at):
    """Scans without a return, at these seconds."""
    return [scan_said(STAMP_NS + k * SECOND, laser_scan(STAMP_NS, [np.nan] * 5)) for k in at]


def test_more_bad_scans_than_the_limit_in_percent_are_refused_with_the_flag(tmp_path):
    path = write(tmp_path / "a.mcap", [*office(10), *blinded(5, 7)])
    with pytest.raises(InputError, match=r"scan 10 of /scan .*max_bad_scans_percent \(0\) allows; raise it"):
        read(path, max_bad_scans_percent=0.0)
    with pytest.raises(InputError, match=r"scan 11 of /scan has no valid point .* with it 2 of 12 scans cannot"):
        read(path, max_bad_scans_percent=8.0)
    assert len(read(path, max_bad_scans_percent=9.0)[1]) == 10


def test_bad_scans_are_left_out_and_counted(tmp_path):
    log, scans = read(write(tmp_path / "a.mcap", [*office(10), *blinded(5)]))
    assert [scan.index for scan in scans] == list(range(10))
    (line,) = log.damage  # which does not say that scans were recovered: nothing is damaged
    assert "1 of 11 scans of /scan was left out (the first: " in line
    with pytest.raises(InputError, match=r"a\.mcap: no scan of /scan could be read: 2 of 2"):
        read(write(tmp_path / "a.mcap", blinded(5, 7)), max_bad_scans_percent=100.0)


def test_stamps_that_step_back_or_repeat_are_told(tmp_path):
    stamps = [0, 1, 1, 3, 2, 4]
    said = [scan_said(STAMP_NS + k * SECOND, laser_scan(STAMP_NS + s, [1.0, 2.0])) for k, s in enumerate(stamps)]
    path = write(tmp_path / "a.mcap", said)
    log = open_log(path)
    for _ in range(2):
        assert [scan.stamp_ns - STAMP_NS for scan in log.scans()] == stamps
        assert len(log.notes) == 3 and log.notes[0].startswith("no point times")
        assert any("1 step back in the header stamps of /scan" in note for note in log.notes)
        assert any("1 of 6 scans of /scan with the header stamp of the previous one" in note for note in log.notes)


def test_a_chunk_that_says_nothing_of_its_times_loses_no_scan(tmp_path):
    path = write(tmp_path / "a.mcap", office(20), compression="none", crcs=False)
    last = index_files([path])[0].blocks[-1]
    times = np.array([last.start_ns, last.end_ns], "<u8").tobytes()
    path.write_bytes(path.read_bytes().replace(times, bytes(16), 1))
    assert len(list(open_log(path).scans())) == 20


# the wheel-odometry prior


def wheels(*entries, topic="/odom"):
    """Readings (log time s, stamp s, x)."""
    return [
        odometry_said(STAMP_NS + round(at * SECOND), odometry(STAMP_NS + round(stamp * SECOND), x, 0.0), topic)
        for at, stamp, x in entries
    ]


def one_scan(at, stamp):
    return scan_said(
        STAMP_NS + round(at * SECOND), laser_scan(STAMP_NS + round(stamp * SECOND), [1.0, 2.0], beam_s=1e-3)
    )


def prior_x(path, **config):
    _, (scan,) = read(path, **config)
    return None if scan.T_odom_base is None else scan.T_odom_base[0, 2]


@pytest.mark.parametrize(
    ("before", "scan", "behind", "expected"),
    [
        ([(0.0, 0.0, 1.0)], (0.05, 0.05), [(0.2, 0.2, 3.0)], 1.5),  # interpolated
        ([(0.0, 0.3, 7.0), (0.1, 0.05, 5.0)], (0.11, 0.05), [(0.2, 0.01, 9.0)], 5.0),  # at the stamp of the scan
        ([(0.0, 0.0, 4.0)], (0.4, 0.4), [], 4.0),  # the nearest, up to half a second
        ([], (0.0, 0.0), [(0.4, 0.4, 6.0)], 6.0),
        ([(0.0, 0.0, 4.0)], (0.6, 0.6), [], None),
    ],
)
def test_the_prior_is_the_wheels_pose_at_the_stamp(tmp_path, before, scan, behind, expected):
    path = write(tmp_path / "a.mcap", [*wheels(*before), one_scan(*scan), *wheels(*behind)])
    assert prior_x(path) == (expected if expected is None else pytest.approx(expected))


def test_a_scan_does_not_wait_for_ever_for_a_reading(tmp_path):
    said = [*wheels((0.0, 0.0, 4.0)), *(one_scan(0.01 * k, 0.01 * k) for k in range(1, 200))]
    _, scans = read(write(tmp_path / "a.mcap", said))
    assert len(scans) == 199
    assert all(scan.T_odom_base is not None for scan in scans[:50]) and scans[-1].T_odom_base is None


def test_of_several_odometry_topics_none_is_used_until_one_is_chosen(tmp_path):
    said = [*wheels((0.0, 0.0, 4.0)), *wheels((0.0, 0.0, 8.0), topic="/visual"), one_scan(0.01, 0.0)]
    path = write(tmp_path / "a.mcap", said)
    log, (scan,) = read(path)
    assert scan.T_odom_base is None and not log.odometry_topic
    assert any("/odom" in note and "/visual" in note for note in log.notes)
    assert prior_x(path, odometry_topic="/visual") == 8.0


# the mounting


LASER = ("mast", "laser", 0.5, 0.0, 0.0, 0.0)
MAST = ("mast", 1.0, 0.0, np.pi / 2, 0.0)


@pytest.mark.parametrize(
    ("entries", "wheels_of", "expected", "base", "note"),
    [
        ([("base_link", *MAST), LASER], "base_link", (1.0, 0.5, np.pi / 2), "base_link", ""),
        ([("map", "camera", 1.0, 0.0, 0.0, 0.0)], "base_link", (0.0, 0.0, 0.0), "", "estimated from the wheels"),
        (
            [("imu_link", *MAST), LASER], None, (1.0, 0.5, np.pi / 2), "imu_link",
            "the log has no transform from base_link to laser: imu_link is used as the base",
        ),
        (
            [("rig", "chassis", 5.0, 0.0, 0.0, 0.0), ("chassis", "laser", 0.5, 0.0, 0.0, 0.0)], "chassis",
            (0.5, 0.0, 0.0), "chassis", "",
        ),
        ([("map", "mast", 9.0, 0.0, 0.0, 0.0), LASER], None, (0.5, 0.0, 0.0), "mast", "mast is used as the base"),
        (
            [("base_link", *MAST), LASER], "camera_pose", (1.0, 0.5, np.pi / 2), "base_link",
            "no transform states where camera_pose is, whose odometry is taken as that of base_link",
        ),
    ],
    ids=["chained", "no chain", "root of the tree", "frame of the wheels", "below the world", "wheels elsewhere"],
)  # fmt: skip
def test_the_mounting_is_that_of_the_static_transforms(tmp_path, entries, wheels_of, expected, base, note):
    said = [transforms_said(STAMP_NS, transforms(*entries)), one_scan(0.1, 0.1)]
    said += [odometry_said(STAMP_NS, odometry(STAMP_NS, 0.0, 0.0, child=wheels_of))] if wheels_of else []
    log, _ = read(write(tmp_path / "a.mcap", said))
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(*expected), atol=1e-12)
    assert log.mounting.base == base
    assert note in log.notes[0] if note else log.notes == []


@pytest.mark.parametrize(("frame", "is_fixed"), [("laser", False), ("camera_init", True), ("robot/odom", True)])
def test_clouds_in_a_frame_that_does_not_move_with_the_lidar_are_a_warning(tmp_path, frame, is_fixed):
    said = [scan_said(STAMP_NS + k, laser_scan(STAMP_NS + k, [1.0, 2.0], frame=frame)) for k in range(3)]
    log, _ = read(write(tmp_path / "a.mcap", said))
    assert [f"/scan is in the frame {frame}, which" in line for line in log.damage] == [True] * is_fixed


@pytest.mark.parametrize("moving", [False, True])
def test_a_transform_of_another_frame_that_is_no_pose_costs_no_mounting(tmp_path, moving):
    told = transforms(("base_link", "arm", np.nan, 0.0, 0.0, 0.0), ("base_link", *MAST), LASER)
    said = [transforms_said(STAMP_NS, told, *(["/tf"] if moving else [])), one_scan(0.1, 0.1)]
    log, _ = read(write(tmp_path / "a.mcap", said))
    np.testing.assert_allclose(log.stated_mounting, lie.pose_2d(1.0, 0.5, np.pi / 2), atol=1e-12)


def test_a_transform_of_the_lidar_that_is_no_pose_is_named(tmp_path):
    told = transforms(("base_link", "laser", np.nan, 0.0, 0.0, 0.0))
    log, _ = read(write(tmp_path / "a.mcap", [transforms_said(STAMP_NS, told), one_scan(0.1, 0.1)]))
    assert log.stated_mounting is None and "base_link → laser is no pose" in log.notes[0]


@pytest.mark.parametrize("late_s", [3600.0, -37.0])
def test_wheels_of_another_clock_are_told_with_the_key_that_mends_them(tmp_path, late_s):
    said = [
        each
        for k in range(100)
        for each in (*wheels((0.1 * k, 0.1 * k + late_s, 0.1 * k)), one_scan(0.1 * k, 0.1 * k))
    ]
    path = write(tmp_path / "a.mcap", said)
    log, scans = read(path)
    assert all(scan.T_odom_base is None for scan in scans)
    flag = f"--log.odometry_delay_s {late_s:.2f}"
    assert (
        f"{'after' if late_s > 0 else 'before'} those of the scans, as of another clock: {flag}" in log.notes[-1]
    )
    log, scans = read(path, odometry_delay_s=late_s)
    assert "clock" not in str(log.notes)
    assert [scan.T_odom_base[0, 2] for scan in scans[:-1]] == pytest.approx([0.1 * k for k in range(99)])


def test_an_upside_down_lidar_sees_the_plane_as_from_above(tmp_path):
    yaw, x, y = 0.4, 0.2, -0.1
    said = [transforms_said(STAMP_NS, transforms(("base_link", "laser", x, y, yaw, np.pi))), one_scan(0.1, 0.1)]
    log, (scan,) = read(write(tmp_path / "a.mcap", said))
    T, points = log.T_base_lidar, scan.points
    raw = np.column_stack([laser_points(np.array([1.0, 2.0])), np.zeros(2)])
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([1.0, -1.0, -1.0])
    in_base = (raw @ R.T)[:, :2] + [x, y]
    np.testing.assert_allclose(lie.transform(T, points), in_base, atol=1e-6)
    assert points.flags.c_contiguous and points.dtype == np.float32
    assert np.linalg.det(T[:2, :2]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("roll", "note"), [(0.0, None), (np.pi, "hangs upside down"), (np.pi / 2, "tilted by 90 deg on the base")]
)
def test_a_planar_lidar_that_is_not_level_is_noted_and_info_says_how_it_is_turned(tmp_path, capfd, roll, note):
    said = [transforms_said(STAMP_NS, transforms(("base_link", "laser", 0.2, 0.1, np.pi, roll))), *office(2)[1:]]
    path = write(tmp_path / "a.mcap", said)
    notes = open_log(path).notes
    assert [note in line for line in notes] == [True] if note else not notes
    assert main(["info", str(path)]) == 0
    mounting = "mounting  at x 0.200 m, y 0.100 m on base_link, turned by yaw 180 deg\n"
    assert mounting in capfd.readouterr().out


def test_a_truth_that_is_named_does_not_hide_why_no_scan_can_be_read(tmp_path):
    said = [scan_said(STAMP_NS + k * SECOND, laser_scan(STAMP_NS, [1.0] * 90, step=1.0)) for k in range(5)]
    log = open_log(write(tmp_path / "a.mcap", said))
    with pytest.raises(InputError, match=r"no message of /scan .* cover 14.3 turns: degrees\?"):
        log.expected_stamps("/scan")


def test_a_lidar_of_which_no_message_is_understood_is_named_and_not_its_mounting(tmp_path):
    said = [scan_said(STAMP_NS + k * SECOND, laser_scan(STAMP_NS, [1.0] * 90, step=1.0)) for k in range(5)]
    said = [transforms_said(STAMP_NS, transforms(("base_link", "laser", 0.2, 0.1, 0.3, 0.0))), *said]
    assert open_log(write(tmp_path / "a.mcap", said)).notes == ["no message of /scan could be understood"]


@pytest.mark.parametrize(("ranges_m", "named"), [((1850.0, 16000.0), True), ((31.0, 90.0), False)])
def test_ranges_in_millimeters_beyond_the_reach_are_named(tmp_path, ranges_m, named):
    data = laser_scan(STAMP_NS, np.linspace(*ranges_m, 90), high=30.0)
    with pytest.raises(InputError) as error:
        read(write(tmp_path / "a.mcap", [scan_said(STAMP_NS, data)]))
    assert ("are at 30 m or beyond: millimeters? convert them to meters" in str(error.value)) == named


@pytest.mark.parametrize("copies", [6, 1])
def test_many_copies_of_scans_are_a_warning_and_a_few_are_a_note(tmp_path, copies):
    ranges = [1.0 + 0.05 * np.arange(31) + 0.01 * min(k, 19 - copies) for k in range(20)]
    said = [
        scan_said(STAMP_NS + k * SECOND, laser_scan(STAMP_NS + k * SECOND, each)) for k, each in enumerate(ranges)
    ]
    log, scans = read(write(tmp_path / "a.mcap", said))
    assert len(scans) == 20
    if copies > 1:
        assert "6 of 20 scans of /scan are bitwise copies of the previous one" in log.damage[0]
    else:
        assert not log.damage and any("1 of 20 scans of /scan are bitwise copies" in note for note in log.notes)


# clouds of planar scanners


def cloud_of(k, points):
    rows = np.zeros(len(points), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4")])
    for name, column in zip("xyz", np.transpose(points), strict=True):
        rows[name] = column
    rows["t"] = np.arange(len(points)) * 1_000_000
    stamp_ns = STAMP_NS + k * SECOND // 10
    return cloud_said(stamp_ns, point_cloud(stamp_ns, rows))


def test_scans_whose_points_are_far_from_the_stamp_are_read_without_times_and_the_setting_is_told(tmp_path):
    """Whole numbers in nanoseconds, taken as seconds."""
    points = np.random.default_rng(0).normal(size=(9, 3))
    path = write(tmp_path / "a.mcap", [cloud_of(k, points) for k in range(3)])
    log, scans = read(path, point_times="s", max_bad_scans_percent=0.0)
    assert [len(scan.times_s) for scan in scans] == [0, 0, 0]
    assert any("times of 3 of 3 scans of /points contradict the period" in note for note in log.notes)
    assert any("is the unit wrong? scanchain doctor names the flag" in line for line in log.damage)
    assert all(len(scan.times_s) == 9 for scan in read(path, point_times="ns")[1])


@pytest.mark.parametrize("height_m", [0.0, 0.3])
def test_clouds_with_all_points_at_one_height_are_a_planar_log(tmp_path, height_m):
    said = [cloud_of(k, [(1, 2, height_m), (3, 4, height_m), (5, 6, height_m)]) for k in range(3)]
    log, scans = read(write(tmp_path / "a.mcap", said))
    assert log.dimension == 2 and log.T_base_lidar.shape == (3, 3)
    assert f"the clouds of /points are planar (z = {height_m:g} m everywhere): read as a 2D log" in log.notes
    for scan in scans:
        np.testing.assert_array_equal(scan.points, [(1, 2), (3, 4), (5, 6)])
        np.testing.assert_allclose(scan.times_s, [0.0, 1e-3, 2e-3])
        assert scan.points.dtype == np.float32 and scan.points.flags.c_contiguous


@pytest.mark.parametrize(
    "points", [[(1, 2, 0)], [(1, 2, 0), (3, 4, 0), (5, 6, 0.01)], [(1, 0, 2), (3, 0, 4), (5, 0, 6)]]
)
def test_clouds_of_other_points_or_too_few_to_tell_are_not_planar(tmp_path, points):
    log, _ = read(write(tmp_path / "a.mcap", [cloud_of(k, points) for k in range(5)]))
    assert log.dimension == 3


def test_a_cloud_that_leaves_the_plane_of_those_before_is_malformed(tmp_path):
    flat = [(x, y, 0.0) for x, y in np.random.default_rng(0).uniform(1, 9, (1100, 2))]
    path = write(tmp_path / "a.mcap", [cloud_of(0, flat), cloud_of(1, [*flat[:-1], (1, 1, 1)])])
    with pytest.raises(InputError, match=r"scan 1 .* a point lies 1 m off the plane z = 0 m"):
        read(path, max_bad_scans_percent=0.0)


# a mounting that /tf tells


def joined(at, *entries):
    """A message of /tf, logged at its stamp."""
    stamp_ns = STAMP_NS + round(at * SECOND)
    return transforms_said(stamp_ns, transforms(*entries, stamp_ns=stamp_ns), "/tf")


def swinging(roll, *, yaw=0.0, seconds=2.0):
    """Scans at 10 Hz of a lidar whose joint is told at 20 Hz, ``roll`` of the seconds."""
    said = []
    for k in range(round(20 * seconds)):
        at = k / 20
        said.append(joined(at, ("base_link", "laser", 0.2, 0.0, yaw, roll(at))))
        said += [] if k % 2 else [one_scan(at, at)]
    return said


def test_a_lidar_that_moves_on_the_robot_is_told_with_its_frames_and_its_range(tmp_path):
    path = write(tmp_path / "a.mcap", swinging(lambda at: 0.7 * np.sin(2.0 * np.pi * max(at - 1.0, 0.0))))
    said = "(base_link → laser in /tf turns by up to 40 deg): poses are the"
    assert any(said in note for note in open_log(path).notes)
    log, scans = read(path, end_s=0.95)  # while it rests
    assert len(scans) == 10 and log.mounting.motion is None


@pytest.mark.parametrize("seconds", [2.0, 40.0])
def test_a_transform_of_tf_that_repeats_itself_is_a_static_mounting(tmp_path, seconds):
    path = write(tmp_path / "a.mcap", swinging(lambda at: 0.0, yaw=0.4, seconds=seconds))
    log, _ = read(path)
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.2, 0.0, 0.4), atol=1e-12)
    assert log.mounting.motion is None and log.notes == []
    assert log.mounting.source == "by transforms of /tf, which do not change"


def test_transforms_of_the_robot_in_the_world_are_no_moving_mount(tmp_path):
    fixed = transforms_said(STAMP_NS, transforms(("base_link", "laser", 0.2, 0.0, 0.0, 0.0)))
    for name, mount in (("static", [fixed]), ("none", [])):
        said = [*mount]
        for k in range(20):
            robot = ("odom", "base_link" if mount else "laser", 0.1 * k, 0.0, 0.1 * k, 0.0)
            said += [joined(k / 10, ("map", "odom", 0.0, 0.01 * k, 0.0, 0.0), robot), one_scan(k / 10, k / 10)]
        log, scans = read(write(tmp_path / f"{name}.mcap", said))
        assert log.mounting.motion is None and len(scans) == 20 and log.notes == []
        assert log.T_base_lidar[0, 2] == (0.2 if mount else 0.0)


def test_wheels_are_no_prior_for_a_lidar_that_pans_by_tf(tmp_path):
    said = [joined(at, ("base_link", "laser", 0.2, 0.0, 2.0 * at, 0.0)) for at in (0.0, 0.1, 0.2)]
    said += [*wheels((0.0, 0.0, 0.0), (0.1, 0.1, 1.0)), one_scan(0.21, 0.0), one_scan(0.22, 0.05)]
    log, scans = read(write(tmp_path / "a.mcap", said))
    assert "base_link → laser in /tf turns by up to 23 deg)" in log.notes[0]
    assert "the wheels (/odom) are no prior for it" in log.notes[0]
    assert [scan.T_odom_base for scan in scans] == [None, None] and not log.odometry_topic
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.2, 0.0, 0.0), atol=1e-12)


# real logs


def test_intel_is_read_whole_in_log_time_order_with_a_prior_on_every_scan():
    log, scans = read(shared_data("2d/intel.mcap"))
    assert (log.dimension, log.topic, log.scan_count, len(scans)) == (2, "/scan", 13631, 13631)
    log_times = np.array([scan.log_time_ns for scan in scans])
    assert np.all(np.diff(log_times) >= 0)
    assert np.count_nonzero(np.diff([scan.stamp_ns for scan in scans]) < 0) == 631
    assert all(scan.T_odom_base is not None for scan in scans)
    assert not log.damage


def test_intel_scans_equal_an_independent_decoders():
    path = shared_data("2d/intel.mcap")
    _, scans = read(path, end_s=60.0)
    latest = {}
    checked = 0
    for _, channel, _, message in decoded(path, ["/scan", "/odom"]):
        latest[channel.topic] = message
        if channel.topic != "/scan":
            continue
        if checked == len(scans):
            break
        scan = scans[checked]
        ranges = np.array(message.ranges)
        angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
        valid = (ranges > message.range_min) & (ranges < message.range_max)
        points = (ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))[valid]
        np.testing.assert_allclose(scan.points, points, atol=1e-5)
        position = latest["/odom"].pose.pose.position
        np.testing.assert_allclose(scan.T_odom_base[:2, 2], [position.x, position.y])
        checked += 1
    assert checked == len(scans) > 100


def test_kitti_clouds_equal_an_independent_decoders_bit_for_bit():
    path = shared_data("3d/kitti_0005_first60.mcap")
    log = open_log([path], LogConfig())
    assert (log.dimension, log.scan_count) == (3, 60)
    for (_, _, message, cloud), scan in zip(decoded(path), log.scans(), strict=True):
        rows = np.frombuffer(cloud.data, np.float32).reshape(-1, cloud.point_step // 4)[:, :3]
        rows = rows[np.isfinite(rows).all(axis=1) & rows.any(axis=1)]
        assert message.log_time == scan.log_time_ns
        assert np.array_equal(scan.points.view(np.uint32), rows.copy().view(np.uint32))


def test_the_mounting_of_a_real_lidar_on_its_imu_is_read():
    files = [shared_data("3d/kitti_0005_first60.mcap"), shared_data("3d/kitti_0005_first60_imu_gnss.mcap")]
    log = open_log(files)
    np.testing.assert_allclose(log.T_base_lidar[:3, 3], [0.811, -0.307, 0.802], atol=1e-3)
    assert log.mounting.base == "imu_link" and "imu_link is used as the base" in log.notes[0]


def test_kitti_ground_truth_is_that_of_the_published_file():
    log = open_log([shared_data("3d/kitti_0001_first54.mcap")], LogConfig())
    truth = log.ground_truth()
    published = np.loadtxt(shared_data("3d/kitti_0001_first54.tum"))
    assert truth.poses.shape == (54, 4, 4)
    np.testing.assert_allclose(truth.stamps_ns * 1e-9, published[:, 0], atol=1e-5)
    np.testing.assert_allclose(truth.poses[:, :3, 3], published[:, 1:4], atol=1e-6)
    np.testing.assert_allclose(truth.poses[:, :3, :3], lie.from_quaternion(published[:, 4:]), atol=1e-6)


@pytest.mark.parametrize(
    ("fixed", "config", "x", "note"),
    [
        (
            [],
            {},
            0.0,
            ["poses of base_link, taken as the lidar's, as no transform states where it is on base_link"],
        ),
        (
            [("base_link", "laser", 0.5, 0.0, 0.0, 0.0)],
            {},
            0.5,
            ["poses of base_link, moved to the lidar, at x 0.500 m, y 0.000 m"],
        ),
        ([], {"lidar_pose": "0.7 0 0 0 0 0 1"}, 0.7, ["poses of base_link, moved to the lidar, at x 0.700 m"]),
    ],
)
def test_true_poses_of_the_base_are_moved_to_the_lidar_or_it_is_told_that_they_are_not(
    tmp_path, fixed, config, x, note
):
    said = [transforms_said(STAMP_NS, transforms(*fixed))] if fixed else []
    said += [one_scan(0.1, 0.1), *wheels((0.1, 0.1, 2.0), topic="/ground_truth")]
    log = open_log(write(tmp_path / "a.mcap", said), LogConfig(**config))
    list(log.scans())
    assert log.ground_truth().poses[0, 0, 2] == 2.0 + x
    says(str(log.notes), *note)


@pytest.mark.parametrize("topic", ["/base_pose_ground_truth", "/robot/gt/odom", "/vicon/odometry"])
def test_an_odometry_of_true_poses_is_no_prior_unless_it_is_named(tmp_path, topic):
    said = [one_scan(0.1, 0.1), *wheels((0.1, 0.1, 2.0), topic=topic)]
    path = write(tmp_path / "a.mcap", said)
    assert not open_log(path).odometry_topic
    assert open_log(path, odometry_topic=topic).odometry_topic == topic
    log = open_log(write(tmp_path / "b.mcap", said + wheels((0.1, 0.1, 1.0))))
    assert log.odometry_topic == "/odom" and log.notes[0].startswith("no static transform")


def test_the_truth_met_on_the_way_is_that_of_a_pass_of_its_own_and_no_prior_and_can_be_left_unused(tmp_path):
    said = [
        *(one_scan(0.1 * k, 0.1 * k) for k in range(3)),
        *wheels(*[(0.1 * k, 0.1 * k, float(k)) for k in range(5)], topic="/ground_truth"),
    ]
    path = write(tmp_path / "a.mcap", said)
    alone = open_log([path], LogConfig()).ground_truth()
    log, scans = read(path)
    assert not log.odometry_topic and all(scan.T_odom_base is None for scan in scans)
    np.testing.assert_array_equal(log.ground_truth().poses, alone.poses)
    assert alone.poses.shape == (5, 3, 3) and alone.poses[4, 0, 2] == 4.0
    np.testing.assert_array_equal(log.ground_truth().stamps_ns, alone.stamps_ns)
    log = open_log([path], LogConfig(ground_truth_topic="none"))
    assert log.ground_truth() is None and not log.ground_truth_topic and not log.odometry_topic


def test_a_scan_of_a_log_is_had_by_its_number_and_leaves_the_log_as_it_was(tmp_path):
    log = open_log(write(tmp_path / "a.mcap", office()))
    scans = list(log)
    notes, damage = list(log.notes), log.damage
    for number in (0, 5, len(log) - 1):
        assert log[number].index == number and log[number].stamp_ns == scans[number].stamp_ns
    assert (log.notes, log.damage) == (notes, damage)
    for number, words in (
        (len(log), f"has no scan {len(log)}, 40 scans"),
        (-1, "index is -1; "),
        (slice(3), "inde"),
    ):
        with pytest.raises(InputError, match=words):
            log[number]
