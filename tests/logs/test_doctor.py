"""The doctor: each defect of a log is found, measured and mended by the flag it names."""

import json

import numpy as np
import pytest

from scanchain.__main__ import main
from scanchain.config import Config, LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log
from scanchain.logs.doctor import examine
from scanchain.logs.writer import LogWriter, pack_fix, pack_imu
from tests.support import made
from tests.support.naive_logs import (
    SECOND,
    STAMP_NS,
    Said,
    cloud_said,
    laser_scan,
    odometry,
    odometry_said,
    point_cloud,
    scan_said,
    transforms,
    transforms_said,
    write,
)
from tests.support.scenes import configured, shared_data

STEP_NS = SECOND // 10
CHECKS = [
    "gaps", "stamps", "wheels", "point times", "damage", "returns", "noise", "no return", "ranges", "duplicates",
]  # fmt: skip


def diagnose(*paths, **config):
    found = examine(list(paths), lambda _: Config(), LogConfig(**config), lambda *_: None)
    checks = [finding.check for finding in found.findings]
    assert len(set(checks)) == len(checks)
    assert all(finding.effect for finding in found.findings if finding.severity != "ok")
    return {finding.check: finding for finding in found.findings}


def room(k):
    """Ranges in a room that the robot crosses at 0.1 m a scan."""
    angles = -1.0 + 0.02 * np.arange(100)
    return np.minimum((8.0 - 0.1 * k) / np.maximum(np.cos(angles), 0.1), 3.0 / np.abs(np.sin(angles) + 1e-9))


def drive(count=40, *, stamp=lambda k: 0, log=lambda k: 0, ranges=room, wheels=False, mounted=True, **options):
    """Scans every 100 ms; ``stamp`` and ``log`` shift the times of scan k by nanoseconds."""
    said = [transforms_said(STAMP_NS, transforms(("base_link", "laser", 0.2, 0.1, 0.3, 0.0)))] if mounted else []
    for k in range(count):
        time_ns = STAMP_NS + k * STEP_NS
        if wheels:
            said.append(odometry_said(time_ns, odometry(time_ns, 0.1 * k, 0.0)))
        data = laser_scan(time_ns + stamp(k), ranges(k), first=-1.0, step=0.02, high=0.0, **options)
        said.append(scan_said(time_ns + log(k), data))
    return said


def saved(folder, said, **options):
    return write(folder / "a.mcap", said, **options)


def test_a_healthy_log_is_all_well(tmp_path):
    found = diagnose(saved(tmp_path, drive(wheels=True, beam_s=3e-4)))
    assert sorted(found) == sorted(CHECKS)
    assert {finding.severity for finding in found.values()} == {"ok"}
    assert found["damage"].found.startswith("40 scans") and "0 of 40 scans without" in found["wheels"].found


def test_late_wheels_are_a_warning_with_the_key_that_mends_them(capfd):
    log = made.log("office", seconds=40, wheels_delay_s=0.66)
    assert main(["doctor", str(log), "--json"]) == 0
    (found,) = (each for each in json.loads(capfd.readouterr().out)["findings"] if each["check"] == "wheels")
    assert "its stamps are 0.66 s late" in found["found"] and found["severity"] == "warning"
    flag, value = found["fix"].split()
    assert main(["doctor", str(log), "--json", flag, value]) == 0
    (mended,) = (each for each in json.loads(capfd.readouterr().out)["findings"] if each["check"] == "wheels")
    assert (flag, value) == ("--log.odometry_delay_s", "0.66") and "late" not in mended["found"]


def covered(*numbers):
    """The room, but for scans in which all returns are of the robot itself."""
    return lambda k: np.full(100, 0.2) if k in numbers else room(k)


def test_scans_without_a_point_in_range_are_left_out(call, tmp_path):
    path = saved(tmp_path, drive(ranges=covered(0, 20)))
    found = diagnose(path)["damage"]
    assert found.severity == "warning"
    assert "2 scans without a point between preprocess.min_range_m (0.5)" in found.found
    assert diagnose(path, every=4)["damage"].found.startswith("2 scans without")  # of ten
    flags = ["--preprocess.min_range_m", "0.5", "--rerun", "off"]
    code, output, errors = call("run", path, "--out", tmp_path / "a", *flags)
    assert code == 0 and "scans          38 over" in output
    assert f"warning: 2 of 40 scans of /scan were left out (the first: {path}: scan 0 of /scan" in errors
    assert "no point between preprocess.min_range_m (0.5) and preprocess.max_range_m" in errors


