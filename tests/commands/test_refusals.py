"""Whatever is wrong with a log or with arguments is told in one line, with exit code 2, and nothing is left."""

import numpy as np
import pytest

from tests.support.messages import says
from tests.support.naive_logs import (
    STAMP_NS,
    cloud_said,
    laser_scan,
    odometry,
    odometry_said,
    point_cloud,
    scan_said,
    write,
)


def scanner(topic="/scan", ranges=(1.0,) * 9):
    return scan_said(STAMP_NS, laser_scan(STAMP_NS, list(ranges)), topic)


def wheels(topic):
    return odometry_said(STAMP_NS, odometry(STAMP_NS, 0, 0), topic)


XYZ = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)]
POINTS = np.zeros(20, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
NOWHERE = np.full(60, np.nan, "<f4").view(POINTS.dtype)


def cloud(points=POINTS, **lie):
    return [cloud_said(STAMP_NS, point_cloud(STAMP_NS, points, **lie))]


MALFORMED, NO_POINT = "x.mcap: scan 0 of /points is malformed", "x.mcap: scan 0 of /points has no valid point"


@pytest.mark.parametrize(
    ("name", "contents", "said"),
    [
        ("absent.mcap", None, ["absent.mcap", "no such file; check the path"]),
        (".", None, ["is a folder without a recognized log", "give MCAP"]),
        ("x.mcap", b"", ["x.mcap", "empty", "copy it again"]),
        ("x.bag", b"#ROSBAG V2.0\n" * 9, ["x.bag", "no lidar topic", "damaged to its end, at byte 13"]),
        ("x.mcap", [wheels("/wheels")], ["x.mcap", "no lidar topic", "/wheels (nav_msgs/Odometry)"]),
        ("x.mcap", [wheels(f"/wheel_{k}") for k in range(12)], ["/wheel_0", "4 more, see scanchain info"]),
        ("x.mcap", [scanner("/front"), scanner("/rear")], ["x.mcap", "--topic", "/front", "/rear"]),
        ("x.mcap", cloud(fields=XYZ[:2]), [MALFORMED, "has no field z", "it has: x, y"]),
        ("x.mcap", cloud(fields=[]), [MALFORMED, "has no field x y z"]),
        (
            "x.mcap",
            cloud(data=bytes(235)),
            [MALFORMED, "data has 235 bytes", "fewer than the 240 of 1 × 20 points of 12 bytes"],
        ),
        (
            "x.mcap",
            cloud(fields=[*XYZ[:2], ("z", 9, 7, 1)]),
            [MALFORMED, "field z reaches to byte 13", "beyond point_step 12"],
        ),
        ("x.mcap", cloud(NOWHERE), [NO_POINT, "of 20 points 20 are NaN or infinite"]),
        ("x.mcap", cloud(), [NO_POINT, "20 are (0, 0, 0)"]),
        ("x.mcap", cloud(POINTS[:0]), [NO_POINT, "the cloud is empty"]),
        (
            "x.mcap",
            [scanner(ranges=[np.inf] * 9)],
            ["scan 0 of /scan has no valid point", "of 9 beams 9 are NaN or infinite"],
        ),
    ],
)
def test_a_log_that_cannot_be_used_is_named_with_what_is_wrong(refused, tmp_path, name, contents, said):
    path = tmp_path / name
    if isinstance(contents, bytes):
        path.write_bytes(contents)
    elif contents:
        write(path, contents)
    says(refused("run", path, "--out", tmp_path / "a"), *said)


def test_a_topic_that_is_no_lidar_is_answered_with_the_lidars_alone(refused, tmp_path):
    others = [wheels(f"/wheel_{k}") for k in range(12)]
    path = write(tmp_path / "x.mcap", [scanner("/front"), scanner("/rear"), *others])
    text = refused("run", path, "--out", tmp_path / "a", "--topic", "/wheel_3")
    says(text, "topic /wheel_3 (nav_msgs/Odometry) is no lidar's; choose --topic from: /front", "/rear")
    assert "/wheel_4" not in text and len(text) < 300


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--topic", "/nope"], ["{office}", "/nope", "choose --topic from", "/scan (sensor_msgs/LaserScan)"]),
        (["--start", "100"], ["{office}", "after --start 100 s; the log is 6.0 s long"]),
        (["--start", "100", "--end", "101.5"], ["between --start 100 s and --end 101.5 s; the log is"]),
        (["--matching.max_distanc_m", "1"], ["--matching.max_distanc_m", "did you mean matching.max_distance_m?"]),
        (["--matching.max_distance_m=-1"], ["--matching.max_distance_m is -1", "a number > 0, in m"]),
        (["--matching.max_distance_m", "1e308"], ["at most 1e+50"]),
        (["--matching.max_distance_m"], ["--matching.max_distance_m needs a value", "--help"]),
        (["--config", "mine.toml"], ["mine.toml: matching.matcher is 7; it must be one of plicp, svd"]),
        (["--config", "absent.toml"], ["absent.toml", "--config"]),
        (["--every", "0"], ["--every", "log.every is 0", "whole number >= 1"]),
        (["--start", "soon"], ["--start", "'soon'", "a number >= 0, in s"]),
        (["--start", "3", "--end", "2"], ["log.start_s is 3", "below log.end_s (2)"]),
        (["--matcher", "gicp"], ["--matcher", "'gicp'", "one of plicp, svd"]),
        (["--rerun", "off,save"], ["--rerun is 'off,save'", "save, spawn, connect, web"]),
        (["--rerun", "spawn,web"], ["only one of spawn, connect, web"]),
        (["--gt", "absent.tum"], ["absent.tum", "check the path"]),
        (["--gt", "{long}.tum"], ["{long}", "longer than the file system takes (255 bytes a part); shorten it"]),
        (["--gt", "/nope"], ["log.ground_truth_topic /nope", "/odom"]),
        (["--log.odometry_topic", "/nope"], ["log.odometry_topic /nope", "/odom"]),
        (["--checkpoint", "nan"], ["nan is no number"]),
        (["--threads", "100000"], ["--threads"]),
        (["--color"], ["No such option '--color'", "scanchain run --help"]),
        (["--nosuch", "3"], ["No such option '--nosuch'; see scanchain run --help"]),
        (["--forec"], ["No such option '--forec'. Did you mean '--force'?; see"]),
        (["--log.every", "2", "--log.every=3"], ["--log.every is given twice (2, 3)"]),
        (["--matcher", "svd", "--matching.matcher", "plicp"], ["--matcher and --matching.matcher both set"]),
        (["--no-loops", "--loops.enabled", "true"], ["--no-loops and --loops.enabled both set"]),
        (["--gt", "/truth", "--log.ground_truth_topic", "/odom"], ["--gt and --log.ground_truth_topic"]),
        (["{office}"], ["{office}", "2 times", "once"]),
    ],
)
def test_a_wrong_flag_names_itself_its_value_and_what_is_allowed(
    refused, monkeypatch, tmp_path, office, flags, said
):
    (tmp_path / "mine.toml").write_text("[matching]\nmatcher = 7\n")
    check(refused, monkeypatch, tmp_path, office, ["run", "{office}", "--out", "{tmp}/a", *flags], said)


