"""Whatever is wrong with a log or with arguments is told in one line, with exit code 2, and nothing is left."""

import pytest

from tests.support.messages import says
from tests.support.naive_logs import STAMP_NS, laser_scan, scan_said, write


@pytest.mark.parametrize(
    ("name", "contents", "said"),
    [
        ("absent.mcap", None, ["absent.mcap", "no such file; check the path"]),
        (".", None, ["is a folder without a recognized log", "give MCAP"]),
        ("x.mcap", b"", ["x.mcap", "empty", "copy it again"]),
        ("x.bag", b"#ROSBAG V2.0\n" * 9, ["x.bag", "no lidar topic", "damaged to its end, at byte 13"]),
    ],
)
def test_a_log_that_cannot_be_used_is_named_with_what_is_wrong(refused, tmp_path, name, contents, said):
    if contents is not None:
        (tmp_path / name).write_bytes(contents)
    says(refused("run", tmp_path / name, "--out", tmp_path / "a"), *said)


def test_several_lidars_ask_for_a_choice_by_the_short_option_which_info_and_convert_take_too(
    call, refused, tmp_path
):
    said = [scan_said(STAMP_NS, laser_scan(STAMP_NS, [1.0] * 9), topic) for topic in ("/front", "/rear")]
    path = write(tmp_path / "two.mcap", said)
    says(refused("run", path, "--out", tmp_path / "a"), path, "--topic", "/front", "/rear")
    code, output, _ = call("info", path)
    assert code == 1 and "choose one with --topic" in output
    code, output, _ = call("info", path, "--topic", "/rear")
    assert code == 0 and "lidar     /rear: 2D, 1 scan" in output and "problem" not in output
    code, output, _ = call("convert", path, tmp_path / "rear.mcap", "--topic", "/rear")
    assert code == 0 and "/rear" in output and "/front" not in output


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--topic", "/nope"], ["{office}", "/nope", "choose --topic from", "/scan (sensor_msgs/LaserScan)"]),
        (["--topic", "/odom"], ["/odom (nav_msgs/Odometry) is no lidar's; choose --topic from", "/scan"]),
        (["--start", "100"], ["{office}", "after --start 100 s; the log is 6.0 s long"]),
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