def test_a_log_without_a_point_in_range_names_the_settings_and_the_ranges_seen(call, tmp_path):
    path = saved(tmp_path, drive(ranges=covered(*range(40))))
    found = diagnose(path)
    assert (found["damage"].severity, found["damage"].fix) == ("problem", "")
    assert found["ranges"].fix == "--preprocess.min_range_m 0.18"
    flags = ["--preprocess.min_range_m", "0.5", "--log.max_bad_scans_percent", "100"]
    code, _, errors = call("run", path, "--out", tmp_path / "a", "--rerun", "off", *flags)
    assert code == 2 and errors.count("\n") == 1 and not (tmp_path / "a").exists()
    assert "no point between preprocess.min_range_m (0.5) and preprocess.max_range_m" in errors
    assert "lie at 0.2 to 0.2 m" in errors


def test_a_gap_is_found_where_it_is(tmp_path):
    def hole(k):
        return 2 * SECOND if k >= 20 else 0

    path = saved(tmp_path, drive(stamp=hole, log=hole))
    finding = diagnose(path)["gaps"]
    assert (finding.severity, finding.fix) == ("warning", "--end 1.9")
    assert finding.found == "1 longer than 2.5 periods of 0.1 s, the longest 2.1 s, 1.9 s into the log"
    assert "at constant velocity" in finding.effect
    assert "run the part before, as below, and the rest, --start 4, separately" in finding.effect
    later = diagnose(path, start_s=1.0)["gaps"]
    assert (later.found, later.fix) == (finding.found, finding.fix)  # the flag counts from the same moment
    path = saved(tmp_path, drive(stamp=hole, log=hole, wheels=True))
    on_wheels = diagnose(path)["gaps"]
    assert on_wheels.severity == "note" and "by the wheels" in on_wheels.effect
    unused = configured(2, {"odometry.prior": "constant-velocity"})
    assert finding in examine([path], lambda _: unused, LogConfig(), lambda *_: None).findings


def stuck(k):
    return np.where(np.arange(100) % 7, room(k), 29.99)


def mostly_lost(k):
    ranges = room(k)
    ranges[:30], ranges[30:80] = np.nan, 0.0
    return ranges


def blind_until(start, stop):
    """The room, but for three beams alone at the start and none beyond the end."""
    return lambda k: np.where(np.arange(100) < (3 if k < start else 2 if k >= stop else 100), room(k), np.nan)


def at_times(k):
    return STAMP_NS + k * STEP_NS


ROW = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4"), ("ring", "<u2")])


def sweep(k, *, span=0.095, fields=ROW, shift_m=0.0):
    rng = np.random.default_rng(3)
    rows = np.zeros(640, fields)
    for name, reach in zip("xyz", (20.0, 20.0, 2.0), strict=True):
        rows[name] = rng.uniform(1.0, reach, 640)
    rows["x"] -= 0.3 * k
    rows["y"] += shift_m
    if "time" in fields.names:
        rows["time"] = np.linspace(0.0, span, 640)
    return rows


def sweeps(**options):
    return [cloud_said(at_times(k), point_cloud(at_times(k), sweep(k, **options))) for k in range(20)]


OTHER_CLOCK = "--log.odometry_delay_s 37.00"
NO_RETURN = "--log.max_range_m 29.989"
NO_WHEELS = "--odometry.prior constant-velocity"
IN_MILLIMETERS = [odometry_said(at_times(k), odometry(at_times(k), 100.0 * k, 0.0)) for k in range(40)]