def check(refused, monkeypatch, tmp_path, office, words, said):
    monkeypatch.chdir(tmp_path)
    names = {"office": office, "tmp": tmp_path, "long": "x" * 260}
    says(refused(*(word.format(**names) for word in words)), *(part.format(**names) for part in said))


TOO_LONG = ["longer than the file system takes (255 bytes a part); shorten it"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "{office}"], ["'--out'", "scanchain run --help"]),
        (["run"], ["'LOG...'", "scanchain run --help"]),
        (["rum"], ["'rum'", "scanchain --help"]),
        (["run", "absent.mcap", "--out", "{tmp}"], ["{tmp}", "exists", "--force"]),
        (["run", "absent.mcap", "--out", "{office}"], ["is a file", "--out"]),
        (["run", "{long}", "--out", "a"], TOO_LONG),
        (["run", "{office}", "--out", "{long}"], TOO_LONG),
        (["info", "{long}"], TOO_LONG),
        (["convert", "{long}", "a.mcap"], TOO_LONG),
        (["simulate", "office", "{long}.mcap"], TOO_LONG),
        (["view", "{long}"], TOO_LONG),
        (["evaluate", "{long}", "{long}"], TOO_LONG),
        (["simulate", "mars", "x.mcap"], ["'mars'", "office, town"]),
        (["simulate", "office", "x.mcap", "--sensor", "sonar"], ["'sonar'", "lms-270"]),
        (["simulate", "office", "x.mcap", "--duration", "nan"], ["duration_s nan", "36000"]),
        (["simulate", "office", "x.mcap", "--duration", "long"], ["--duration", "simulate --help"]),
        (["simulate", "office", "x.tum"], ["x.tum", "x.mcap"]),
        (["sequence", "get", "mars"], ["'mars'", "demo-office"]),
        (["sequence", "get", "mulran"], ["mulran.mcap", "ask for a sequence", "scanchain convert"]),
        (["info", "absent.mcap"], ["absent.mcap", "check the path"]),
        (["info", "{office}", "--log.topic", "a", "--log.topic", "b"], ["--log.topic is given twice (a, b)"]),
        (["doctor", "{office}", "--topic", "a", "--log.topic", "a"], ["--topic and --log.topic"]),
        (["check", "{tmp}"], ["has no steps.parquet: no run directory, or that of an unfinished run", "--resume"]),
        (["check", "{office}"], ["is not a run directory", "--trajectory"]),
        (["check", "{office}", "{office}"], ["--trajectory"]),
        (["evaluate", "absent.tum"], ["give GT", "--relations"]),
        (["evaluate", "absent.tum", "absent.tum"], ["absent.tum", "check the path"]),
        (["evaluate", "a", "b", "--max-gap", "nan"], ["--max-gap is nan", "0 up"]),
        (["evaluate", "a", "b", "--time-offset", "soon"], ["--time-offset"]),
        (["evaluate", "a", "b", "--kitti", "--time-offset", "1"], ["files with stamps"]),
        (["evaluate", "a", "b", "--png", "{office}"], ["name a file that ends in .png"]),
        (["config", "show", "--loops.enable", "off"], ["--loops.enable", "loops.enabled"]),
        (["config", "dump", "--lidar", "4d"], ["--lidar", "'4d'", "config dump --help"]),
        (["view", "absent"], ["absent", "no such directory", "scanchain run"]),
        (["view", "absent", "--png", "a.png"], ["absent", "no such directory"]),
    ],
)
def test_a_wrong_command_line_is_one_line_with_what_to_do(refused, monkeypatch, tmp_path, office, words, said):
    check(refused, monkeypatch, tmp_path, office, words, said)