@pytest.mark.parametrize(
    ("said", "check", "severity", "found", "fix"),
    [
        (
            drive(stamp=lambda k: -at_times(k)),
            "damage",
            "warning",
            "have the header stamp of the previous one",
            "",
        ),
        (drive(stamp=lambda k: -at_times(k)), "gaps", "ok", "none longer", ""),  # by log time
        (
            drive(wheels=True, stamp=lambda k: -37 * SECOND),
            "wheels",
            "warning",
            "s; its stamps are 37.00 s late",
            OTHER_CLOCK,
        ),
        (drive(wheels=True, mounted=False), "wheels", "note", "no static transform from base_link", ""),
        ([*drive(), *IN_MILLIMETERS], "wheels", "problem", "moves at 1e+03 m/s", NO_WHEELS),
        (drive(ranges=mostly_lost), "returns", "warning", "80 % of the beams without a valid return, 20", ""),
        (drive(ranges=blind_until(25, 40)), "returns", "warning", "3 valid per scan", "--start 2.5"),
        (drive(ranges=blind_until(5, 30)), "returns", "warning", "100 valid per", "--start 0.5 --end 2.901"),
        (drive(ranges=blind_until(0, 40)), "returns", "ok", "0 % of the beams", ""),
        (drive(ranges=stuck), "no return", "warning", "15 % of the beams have exactly 29.99 m", NO_RETURN),
        (drive(ranges=lambda k: 1e3 * room(k)), "ranges", "problem", "98 % of the returns lie between", ""),
        (sweeps(shift_m=150.0), "ranges", "note", "98 % of the returns", "--preprocess.max_range_m 171"),
        (drive(ranges=lambda k: room(k // 2)), "duplicates", "warning", "20 of 40 scans", "--every 2"),
        (drive(ranges=lambda k: room(min(k, 20))), "duplicates", "warning", "20 of them in a row", ""),
        (sweeps(), "point times", "ok", "field time (float32) taken as s after the stamp", ""),
        (sweeps(span=9.5), "point times", "warning", "95 of the period", "--log.point_times none"),  # no unit fits
        (sweeps(span=0.0), "point times", "note", "field time (float32) is constant (0)", ""),
        (sweeps(fields=np.dtype(ROW.descr[:3])), "point times", "note", "none", ""),  # in no order
    ],
)
def test_a_fault_is_measured_and_graded_and_mended_by_the_flag_of_a_log(
    tmp_path, said, check, severity, found, fix
):
    path = saved(tmp_path, said)
    finding = diagnose(path)[check]
    assert (finding.severity, finding.fix) == (severity, fix)
    assert found in finding.found
    if fix.startswith("--log."):
        words = fix.split()
        keys = [flag.removeprefix("--log.") for flag in words[::2]]
        values = [float(value) if value[0].isdigit() else value for value in words[1::2]]
        mended = diagnose(path, **dict(zip(keys, values, strict=True)))[check]
        assert (mended.severity, mended.fix) == ("note" if values[0] == "none" else "ok", "")


def test_scans_that_would_stop_a_run_are_a_problem_with_a_flag(tmp_path):
    said = drive()
    said[5].data = said[5].data[:50]
    said[9] = scan_said(said[9].log_ns, laser_scan(said[9].log_ns, np.full(100, np.nan)))
    path = saved(tmp_path, said)
    finding = diagnose(path, max_bad_scans_percent=2.0)["damage"]
    assert finding.severity == "problem" and finding.fix == "--log.max_bad_scans_percent 5"
    assert "2 of 40 scans of /scan were left out (the first: " in finding.found
    for percent in (5.0, LogConfig().max_bad_scans_percent):
        finding = diagnose(path, max_bad_scans_percent=percent)["damage"]
        assert finding.severity == "warning" and "left out" in finding.effect


def test_a_wrong_unit_of_point_times_is_found_and_mended_by_its_flag(tmp_path):
    path = saved(tmp_path, sweeps())
    finding = diagnose(path, point_times="ms")["point times"]
    assert finding.severity == "warning" and finding.fix == "--log.point_times s"
    assert diagnose(path, point_times="s")["point times"].severity == "ok"


@pytest.mark.parametrize(("factor", "said"), [(1e-3, "0.095 ms, 0.00095 of"), (100.0, "9.5e+03 ms, 95 of")])
def test_a_run_warns_of_point_times_that_do_not_fit_the_period(tmp_path, factor, said):
    log = open_log(saved(tmp_path, sweeps(span=0.095 * factor)), point_times="s")
    list(log.scans())
    assert any(f"by their point times scans of /points last {said} the period" in line for line in log.damage)
    log = open_log(saved(tmp_path, sweeps()), point_times="s")
    list(log.scans())
    assert log.damage == []


def test_a_run_of_ranges_in_millimeters_is_refused_with_the_reason(call, tmp_path):
    path = saved(tmp_path, drive(ranges=lambda k: 1e3 * room(k)))
    code, _, errors = call("run", path, "--out", tmp_path / "a", "--rerun", "off")
    assert code == 2 and "millimeters? convert them to meters" in errors and "widen" not in errors


def test_imu_gnss_poses_and_truth_are_named_with_what_is_made_of_them_though_no_lidar_is_chosen(tmp_path, capfd):
    said = drive(wheels=True)
    said += [odometry_said(STAMP_NS, odometry(STAMP_NS, 0.0, 0.0), topic) for topic in ("/ground_truth", "/gps")]
    names = {"nav_msgs/msg/Path": "sensor_msgs/msg/Imu", "nav_msgs/msg/MapMetaData": "sensor_msgs/msg/NavSatFix"}
    said += [Said(topic, kind, STAMP_NS, b"0") for topic, kind in zip(("/imu/data", "/fix"), names, strict=True)]
    path = saved(tmp_path, said, rename=lambda kind: names.get(kind, kind))
    flags = ["--log.odometry_topic", "/odom"]
    assert main(["info", str(path), *flags]) == 0
    text = capfd.readouterr().out
    unplaced = "without a transform, which is estimated"
    lines = [
        f"GNSS /fix: {unplaced}; its fixes give the place on Earth, and correct drift where they show any",
        "poses /gps: not used; --gt /gps uses them as ground truth, --log.odometry_topic /gps as wheels",
        "ground truth /ground_truth: evaluates the result, is not used for it",
        f"IMU /imu/data: {unplaced}; predicts motions where it does so better than the scans",
    ]
    assert all(f"sensor    {line}\n" in text for line in lines)
    assert "wheels    /odom" in text and "/odom:" not in text
    assert main(["run", str(path), "--out", str(tmp_path / "a"), "--rerun", "off", *flags]) == 0
    text = capfd.readouterr().out
    assert "1 malformed message of /imu/data left out" in text and "1 malformed message of /fix left out" in text
    assert "/ground_truth: evaluates" not in text
    other = [Said("/other", each.kind, each.log_ns, each.data) for each in said if each.topic == "/scan"]
    saved(tmp_path, [*said, *other], rename=lambda kind: names.get(kind, kind))
    assert main(["info", str(path), "--json"]) == 1
    told = json.loads(capfd.readouterr().out)
    assert "several lidar topics" in told["problem"]
    assert sorted({each["sensor"] for each in told["sensors"]}) == ["GNSS", "IMU", "ground truth", "poses"]


# The whole


def test_the_intel_log_has_none_of_these_faults():
    found = diagnose(shared_data("2d/intel.mcap"))
    assert found["no return"].severity == "ok"
    assert found["duplicates"].severity == "ok" and "0 of 13,631" in found["wheels"].found


def test_the_command_prints_the_gravest_first_and_json_says_the_same(tmp_path, capfd):
    path = saved(tmp_path, drive(ranges=lambda k: np.nan * room(k) if k == 20 else room(k)))
    assert main(["doctor", str(path)]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert lines[0] == f"{path} /scan (2D)" and lines[1].startswith("warning  damage")
    assert main(["doctor", str(path), "--json"]) == 0
    said = json.loads(capfd.readouterr().out)
    grades = [finding["severity"] for finding in said["findings"]]
    assert grades == sorted(grades, key=["problem", "warning", "note", "ok"].index)
    assert said["topic"] == "/scan" and {"check", "severity", "found", "effect", "fix"} == set(said["findings"][0])


def test_a_log_that_a_run_could_not_open_is_refused_in_the_same_words(tmp_path, capfd):
    path = saved(tmp_path, [odometry_said(STAMP_NS, odometry(STAMP_NS, 0, 0))])
    assert main(["doctor", str(path)]) == 2
    assert "has no lidar topic" in capfd.readouterr().err
    with pytest.raises(InputError, match="could be read"):
        diagnose(saved(tmp_path, [scan_said(STAMP_NS, b"\0\1\0\0")]))


@pytest.mark.parametrize(
    ("stamp", "log", "advance"),
    [
        (
            lambda k: (k % 10) * (100 - STEP_NS),
            lambda k: 0,
            "1e-07 s from scan to scan, log times by 0.1 s (medians)",
        ),
        (lambda k: 0, lambda k: k * (STEP_NS // 1000 - STEP_NS), "3.9 s, log times by 0.0039 s"),
        (lambda k: k * STEP_NS * 999, lambda k: 0, "3.9e+03 s, log times by 3.9 s"),
        (lambda k: 0, lambda k: (20 - k % 20) * (STEP_NS - 1000), ""),
        (lambda k: 600 * SECOND * (k > 20), lambda k: 600 * SECOND * (k > 20), ""),
    ],
    ids=[
        "milliseconds as nanoseconds",
        "log times in us",
        "stamps in another unit",
        "logged in bursts",
        "a pause",
    ],
)
def test_stamps_and_log_times_of_which_one_is_in_another_unit_are_named(tmp_path, stamp, log, advance):
    path = saved(tmp_path, drive(stamp=stamp, log=log, beam_s=9e-4))
    opened = open_log(path)
    spans_s = [float(np.ptp(scan.times_s)) for scan in opened.scans() if len(scan.times_s)]
    line = f"header stamps of /scan advance by {advance}: is the unit of one of them wrong?"
    assert (line in opened.damage) == bool(advance) and len(opened.jumps) == bool(advance)
    found = diagnose(path)
    assert (found["stamps"].found == line) == bool(advance) and "unit?" not in found["damage"].found
    period_s = 1e-9 * np.median(np.diff([scan.stamp_ns for scan in opened.scans()]))
    assert max(spans_s, default=0.0) <= 10.0 * period_s  # else deskewing turns each scan by revolutions


@pytest.mark.parametrize(("count", "found"), [(1, "1 scan with the stamp 0"), (3, "3 scans with the stamp 0")])
def test_scans_without_a_stamp_are_told_and_no_jitter(tmp_path, count, found):
    unset = range(0, 10 * count, 10)
    path = write(tmp_path / "a.mcap", drive(stamp=lambda k: -(STAMP_NS + k * STEP_NS) if k in unset else 0))
    stamps = diagnose(path)["stamps"]
    assert (stamps.severity, stamps.found) == ("note", found)
    log = open_log(path)
    list(log.scans())
    assert any(f"{count} of 40 scans of /scan with the header stamp 0" in note for note in log.notes)


def test_scans_that_are_logged_in_bursts_have_no_gaps_and_those_without_stamps_have(tmp_path):
    late = drive(log=lambda k: (4 - k % 5) * STEP_NS)
    assert diagnose(saved(tmp_path, late))["gaps"].severity == "ok"
    unstamped = drive(log=lambda k: 20 * STEP_NS * (k > 20), stamp=lambda k: -k * STEP_NS)
    assert "1 longer than 2.5 periods" in diagnose(saved(tmp_path, unstamped))["gaps"].found


@pytest.mark.parametrize(
    ("ppm", "jitter_ms", "is_noted"), [(1000, 0, True), (-300, 1, True), (10, 0, False), (1000, 15, False)]
)
def test_a_clock_that_drifts_against_the_log_is_noted_unless_jitter_hides_it(tmp_path, ppm, jitter_ms, is_noted):
    late = np.random.default_rng(1).normal(0.0, 1e6 * jitter_ms, 200).astype(int)
    shifts = {"stamp": lambda k: k * STEP_NS * ppm // 1_000_000, "log": lambda k: int(late[k]) + SECOND // 2}
    found = diagnose(saved(tmp_path, drive(200, ranges=lambda k: room(0), **shifts)))["stamps"]
    assert found.severity == ("note" if is_noted else "ok")
    if is_noted:
        _, _, rate, _, sense, *_ = found.found.replace(",", "").split()
        assert sense == ("faster" if ppm > 0 else "slower") and abs(int(rate) - abs(ppm)) <= 30 * jitter_ms


def test_steps_back_and_drift_are_those_that_clockdoctor_finds(tmp_path):
    """Its analysis of the same log, of which it reads the times only."""
    extract = pytest.importorskip("clockdoctor.extract", reason="clockdoctor is not installed")
    analyze = pytest.importorskip("clockdoctor.analyze")

    def flags(path):
        _, rows = extract.extract_to_jsonl(path, topic="/scan")
        return json.loads(analyze.analyze_jsonl(rows)["timeline_json"].read_text())["flags"]

    back = saved(tmp_path, drive(stamp=lambda k: -2 * STEP_NS * (k % 10 == 9)))
    (flag,) = (each for each in flags(back) if each["type"] == "out_of_order")
    assert flag["message"].split()[0] == diagnose(back)["stamps"].found.split()[0] == "4"
    fast = saved(tmp_path, drive(200, stamp=lambda k: k * STEP_NS // 1000, ranges=lambda k: room(0)))
    (flag,) = (each for each in flags(fast) if each["type"] == "clock_drift")
    assert "drifts -1000.0ppm" in flag["message"] and "1,000 ppm faster" in diagnose(fast)["stamps"].found


def test_scans_of_two_lasers_at_the_same_instants_have_no_gaps_between_these(tmp_path):
    mountings = ("base_link", "laser", 0.2, 0.0, 0.3, 0.0), ("base_link", "rear", -0.2, 0.0, 0.3, 0.0)
    said = [transforms_said(STAMP_NS, transforms(*mountings))]
    for k in range(20):
        for number, frame in enumerate(("laser", "rear")):
            data = laser_scan(STAMP_NS + k * STEP_NS, room(k), step=0.02, frame=frame)
            said.append(scan_said(STAMP_NS + k * STEP_NS + number * 1_000_000, data))
    assert diagnose(saved(tmp_path, said))["gaps"].found == "none longer than 2.5 periods of 0.1 s"


def beside(log, folder, topic, messages):
    """Files of a log, and of one with messages of a sensor: seconds after the first scan, data by stamp."""
    path, begin_ns = folder / f"{len(list(folder.iterdir()))}.mcap", int(open_log(log).expected_stamps("/scan")[0])
    with LogWriter(path) as writer:
        for after_s, pack in messages:
            stamp_ns = begin_ns + int(1e9 * after_s)
            type_name = "Imu" if topic == "/imu" else "NavSatFix"
            writer.append(topic, f"sensor_msgs/msg/{type_name}", pack(stamp_ns), stamp_ns)
    return log, path


def pushed(force, frame="base_link"):
    return lambda stamp_ns: pack_imu(stamp_ns, frame, np.zeros(3), np.array([0.0, 0.0, force]))


@pytest.mark.parametrize(
    ("force", "frame", "gap_s", "grade", "words"),
    [
        (9.81, "base_link", 0.0, "ok", ("100 Hz, at x", "specific force 9.81 m/s²", "a run tests")),
        (1.0, "base_link", 0.0, "ok", ("specific force 1 g: converted",)),
        (0.1, "elsewhere", 0.0, "ok", ("without a transform, which is estimated", "0.1 m/s²")),  # the log is 2D
        (
            9.81,
            "base_link",
            0.5,
            "warning",
            ("1 gap of more than 0.15 s, the longest 0.51 s", "predicted without it"),
        ),
    ],
)
def test_of_an_imu_rate_place_and_gravity_are_told_and_gaps(tmp_path, force, frame, gap_s, grade, words):
    samples = [(0.01 * k + gap_s * (k > 50), pushed(force, frame)) for k in range(150)]
    found = diagnose(*beside(made.log("office", seconds=3.0), tmp_path, "/imu", samples))["IMU"]
    assert found.severity == grade
    assert all(word in f"{found.found}; {found.effect}" for word in words)


def test_of_a_receiver_rate_place_and_stated_errors_are_told_and_one_without_a_fix(tmp_path):
    log = made.log("office", seconds=3.0)
    assert {"IMU", "GNSS"}.isdisjoint(diagnose(log))
    fixes = [
        (0.2 * k + 0.8 * (k > 5), lambda ns: pack_fix(ns, "a", (49.0, 8.4, 9.0), (3.0, 3.0, 9.0)))
        for k in range(9)
    ]
    found = diagnose(*beside(log, tmp_path, "/fix", fixes))["GNSS"]
    assert found.severity == "ok"
    assert found.found == (
        "/fix: 9 fixes at 5 Hz, up to 1 s apart, without a transform, which is estimated, "
        "standard deviation 3 m east and north (median)"
    )
    none = [(0.2 * k, lambda ns: pack_fix(ns, "a", (49.0, 8.4, 9.0), None)) for k in range(9)]
    found = diagnose(*beside(log, tmp_path, "/fix", none))["GNSS"]
    assert (found.severity, found.effect) == ("warning", "it is not used") and "no fixes" in found.found


def test_wheels_that_never_move_are_a_warning(tmp_path):
    times_ns = [STAMP_NS + k * STEP_NS for k in range(40)]
    still = [odometry_said(time_ns, odometry(time_ns, 1.0, 0.0)) for time_ns in times_ns]
    found = diagnose(saved(tmp_path, [*drive(), *still]))["wheels"]
    assert (found.severity, found.fix) == ("warning", "--odometry.prior constant-velocity")
    assert "the robot never moves" in found.found
