"""The command line: what it prints where, its exit codes, and one line for everything that can go wrong."""

import errno
import io
import json
import math
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from scanchain import lie
from scanchain.__main__ import scanchain
from scanchain.data import Trajectory
from scanchain.evaluation.metrics import evaluate as scanchain_evaluate
from scanchain.graph.g2o import read_g2o
from scanchain.logs.writer import ORIGIN, LogWriter, pack_laser_scan, pack_odometry
from scanchain.settings import flatten
from scanchain.simulation import simulate
from scanchain.trajectory import read_tum, write_kitti, write_tum
from tests.support.messages import says
from tests.support.naive_logs import (
    SECOND,
    STAMP_NS,
    cloud_said,
    laser_scan,
    odometry,
    odometry_said,
    point_cloud,
    scan_said,
    write,
)
from tests.support.scenes import ROOT, configured


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """Six seconds in the simulated office, 60 scans, with the truth beside it."""
    path = tmp_path_factory.mktemp("log") / "office.mcap"
    simulate("office", path, duration_s=6.0)
    return path


@pytest.fixture
def refused(call, tmp_path):
    """Run a command that must fail as bad input: the one line it says."""

    def run(*words):
        before = sorted(tmp_path.rglob("*"))
        code, output, errors = call(*words)
        assert code == 2 and output == ""
        assert re.fullmatch(r"error: [^\n]+\n", errors), errors
        assert "Traceback" not in errors and "Error:" not in errors
        assert sorted(tmp_path.rglob("*")) == before, "something was left behind"
        return errors

    return run


def commands(group=scanchain, words=()):
    """Every command and group with the words that call it."""
    yield words, group
    if isinstance(group, click.Group):
        for name, command in group.commands.items():
            yield from commands(command, (*words, name))


# help


@pytest.mark.parametrize("words", [words for words, _ in commands()], ids=" ".join)
@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_every_command_has_help_with_examples_of_itself(call, words, flag):
    code, output, errors = call(*words, flag)
    assert (code, errors) == (0, "")
    says(output, "Usage: scanchain", "Examples:", f"\n    {' '.join(('scanchain', *words))} ")


def test_every_option_of_every_command_says_what_it_is_for():
    for words, command in commands():
        for option in (parameter for parameter in command.params if isinstance(parameter, click.Option)):
            assert option.help, f"{words} {option.opts}"


@pytest.mark.parametrize("words", [words for words, group in commands() if isinstance(group, click.Group)])
def test_a_group_without_a_command_shows_its_help_and_fails(call, words):
    code, output, _ = call(*words)
    assert code == 2 and "Examples:" in output


def test_the_version_is_that_of_the_package(call):
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert call("--version") == (0, f"scanchain {version}\n", "")


def test_the_examples_of_run_are_commands_that_parse():
    text = next(command for words, command in commands() if words == ("run",)).help
    examples = [line.split()[1:] for line in text.splitlines() if line.strip().startswith("scanchain ")]
    assert len(examples) >= 4
    for words in examples:
        scanchain.commands["run"].make_context("run", words[1:], obj=None)


# what a log can be wrong about


def test_no_such_file(refused, tmp_path):
    says(
        refused("run", tmp_path / "absent.mcap", "--out", tmp_path / "a"),
        tmp_path / "absent.mcap",
        "no such file; check the path",
    )


def test_a_directory(refused, tmp_path):
    text = refused("run", tmp_path, "--out", tmp_path / "a")
    says(text, tmp_path, "is a folder without a recognized log", "give MCAP")


def test_an_empty_file(refused, tmp_path):
    (tmp_path / "x.mcap").touch()
    text = refused("run", tmp_path / "x.mcap", "--out", tmp_path / "a")
    says(text, tmp_path / "x.mcap", "empty", "copy it again")


def test_a_bag_that_is_none(refused, tmp_path):
    (tmp_path / "x.bag").write_bytes(b"#ROSBAG V2.0\n" * 9)
    text = refused("run", tmp_path / "x.bag", "--out", tmp_path / "a")
    says(text, tmp_path / "x.bag", "no lidar topic", "damaged to its end, at byte 13")


def test_a_log_without_a_lidar_lists_what_it_holds(refused, tmp_path):
    path = write(tmp_path / "x.mcap", [odometry_said(STAMP_NS, odometry(STAMP_NS, 0, 0), "/wheels")])
    text = refused("run", path, "--out", tmp_path / "a")
    says(text, path, "no lidar topic", "/wheels (nav_msgs/Odometry)")


def test_a_topic_that_is_not_there_or_no_lidar_lists_those_to_choose_from(refused, tmp_path, office):
    for topic in ("/nope", "/odom"):
        text = refused("run", office, "--out", tmp_path / "a", "--topic", topic)
        says(text, office, topic, "choose --topic from", "/scan (sensor_msgs/LaserScan)")


def test_a_topic_that_is_no_lidar_is_answered_with_the_lidars_alone(refused, tmp_path):
    stamp_ns = STAMP_NS
    lidars = [scan_said(stamp_ns, laser_scan(stamp_ns, [1.0] * 9), topic) for topic in ("/front", "/rear")]
    others = [odometry_said(stamp_ns, odometry(stamp_ns, 0, 0), f"/wheel_{k}") for k in range(12)]
    path = write(tmp_path / "x.mcap", [*lidars, *others])
    text = refused("run", path, "--out", tmp_path / "a", "--topic", "/wheel_3")
    says(text, "topic /wheel_3 (nav_msgs/Odometry) is no lidar's; choose --topic from: /front")
    assert "/rear" in text and "/wheel_4" not in text and len(text) < 300
    path = write(tmp_path / "y.mcap", others)
    says(refused("run", path, "--out", tmp_path / "a"), "/wheel_0", "4 more, see scanchain info")


@pytest.mark.parametrize(
    "words",
    [
        ["run", "LONG", "--out", "a"],
        ["run", "office", "--out", "LONG"],
        ["run", "office", "--out", "a", "--gt", "LONG.tum"],
        ["info", "LONG"],
        ["convert", "LONG", "a.mcap"],
        ["simulate", "office", "LONG.mcap"],
        ["view", "LONG"],
        ["evaluate", "LONG", "LONG"],
    ],
)
def test_a_name_of_260_bytes_is_one_line_with_what_to_do(refused, tmp_path, office, words):
    long = str(tmp_path / ("x" * 260))
    places = {"office": str(office)} if words[0] == "run" else {}
    places |= {"a": str(tmp_path / "a")}
    text = refused(*(places.get(word, word.replace("LONG", long)) for word in words))
    says(text, long, "longer than the file system takes (255 bytes a part); shorten it")
    assert "Errno" not in text


FULL = "the disk is full; free some space on it, or write to another one"


class _FullDisk(io.RawIOBase):
    """A file on a disk that takes so many bytes."""

    def __init__(self, room):
        self.room = room

    def writable(self):
        return True

    def seekable(self):
        return True

    def tell(self):
        return 0

    def write(self, data):
        self.room -= len(data)
        if self.room < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return len(data)


@pytest.mark.parametrize("room", [10_000, 60_000])
def test_a_full_disk_is_one_line_with_what_to_do_and_nothing_is_left(call, monkeypatch, tmp_path, room):
    opened = Path.open

    def open_there(path, *words, **options):
        file = opened(path, *words, **options)
        return io.BufferedWriter(_FullDisk(room)) if path.suffix == ".partial" else file

    monkeypatch.setattr(Path, "open", open_there)
    code, _, errors = call("simulate", "office", tmp_path / "a.mcap", "--duration", "3")
    assert code == 1
    assert errors == f"error: {tmp_path / 'a.mcap'}: {FULL}\n"
    assert not list(tmp_path.iterdir())


def test_a_disk_that_fills_up_during_a_run_is_told_once_with_what_to_do(call, monkeypatch, tmp_path, office):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("scanchain.runs.run.write_results", fail)
    code, _, errors = call("run", office, "--out", tmp_path / "a", "--rerun", "off")
    assert code == 1 and "Errno" not in errors and errors.count("full") == 1
    assert errors.startswith(f"error: {tmp_path / 'a'}: {FULL}; ")
    says(errors, "60 scans until then are in")


def test_view_of_a_directory_that_is_not_there_says_so(refused, tmp_path):
    for more in ([], ["--png", tmp_path / "a.png"]):
        says(refused("view", tmp_path / "absent", *more), tmp_path / "absent", "no such directory")


def test_several_lidars_ask_for_a_choice(refused, tmp_path):
    scans = [scan_said(STAMP_NS, laser_scan(STAMP_NS, [1.0] * 9), topic) for topic in ("/front", "/rear")]
    path = write(tmp_path / "x.mcap", scans)
    says(refused("run", path, "--out", tmp_path / "a"), path, "--topic", "/front", "/rear")


XYZ = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)]
POINTS = np.zeros(20, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
NOWHERE = np.full(60, np.nan, "<f4").view(POINTS.dtype)


@pytest.mark.parametrize(
    ("lie", "words"),
    [
        ({"fields": XYZ[:2]}, ["has no field z", "it has: x, y"]),
        ({"fields": XYZ[1:]}, ["has no field x", "it has: y, z"]),
        ({"fields": []}, ["has no field x y z"]),
        ({"data": bytes(235)}, ["data has 235 bytes", "fewer than the 240 of 1 × 20 points of 12 bytes"]),
        ({"fields": [*XYZ[:2], ("z", 9, 7, 1)]}, ["field z reaches to byte 13", "beyond point_step 12"]),
    ],
)
def test_a_malformed_cloud_is_told_by_its_number_and_what_is_wrong(refused, tmp_path, lie, words):
    path = write(tmp_path / "x.mcap", [cloud_said(STAMP_NS, point_cloud(STAMP_NS, POINTS, **lie))])
    text = refused("run", path, "--out", tmp_path / "a")
    says(text, f"{path}: scan 0 of /points is malformed", *words)


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (cloud_said(STAMP_NS, point_cloud(STAMP_NS, NOWHERE)), "of 20 points 20 are NaN or infinite"),
        (cloud_said(STAMP_NS, point_cloud(STAMP_NS, POINTS)), "20 are (0, 0, 0)"),
        (cloud_said(STAMP_NS, point_cloud(STAMP_NS, POINTS[:0])), "the cloud is empty"),
        (scan_said(STAMP_NS, laser_scan(STAMP_NS, [np.inf] * 9)), "of 9 beams 9 are NaN or infinite"),
    ],
)
def test_a_scan_without_a_valid_point_says_why_there_is_none(refused, tmp_path, said, why):
    path = write(tmp_path / "x.mcap", [said])
    text = refused("run", path, "--out", tmp_path / "a")
    says(text, f"{path}: scan 0 of {said.topic} has no valid point", why)


def test_a_span_without_a_scan_names_the_length_of_the_log(refused, tmp_path, office):
    text = refused("run", office, "--out", tmp_path / "a", "--start", "100")
    says(text, office, "after --start 100 s; the log is 6.0 s long")
    text = refused("run", office, "--out", tmp_path / "a", "--start", "100", "--end", "101.5")
    says(text, office, "between --start 100 s and --end 101.5 s; the log is")


# what arguments can be wrong about


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--matching.max_distanc_m", "1"], ["--matching.max_distanc_m", "did you mean matching.max_distance_m?"]),
        (["--matching.max_distance_m", "-1"], ["--matching.max_distance_m is -1", "a number > 0, in m"]),
        (["--matching.max_distance_m=-1"], ["--matching.max_distance_m is -1", "a number > 0, in m"]),
        (["--matching.max_distance_m"], ["--matching.max_distance_m needs a value", "--help"]),
        (["--every", "0"], ["--every", "log.every is 0", "whole number >= 1"]),
        (["--start", "soon"], ["--start", "'soon'", "a number >= 0, in s"]),
        (["--start", "3", "--end", "2"], ["log.start_s is 3", "below log.end_s (2)"]),
        (["--matcher", "gicp"], ["--matcher", "'gicp'", "one of plicp, svd"]),
        (["--rerun", "off,save"], ["--rerun is 'off,save'", "save, spawn, connect, web"]),
        (["--rerun", "spawn,web"], ["only one of spawn, connect, web"]),
        (["--rerun", ""], ["--rerun is ''", "off"]),
        (["--gt", "absent.tum"], ["absent.tum", "check the path"]),
        (["--gt", "/nope"], ["log.ground_truth_topic /nope", "/odom"]),
        (["--log.odometry_topic", "/nope"], ["log.odometry_topic /nope", "/odom"]),
        (["--config", "absent.toml"], ["absent.toml", "--config"]),
        (["--color"], ["No such option '--color'", "scanchain run --help"]),
        (["--nosuch", "3"], ["No such option '--nosuch'; see scanchain run --help"]),
        (["--forec"], ["No such option '--forec'. Did you mean '--force'?; see"]),
    ],
)
def test_a_wrong_flag_names_itself_its_value_and_what_is_allowed(refused, tmp_path, office, flags, words):
    says(refused("run", office, "--out", tmp_path / "a", *flags), *words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[matching]\nmax_distanc_m = 1", ["matching.max_distanc_m", "did you mean matching.max_distance_m?"]),
        ("[matching]\nmax_distance_m = -1", ["matching.max_distance_m is -1", "a number > 0, in m"]),
        ("[matching\n", ["is not TOML", "line 1"]),
    ],
)
def test_a_wrong_config_file_is_named_with_the_key(refused, tmp_path, office, text, words):
    (tmp_path / "mine.toml").write_text(text)
    says(refused("run", office, "--out", tmp_path / "a", "--config", tmp_path / "mine.toml"), "mine.toml", *words)


def test_missing_arguments_point_to_the_help(refused, office):
    says(refused("run", office), "'--out'", "scanchain run --help")
    says(refused("run"), "'LOG...'", "scanchain run --help")
    says(refused("rum"), "'rum'", "scanchain --help")


def test_an_existing_out_is_refused_before_anything_is_read(refused, tmp_path):
    (tmp_path / "a").mkdir()
    text = refused("run", tmp_path / "absent.mcap", "--out", tmp_path / "a")
    says(text, tmp_path / "a", "exists", "--force")
    (tmp_path / "file").touch()
    says(refused("run", tmp_path / "absent.mcap", "--out", tmp_path / "file"), "is a file", "--out")


def test_a_file_named_twice_is_refused(refused, tmp_path, office):
    says(refused("run", office, office, "--out", tmp_path / "a"), office, "2 times", "once")


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["simulate", "mars", "x.mcap"], ["'mars'", "office, town"]),
        (["simulate", "office", "x.mcap", "--sensor", "sonar"], ["'sonar'", "lms-270"]),
        (["simulate", "office", "x.mcap", "--duration", "nan"], ["duration_s nan", "36000"]),
        (["simulate", "office", "x.mcap", "--duration", "long"], ["--duration", "simulate --help"]),
        (["simulate", "office", "x.tum"], ["x.tum", "x.mcap"]),
        (["sequence", "get", "mars"], ["'mars'", "demo-office"]),
        (
            ["sequence", "get", "mulran", "--out", "logs"],
            ["mulran.mcap", "ask for a sequence", "scanchain convert"],
        ),
        (["info", "absent.mcap"], ["absent.mcap", "check the path"]),
        (["evaluate", "absent.tum"], ["give GT", "--relations"]),
        (["evaluate", "absent.tum", "absent.tum"], ["absent.tum", "check the path"]),
        (["config", "show", "--loops.enable", "off"], ["--loops.enable", "loops.enabled"]),
        (["config", "dump", "--lidar", "4d"], ["--lidar", "'4d'", "config dump --help"]),
        (["view", "absent"], ["absent", "scanchain run"]),
    ],
)
def test_the_other_commands_refuse_in_one_line_too(refused, monkeypatch, tmp_path, words, parts):
    monkeypatch.chdir(tmp_path)
    says(refused(*words), *parts)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--checkpoint", "nan"), "nan is no number"),
        (("--threads", "100000"), "--threads"),
        (("--matching.max_distance_m", "1e308"), "at most 1e+50"),
    ],
)
def test_a_number_that_no_run_can_use_is_refused_before_it_begins(refused, tmp_path, office, flags, words):
    assert words in refused("run", office, "--out", tmp_path / "run", *flags)


def test_one_true_pose_is_no_accuracy(call, tmp_path, office):
    truth = read_tum(office.with_suffix(".tum"))
    write_tum(tmp_path / "one.tum", Trajectory(truth.stamps_ns[:1], truth.poses[:1]))
    flags = ("--out", tmp_path / "run", "--rerun", "off", "--gt", tmp_path / "one.tum")
    code, output, _ = call("run", office, *flags)
    assert code == 0 and "\nATE " not in output
    says(output, "no accuracy against", "one.tum: one paired pose alone")
    code, output, errors = call("evaluate", tmp_path / "run" / "trajectory.tum", tmp_path / "one.tum")
    assert code == 2 and "0.0000 m" not in output
    says(errors, "one paired pose alone")


@pytest.mark.parametrize("limit", ["nan", "-1", "inf"])
def test_a_gap_that_is_no_time_is_refused(refused, office, limit):
    truth = office.with_suffix(".tum")
    says(refused("evaluate", truth, truth, "--max-gap", limit), f"--max-gap is {limit}", "0 up")


def test_an_error_of_ours_is_one_line_with_exit_code_1_too(call, monkeypatch, office):
    def broken(*_):
        raise RuntimeError("two\nlines")

    monkeypatch.setattr("scanchain.logs.info.describe", broken)
    monkeypatch.delenv("SCANCHAIN_DEBUG", raising=False)
    code, output, errors = call("info", office)
    assert (code, output) == (1, "")
    assert errors == "error: RuntimeError: two lines; SCANCHAIN_DEBUG=1 shows the traceback\n"
    monkeypatch.setenv("SCANCHAIN_DEBUG", "1")
    with pytest.raises(RuntimeError):
        call("info", office)


def test_ctrl_c_is_one_line_with_exit_code_1(call, monkeypatch, office):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("scanchain.logs.info.describe", interrupted)
    code, output, errors = call("info", office)
    assert (code, output, errors.strip()) == (1, "", "error: interrupted")


def test_an_interruption_while_the_imports_run_is_one_line_too():
    stopped_at = (
        "import sys; from scanchain.entry import main\nclass Stop:\n def find_spec(*_): raise KeyboardInterrupt\n"
    )
    command = [sys.executable, "-c", f"{stopped_at}sys.meta_path.insert(0, Stop()); sys.exit(main())"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "error: interrupted\n")
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"scanchain": "scanchain.entry:main"}


# run


def test_a_run_is_quiet_but_for_its_summary_when_piped(call, tmp_path, office):
    code, output, errors = call("run", office, "--out", tmp_path / "a")
    assert (code, errors) == (0, "")
    assert output == (tmp_path / "a" / "summary.txt").read_text() + f"written        {tmp_path / 'a'}\n"
    says(output, office, "/scan", "preset lidar2d of 2D logs", "60 over 5.9 s: 60 ok")


def test_json_prints_the_metrics_and_nothing_else(call, tmp_path, office):
    code, output, errors = call("run", office, "--out", tmp_path / "a", "--json", "--rerun", "off")
    assert (code, errors) == (0, "")
    assert json.loads(output) == json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert json.loads(output)["scans"] == 60


def test_a_run_whose_scans_tell_too_little_says_so_first_and_fails_with_its_results_written(call, tmp_path):
    path, out = tmp_path / "radar.mcap", tmp_path / "a"
    rng = np.random.default_rng(0)
    with LogWriter(path) as log:
        for k in range(20):
            log.point_cloud("/radar", k * SECOND // 10 + STAMP_NS, "radar", rng.uniform(-40.0, 40.0, (12, 3)))
    code, output, errors = call("run", path, "--out", out, "--rerun", "off")
    assert code == 1 and len(errors.splitlines()) == 1
    metrics = json.loads((out / "metrics.json").read_text())
    why = metrics["verdict_reason"]
    says(why, f"{metrics['degenerate']} of 20 scans are degenerate and {metrics['lost']} lost")
    says(why, "scans have 12 valid points", "radar", "--topic")
    assert errors.splitlines()[0] == f"error: {out}: not trustworthy: {why}"
    for summary in (output, (out / "summary.txt").read_text()):
        assert summary.splitlines()[0] == f"verdict        not trustworthy: {why}"
        assert summary.splitlines()[1].startswith(f"{path} /radar")
    says((out / "report.html").read_text(), *why.replace("'", "&#39;").split("; "))
    assert json.loads((out / "run.json").read_text())["complete"] and (out / "map.ply").exists()
    code, output, errors = call("run", path, "--out", out, "--force", "--rerun", "off", "--json")
    assert code == 1 and json.loads(output)["verdict"] == metrics["verdict"] == "not trustworthy"
    assert errors.startswith(f"error: {out}: not trustworthy: {why}\n")
    code, output, errors = call("check", out)
    assert (code, output.splitlines()[0], errors) == (1, f"not trustworthy: {why}", "")


def test_the_directory_of_a_run_that_did_not_finish_is_named_as_such(call, tmp_path):
    code, _, errors = call("check", tmp_path)
    assert code == 2
    says(errors, f"{tmp_path}: has no steps.parquet: no run directory, or that of an unfinished run", "--resume")


def test_a_run_of_the_office_is_trustworthy_and_so_is_its_true_trajectory_but_not_one_that_jumps(
    call, tmp_path, office
):
    out = tmp_path / "a"
    code, output, _ = call("run", office, "--out", out, "--rerun", "off", "--json", "--strict")
    metrics = json.loads(output)
    assert code == 0 and metrics["verdict"] == "trustworthy" and metrics["stretches"] == []
    code, output, _ = call("check", out, "--json")
    assert code == 0 and json.loads(output) == {
        name: metrics[name] for name in ("verdict", "verdict_error", "verdict_reason", "stretches")
    }
    expected = metrics["expected_ate_m"]
    assert metrics["verdict_error"] == f"ATE {expected['low']:.3f} to {expected['high']:.3f} m with 95 %"
    first, *_ = (out / "summary.txt").read_text().splitlines()
    assert first == f"verdict        trustworthy ({metrics['verdict_error']}): {metrics['verdict_reason']}"
    assert metrics["verdict_reason"].startswith(f"nothing to check in 60 scans: {metrics['ok']} ok")
    truth = office.with_suffix(".tum")
    code, output, _ = call("check", "--trajectory", truth, office)
    (bound_m,) = map(float, re.findall(r"^trustworthy \(ATE below ([\d.]+) m by scan matching\): ", output))
    assert code == 0 and 0.0 < bound_m < 0.1 and "wheels" in output
    poses = read_tum(truth)
    poses.poses[len(poses) // 2 :, 0, 3] += 3.0
    write_tum(tmp_path / "jump.tum", poses)
    code, output, _ = call("check", "--trajectory", tmp_path / "jump.tum", office)
    assert code == 1 and output.startswith("not trustworthy: ") and "impossible acceleration by " in output
    says(call("check", office)[2], "error: ", "--trajectory")
    says(call("check", tmp_path)[2], "error: ", "steps.parquet", "run directory")


def test_rerun_off_leaves_out_the_recording_alone(call, tmp_path, office):
    call("run", office, "--out", tmp_path / "with")
    call("run", office, "--out", tmp_path / "without", "--rerun", "off")
    files = [{path.name for path in (tmp_path / name).iterdir()} for name in ("with", "without")]
    assert files[0] - files[1] == {"recording.rrd"} and files[1] < files[0]


def metrics(folder):
    return json.loads((folder / "metrics.json").read_text())


def config(folder):
    return flatten_toml((folder / "config.toml").read_text())


def flatten_toml(text):
    return {f"{a}.{b}": value for a, branch in tomllib.loads(text).items() for b, value in branch.items()}


def stamps(folder):
    return [line.split()[0] for line in (folder / "trajectory.tum").read_text().splitlines()]


def test_start_end_and_every_choose_scans(call, tmp_path, office):
    out = ["--rerun", "off", "--out"]
    assert call("run", office, *out, tmp_path / "whole")[0] == 0
    assert call("run", office, *out, tmp_path / "a", "--start", "1", "--end", "3", "--every", "2")[0] == 0
    whole, chosen = stamps(tmp_path / "whole"), stamps(tmp_path / "a")
    # a scan is logged at its end: the one that begins 0.9 s after the log's begin is the first
    assert chosen == whole[9:30:2]
    values = config(tmp_path / "a")
    assert (values["log.start_s"], values["log.end_s"], values["log.every"]) == (1.0, 3.0, 2)


def test_an_end_beyond_that_of_the_log_is_a_note_and_a_start_beyond_it_an_error(call, tmp_path, office):
    code, output, _ = call("run", office, "--end", "99", "--rerun", "off", "--out", tmp_path / "a")
    assert code == 0
    says(output, "note           --end 99 s has no effect: the log ends at ")
    code, _, errors = call("run", office, "--start", "99", "--out", tmp_path / "b")
    assert code == 2 and errors.count("\n") == 1
    says(errors, "no scan of /scan lies after --start 99 s; the log is ")


def test_info_and_compare_take_the_part_that_run_takes(call, tmp_path, office):
    part = ("--topic", "/scan", "--start", "1", "--end", "3", "--every", "2")
    says(call("info", office, *part)[1], "/scan: 2D, 11 scans")
    code, output, _ = call("compare", office, *part, "--methods", "plicp", "--out", tmp_path / "c", "--json")
    assert code == 0 and json.loads(output)["scans"] == 11


def test_the_short_flags_stand_for_keys(call, tmp_path, office):
    out = ["--rerun", "off", "--force", "--out", tmp_path / "a"]
    assert call("run", office, *out, "--matcher", "svd", "--no-loops", "--topic", "/scan")[0] == 0
    expected = {"matching.matcher": "svd", "loops.enabled": False, "log.topic": "/scan"}
    assert config(tmp_path / "a") == flatten(configured(2)) | expected
    words = ["--matching.matcher", "svd", "--loops.enabled=true", "--local_map.voxel_size_m", "0.15"]
    assert call("run", office, *words, *out)[0] == 0
    expected = {"matching.matcher": "svd", "local_map.voxel_size_m": 0.15}
    assert config(tmp_path / "a") == flatten(configured(2)) | expected


def test_a_run_killed_before_its_first_checkpoint_is_named_when_it_starts_over(call, tmp_path, office):
    (tmp_path / "a.partial-1").mkdir()
    code, _, errors = call("run", office, "--rerun", "off", "--out", tmp_path / "a", "--resume")
    assert code == 0
    says(errors, "a.partial-1: no checkpoint to resume from, this run starts over")


def test_the_heading_says_whether_the_wheels_are_used(call, tmp_path, office):
    out = ["--rerun", "off", "--force", "--out", tmp_path / "a"]
    says(
        call("run", office, *out)[1].splitlines()[1],
        "(wheel odometry /odom; lidar at x 0.15, y 0.00 m of the base)",
    )
    _, output, _ = call("run", office, *out, "--odometry.prior", "constant-velocity")
    says(output.splitlines()[1], "wheel odometry /odom, not used: odometry.prior is constant-velocity;")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "--log.every", "2", "--log.every=3"], ["--log.every is given twice (2, 3)"]),
        (
            ["run", "--matcher", "svd", "--matching.matcher", "plicp"],
            ["--matcher and --matching.matcher both set"],
        ),
        (["run", "--no-loops", "--loops.enabled", "true"], ["--no-loops and --loops.enabled both set"]),
        (["run", "--gt", "/truth", "--log.ground_truth_topic", "/odom"], ["--gt and --log.ground_truth_topic"]),
        (["doctor", "--topic", "/scan", "--log.topic", "/scan"], ["--topic and --log.topic"]),
        (["info", "--log.topic", "/scan", "--log.topic", "/scan"], ["--log.topic is given twice"]),
    ],
)
def test_what_has_one_value_is_given_once(refused, tmp_path, office, words, said):
    command, *flags = words
    out = ["--out", tmp_path / "a"] if command in ("run", "compare", "batch") else []
    says(refused(command, office, *out, *flags), *said)


def test_a_config_file_changes_the_preset_and_is_named(call, tmp_path, office):
    mine = tmp_path / "mine.toml"
    mine.write_text("[maps]\nvoxel_size_m = 0.4\n")
    _, output, _ = call("run", office, "--out", tmp_path / "a", "--rerun", "off", "--config", mine, "--every", "2")
    source = f"preset lidar2d of 2D logs, {mine}, log.every 2"
    says(output, f"configuration  {source}")
    assert config(tmp_path / "a") == flatten(configured(2)) | {"maps.voxel_size_m": 0.4, "log.every": 2}
    assert json.loads((tmp_path / "a" / "run.json").read_text())["configuration"] == source


@pytest.mark.parametrize("matcher", ["plicp", "svd"])
def test_both_matchers_stay_on_the_way_in_the_office(call, tmp_path, office, matcher):
    call("run", office, "--out", tmp_path / "a", "--rerun", "off", "--matcher", matcher)
    found = metrics(tmp_path / "a")
    assert found["ok"] == 60 and found["ground_truth"]["optimized"]["ate_rmse_m"] < 0.02


def test_ground_truth_is_taken_from_the_file_named_else_from_the_log(call, tmp_path, office):
    truth = np.loadtxt(office.with_suffix(".tum"))
    stretched = truth * np.array([1.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    lines = [f"{a:.9f} " + " ".join(map(repr, rest)) for a, *rest in stretched.tolist()]
    (tmp_path / "other.tum").write_text("\n".join(lines))
    sources = {"log": [], "/ground_truth": ["--gt", "/ground_truth"], "/odom": ["--gt", "/odom"]}
    sources["other"] = ["--gt", tmp_path / "other.tum"]
    sources["same"] = ["--gt", office.with_suffix(".tum")]
    call("run", office, "--out", tmp_path / "none", "--rerun", "off", "--gt", "none")
    assert metrics(tmp_path / "none")["ground_truth"] is None
    ate_m, named = {}, {}
    for name, flags in sources.items():
        out = tmp_path / name.strip("/")
        call("run", office, "--out", out, "--rerun", "off", "--force", *flags)
        found = metrics(out)["ground_truth"]
        ate_m[name], named[name] = found["optimized"]["ate_rmse_m"], found["source"]
    assert ate_m["log"] == ate_m["/ground_truth"] == pytest.approx(ate_m["same"], abs=1e-7)
    assert ate_m["other"] > 0.3
    assert named == {
        "log": "/ground_truth",
        "/ground_truth": "/ground_truth",
        "/odom": "/odom",
        "same": str(office.with_suffix(".tum")),
        "other": str(tmp_path / "other.tum"),
    }


def test_a_truth_of_another_time_is_refused_before_the_work_with_both_spans(refused, tmp_path, office):
    (tmp_path / "old.tum").write_text("1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n")
    words = ["run", office, "--out", tmp_path / "a", "--rerun", "off", "--gt"]
    first, last = read_tum(office.with_suffix(".tum")).stamps_ns[[0, -1]] / 1e9
    says(refused(*words, tmp_path / "old.tum"), "old.tum", "1.000 to 2.000 s", f"{first:.3f} to {last:.3f} s")
    assert not (tmp_path / "a").exists()


def test_a_topic_of_true_poses_that_keeps_another_clock_is_refused_before_the_work(refused, tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        for k in range(20):
            at_ns = 10**18 + k * 10**8
            scan = pack_laser_scan(at_ns, "lidar", -1.5, 0.1, np.full(31, 3.0), range_min_m=0.1, range_max_m=9.0)
            log.append("/scan", "sensor_msgs/msg/LaserScan", scan, at_ns)
            true_ns = 5 * 10**9 + k * 10**8
            pose = pack_odometry(true_ns, "world", "lidar", ORIGIN)
            log.append("/mocap", "nav_msgs/msg/Odometry", pose, true_ns, at_ns)
    words = ["run", tmp_path / "a.mcap", "--out", tmp_path / "a", "--rerun", "off", "--gt"]
    says(refused(*words, "/mocap"), "/mocap", "5.000 to 6.900 s", "1000000000.000 to 1000000001.900 s")
    says(refused(*words, "/ground_truth"), "/ground_truth", "scanchain info")


def test_true_poses_too_far_apart_are_a_warning_and_the_run_stands(call, tmp_path, office):
    ends = read_tum(office.with_suffix(".tum")).stamps_ns[[0, -1]] / 1e9 + np.array([-1.0, 1.0])
    (tmp_path / "ends.tum").write_text("".join(f"{stamp:.9f} {k} 0 0 0 0 0 1\n" for k, stamp in enumerate(ends)))
    code, _, errors = call("run", office, "--out", tmp_path / "a", "--rerun", "off", "--gt", tmp_path / "ends.tum")
    assert code == 0 and errors.count("\n") == 1
    assert errors.startswith(f"warning: no accuracy against {tmp_path / 'ends.tum'}: ")
    says((tmp_path / "a" / "summary.txt").read_text(), "no accuracy against", "--max-gap")
    assert metrics(tmp_path / "a")["ground_truth"] is None
    words = ["run", office, "--rerun", "off", "--gt", tmp_path / "ends.tum", "--max-gap", "100"]
    code, _, errors = call(*words, "--out", tmp_path / "b")
    assert code == 0 and "s apart, and the path between them is taken as straight" in errors
    assert metrics(tmp_path / "b")["ground_truth"]["max_gap_s"] == 100.0
    assert "Accuracy" in (tmp_path / "b" / "report.html").read_text()
    picture = tmp_path / "b.png"
    assert call("view", tmp_path / "b", "--png", picture)[0] == 0
    before = picture.read_bytes()
    picture.write_bytes(b"mine")
    code, _, errors = call("view", tmp_path / "b", "--png", picture)
    assert code == 2 and "--force" in errors and picture.read_bytes() == b"mine"
    assert call("view", tmp_path / "b", "--png", picture, "--force")[0] == 0
    assert picture.read_bytes() == before


def test_truth_at_another_rate_judges_every_scan_that_it_spans(call, tmp_path, office):
    """Every third true pose, 30 ms later, and none of the last second: within 10 ms of a scan there is none."""
    truth = read_tum(office.with_suffix(".tum"))
    fast = Trajectory(*interpolated_at(truth, truth.stamps_ns[:-1:3] + 30_000_000))
    write_tum(tmp_path / "late.tum", Trajectory(fast.stamps_ns[:-4], fast.poses[:-4]))
    out = tmp_path / "a"
    _, output, errors = call("run", office, "--out", out, "--rerun", "off", "--gt", tmp_path / "late.tum")
    found = metrics(out)["ground_truth"]["optimized"]
    assert errors == "" and found["pairs"] == 45
    assert found["missing"] == "15 without a true pose: 1 before the truth begins, 14 after it ends"
    says(output, f"45 scans; {found['missing']}")
    assert found["ate_rmse_m"] < 0.02
    _, output, _ = call("evaluate", out / "trajectory.tum", tmp_path / "late.tum")
    says(output, found["missing"], "interpolated (position linear, rotation by SLERP, gaps up to 0.6 s)")


def test_a_truth_of_few_scans_is_a_warning_that_says_why(call, tmp_path, office, monkeypatch):
    truth = read_tum(office.with_suffix(".tum"))
    write_tum(tmp_path / "part.tum", Trajectory(truth.stamps_ns[10:30], truth.poses[10:30]))
    words = ["run", office, "--out", tmp_path / "a", "--rerun", "off", "--gt", tmp_path / "part.tum"]
    code, output, errors = call(*words)
    few = "accuracy is that of 20 of 60 scans alone: 40 without a true pose: 10 before the truth begins, 30 after"
    assert code == 0 and errors.startswith(f"warning: {few}")
    says(output, f"warning        {few}")
    assert metrics(tmp_path / "a")["warnings"] == [errors.removeprefix("warning: ").strip()]
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    code, output, errors = call(*words, "--force")
    assert output.count(few) == 1 and errors == ""  # a terminal shows both, and the summary has it


def interpolated_at(truth, stamps_ns):
    """Planar truth at other stamps, by hand."""
    yaw = np.unwrap(np.arctan2(truth.poses[:, 1, 0], truth.poses[:, 0, 0]))
    columns = [np.interp(stamps_ns, truth.stamps_ns, v) for v in (truth.poses[:, 0, 3], truth.poses[:, 1, 3], yaw)]
    return stamps_ns, lie.lift(np.array([lie.pose_2d(*row) for row in zip(*columns, strict=True)]))


def test_run_and_evaluate_take_kitti_poses_a_row_a_scan_as_compare_does(call, refused, tmp_path, office):
    truth = read_tum(office.with_suffix(".tum"))
    write_kitti(tmp_path / "poses.txt", truth)
    words = ["run", office, "--rerun", "off", "--gt", tmp_path / "poses.txt", "--out"]
    assert call(*words, tmp_path / "a")[0] == 0
    call("run", office, "--rerun", "off", "--out", tmp_path / "b")
    found, same = (metrics(tmp_path / name)["ground_truth"]["optimized"] for name in "ab")
    assert found["pairs"] == 60 and found["ate_rmse_m"] == pytest.approx(same["ate_rmse_m"], abs=1e-7)
    says(refused(*words, tmp_path / "c", "--end", "3"), "60 lines for 30 scans")
    assert not (tmp_path / "c").exists()
    tree = json.loads(call("evaluate", tmp_path / "a" / "trajectory.tum", tmp_path / "poses.txt", "--json")[1])
    assert tree["ate"]["translation_m"]["rmse"] == pytest.approx(found["ate_rmse_m"], abs=1e-6)


def test_a_log_in_two_files_gives_what_the_one_file_gives(call, tmp_path, office):
    halves = [tmp_path / "0.mcap", tmp_path / "1.mcap"]
    split(office, halves)
    out = ["--rerun", "off", "--out"]
    call("run", office, *out, tmp_path / "whole")
    code, output, errors = call("run", *halves, *out, tmp_path / "a")
    assert (code, errors) == (0, "")
    says(output, f"{halves[0]}, {halves[1]} /scan")
    for name in ("trajectory.tum", "odometry.tum", "graph.g2o", "map.ply"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    logs = json.loads((tmp_path / "a" / "run.json").read_text())["logs"]
    assert [log["path"] for log in logs] == list(map(str, halves))


def split(path, halves):
    """Write the messages of a log into two, each with its own schemas and channels."""
    with path.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages())
    middle = len(messages) // 2
    for half, part in zip(halves, (messages[:middle], messages[middle:]), strict=True):
        with half.open("wb") as stream:
            writer, channels = Writer(stream), {}
            writer.start(profile="ros2")
            for schema, channel, message in part:
                if channel.topic not in channels:
                    number = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
                number = channels[channel.topic]
                writer.add_message(number, message.log_time, message.data, message.publish_time)
            writer.finish()


def test_a_log_cut_off_is_read_up_to_the_damage_and_the_damage_is_told(call, tmp_path, office):
    path = tmp_path / "cut.mcap"
    whole = office.read_bytes()
    path.write_bytes(whole[: len(whole) * 9 // 10])
    code, output, errors = call("run", path, "--out", tmp_path / "a")
    count = len(stamps(tmp_path / "a"))
    assert code == 0 and 30 < count < 60
    assert all(line.startswith("warning: ") for line in errors.splitlines())
    says(errors, path, "cut off", f"{count} scans of /scan were recovered")
    says((tmp_path / "a" / "summary.txt").read_text(), "cut off", f"{count} scans of /scan were recovered")
    assert "cut off" in output and json.loads((tmp_path / "a" / "run.json").read_text())["complete"]


def test_a_log_cut_off_before_its_first_scan_is_refused(refused, tmp_path, office):
    path = tmp_path / "cut.mcap"
    path.write_bytes(office.read_bytes()[:200])
    says(refused("run", path, "--out", tmp_path / "a"), path)


def test_a_robot_that_stands_still_gives_a_run_with_one_keyframe(call, tmp_path):
    ranges = [np.linspace(1.0, 3.0, 200)] * 5
    said = [scan_said(STAMP_NS + k * SECOND, laser_scan(STAMP_NS + k * SECOND, r)) for k, r in enumerate(ranges)]
    path = write(tmp_path / "still.mcap", said)
    for number in range(5):  # more than once: what is read beyond an array depends on what lies there
        out = tmp_path / str(number)
        code, _, errors = call("run", path, "--out", out, "--rerun", "off")
        assert (code, errors) == (0, "")
        assert metrics(out)["keyframes"] == 1 and metrics(out)["traveled_m"] < 0.01


# the other commands


def test_info_tells_topics_rates_and_what_a_run_would_use(call, office):
    code, output, errors = call("info", office)
    assert (code, errors) == (0, "")
    says(output, office, "/odom", "/tf_static", "lidar     /scan: 2D, 60 scans", "wheels    /odom")
    assert re.search(r"topic     /scan +sensor_msgs/LaserScan +60 messages +10\.0 Hz  cdr", output)
    says(output, "1 message ")


@pytest.mark.parametrize("chunk_size", [1 << 20, 500])
def test_twenty_scans_at_10_hz_are_told_as_10_hz_however_long_the_log_is_besides(call, tmp_path, chunk_size):
    stamps_ns = [STAMP_NS + k * SECOND // 10 for k in range(20)]
    said = [odometry_said(STAMP_NS + k * SECOND, odometry(STAMP_NS, 0, 0)) for k in (-5, 8)]
    said += [scan_said(stamp, laser_scan(stamp, [1.0] * 9)) for stamp in stamps_ns]
    path = write(tmp_path / "x.mcap", said, chunk_size=chunk_size)
    rates = {topic["topic"]: topic["rate_hz"] for topic in json.loads(call("info", path, "--json")[1])["topics"]}
    assert rates["/scan"] == pytest.approx(10.0) and rates["/odom"] == pytest.approx(1.0 / 13.0)


def test_info_as_json_counts_what_the_mcap_package_counts(call, office):
    code, output, errors = call("info", office, "--json")
    assert (code, errors) == (0, "")
    said = json.loads(output)
    with office.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    counts = {
        channel.topic: summary.statistics.channel_message_counts[number]
        for number, channel in summary.channels.items()
    }
    assert {topic["topic"]: topic["messages"] for topic in said["topics"]} == counts
    assert (said["lidar"], said["dimension"], said["scans"]) == ("/scan", 2, 60)
    assert (said["odometry"], said["problem"], said["damage"]) == ("/odom", "", [])


def test_info_of_a_log_without_a_lidar_says_so_and_still_lists_it(call, tmp_path):
    path = write(tmp_path / "x.mcap", [odometry_said(STAMP_NS, odometry(STAMP_NS, 0, 0))])
    code, output, _ = call("info", path)
    assert code == 1
    says(output, "topic     /odom", f"problem   {path}: has no lidar topic")


def test_info_of_a_damaged_log_tells_the_damage(call, tmp_path, office):
    path = tmp_path / "cut.mcap"
    path.write_bytes(office.read_bytes()[:-2000])
    says(call("info", path)[1], "damage ", "cut off")
    assert json.loads(call("info", path, "--json")[1])["damage"]


def quarter(path, scale=1.0, count=40):
    """Poses on a quarter of a circle of 20 m, tangential, a second apart."""
    lines = []
    for k in range(count):
        a = 0.5 * math.pi * k / (count - 1)
        x, y = 20.0 * scale * math.sin(a), 20.0 * scale * (1.0 - math.cos(a))
        lines.append(f"{100 + k}.0 {x!r} {y!r} 0 0 0 {math.sin(0.5 * a)!r} {math.cos(0.5 * a)!r}\n")
    path.write_text("".join(lines))
    return path


def test_evaluate_prints_every_metric_with_its_definition(call, tmp_path):
    estimate, truth = quarter(tmp_path / "est.tum", 1.1), quarter(tmp_path / "gt.tum")
    code, output, errors = call("evaluate", estimate, truth)
    assert code == 0
    (warning,) = errors.splitlines()
    says(warning, "warning: far from the ground truth: ATE 0.89 m, 2.8 %")
    says(output, "ATE rmse", "‖t_ref − t_est‖", "RPE over 10 m along the reference: rmse ", "KITTI: translation")
    assert output.count("40 of 40 estimated poses") == 1 and "gaps up to" not in output
    tree = json.loads(call("evaluate", estimate, truth, "--align", "first", "--json")[1])
    assert set(tree) == {"ate", "rpe_1_pose", "rpe_1_s", "rpe_10_m", "rpe_100_m", "kitti"}
    assert tree["ate"]["path_length_m"] == pytest.approx(10.0 * math.pi, rel=1e-3)
    assert tree["ate"]["translation_m"]["maximum"] == pytest.approx(0.1 * 20.0 * 2**0.5, rel=1e-6)
    assert tree["kitti"]["translation_share"] == pytest.approx(0.1, rel=0.05)


def test_evaluate_finds_scale_and_time_offset_and_measures_without_them(call, refused, tmp_path):
    t_s, truth = np.arange(400) / 10.0, tmp_path / "gt.tum"
    rows = (8.0 * np.sin(0.4 * t_s) + 2.0 * np.sin(1.1 * t_s), 6.0 * np.cos(0.3 * t_s), 0.2 * t_s)
    true = lie.lift(np.array([lie.pose_2d(*row) for row in zip(*rows, strict=True)]))
    stamps_ns = STAMP_NS + np.arange(400) * SECOND // 10
    write_tum(truth, Trajectory(stamps_ns, true))
    poses = lie.lift(lie.pose_2d(3.0, -2.0, 0.7)) @ true
    poses[:, :3, 3] /= 4.0
    write_tum(tmp_path / "est.tum", Trajectory(stamps_ns + 130_000_000, poses))
    words = ["evaluate", tmp_path / "est.tum", truth]
    assert json.loads(call(*words, "--json")[1])["ate"]["translation_m"]["rmse"] > 1.0
    tree = json.loads(call(*words, "--scale", "--time-offset", "auto", "--json")[1])
    assert tree["scale"] == pytest.approx(4.0, rel=1e-3) and tree["time_offset_s"] == pytest.approx(
        -0.13, abs=1e-3
    )
    assert tree["ate"]["translation_m"]["rmse"] < 1e-3
    _, output, _ = call(*words, "--scale", "--time-offset", "-0.13")
    says(output, "time offset -0.1300 s added", "scale 4 put on", "ATE rmse 0.0000")
    result = scanchain_evaluate(tmp_path / "est.tum", truth, scale=True, time_offset="auto")
    assert (result.scale, result.time_offset_s) == (tree["scale"], tree["time_offset_s"])
    says(refused(*words, "--time-offset", "soon"), "--time-offset")
    says(refused("evaluate", truth, truth, "--kitti", "--time-offset", "1"), "files with stamps")
    write_tum(tmp_path / "still.tum", Trajectory(stamps_ns, np.tile(np.eye(4), (400, 1, 1))))
    says(refused("evaluate", tmp_path / "still.tum", truth, "--scale"), "undetermined")


def test_evaluate_puts_several_estimates_into_a_table_and_a_picture(call, refused, tmp_path, office):
    call("run", office, "--out", tmp_path / "a", "--rerun", "off", "--every", "2")
    truth, png = office.with_suffix(".tum"), tmp_path / "paths.png"
    code, output, _ = call("evaluate", tmp_path / "a", tmp_path / "a" / "odometry.tum", truth, "--png", png)
    rows = output.splitlines()
    assert code == 0 and rows[0].split()[:2] == ["estimate", "paired"] and png.stat().st_size > 10_000
    assert [row.split()[:2] for row in rows[2:4]] == [
        [f"{tmp_path}/a", "30"],
        [f"{tmp_path}/a/odometry.tum", "30"],
    ]
    trees = json.loads(
        call("evaluate", tmp_path / "a", tmp_path / "a" / "odometry.tum", "--gt", truth, "--json")[1]
    )
    alone = json.loads(call("evaluate", tmp_path / "a" / "trajectory.tum", truth, "--json")[1])
    assert trees[f"{tmp_path}/a"] == alone
    assert rows[2].split()[4] == f"{alone['ate']['translation_m']['rmse']:.4f}"
    says(refused("evaluate", tmp_path / "a", truth, "--png", png), "paths.png: exists")


def test_evaluate_of_a_trajectory_with_itself_is_zero(call, tmp_path):
    truth = quarter(tmp_path / "gt.tum")
    tree = json.loads(call("evaluate", truth, truth, "--json")[1])
    assert tree["ate"]["translation_m"]["rmse"] < 1e-9 and tree["rpe_10_m"]["translation_m"]["rmse"] < 1e-9


def test_evaluate_says_which_metric_a_short_way_leaves_out(call, tmp_path):
    short = quarter(tmp_path / "gt.tum", 0.1)
    code, output, _ = call("evaluate", short, short)
    assert code == 0
    says(
        output, "ATE rmse", "not computed: RPE over 10 m along the reference: no stretch of that length fits",
        "not computed: KITTI metric: no stretch of 10 m fits into a path of ",
    )  # fmt: skip
    assert json.loads(call("evaluate", short, short, "--json")[1])["kitti"] is None


def test_evaluate_measures_relations_alone_and_beside_the_truth(call, tmp_path):
    truth = quarter(tmp_path / "gt.tum")
    step = 0.5 * math.pi / 39
    x, y = 20.0 * math.sin(step) + 0.05, 20.0 * (1.0 - math.cos(step))  # wrong by 5 cm
    (tmp_path / "set.relations").write_text(f"103.0 104.0 {x} {y} 0 0 0 {step}\n")
    code, output, _ = call("evaluate", truth, "--relations", tmp_path / "set.relations")
    assert code == 0 and "ATE" not in output
    says(output, "relations", "Kümmerle", "1 relation, 0 missing")
    tree = json.loads(call("evaluate", truth, truth, "--relations", tmp_path / "set.relations", "--json")[1])
    assert tree["relations"]["translation_m"]["mean"] == pytest.approx(0.05, abs=1e-9)
    assert tree["relations"]["rotation_rad"]["mean"] < 1e-9 and "ate" in tree


def test_evaluate_agrees_with_the_metrics_of_the_run(call, tmp_path, office):
    call("run", office, "--out", tmp_path / "a", "--rerun", "off")
    truth = office.with_suffix(".tum")
    for name, key in (("trajectory.tum", "optimized"), ("odometry.tum", "odometry")):
        tree = json.loads(call("evaluate", tmp_path / "a" / name, truth, "--json")[1])
        said = metrics(tmp_path / "a")["ground_truth"][key]
        assert tree["ate"]["translation_m"]["rmse"] == pytest.approx(said["ate_rmse_m"], abs=1e-6)


def test_config_show_lists_every_key_with_unit_range_and_description_and_marks_changes(call):
    code, output, errors = call("config", "show", "--lidar", "2d", "--log.every", "7")
    assert (code, errors) == (0, "")
    says(output, "# preset lidar2d of 2D logs, log.every 7; * differs")
    rows = output.splitlines()[1:]
    lines = {line[2:].split()[0]: line for line in rows if not line.startswith(6 * " ")}
    defaults = flatten(configured(3))
    values = flatten(configured(2, {"log.every": 7}))
    assert list(lines) == list(values)
    assert {key for key, line in lines.items() if line.startswith("*")} == {
        key for key in values if values[key] != defaults[key]
    }
    assert lines["matching.max_distance_m"].split() == [
        "*",
        "matching.max_distance_m",
        "0.5",
        "m",
        "number",
        ">",
        "0",
    ]
    said = " ".join(rows[rows.index(lines["matching.max_distance_m"]) + 1].split())
    assert said == "largest distance of a correspondence; it shrinks with the voxels"


def test_config_show_as_json_has_value_unit_range_default_and_description(call, tmp_path):
    (tmp_path / "mine.toml").write_text("[matching]\nmax_distance_m = 0.3\n")
    rows = json.loads(call("config", "show", "--json", "--config", tmp_path / "mine.toml")[1])
    row = next(row for row in rows if row["key"] == "matching.max_distance_m")
    assert row == {
        "key": "matching.max_distance_m", "value": 0.3, "unit": "m", "range": "number > 0", "default": 2.0,
        "description": "largest distance of a correspondence; it shrinks with the voxels",
    }  # fmt: skip
    assert next(row for row in rows if row["key"] == "log.end_s")["value"] is None


@pytest.mark.parametrize("dimension", [2, 3])
def test_what_config_dump_prints_can_be_given_back(call, tmp_path, dimension):
    _, output, _ = call("config", "dump", "--lidar", f"{dimension}d", "--matching.matcher", "svd")
    expected = configured(dimension, {"matching.matcher": "svd"})
    assert flatten_toml(output) == flatten(expected)
    (tmp_path / "mine.toml").write_text(output)
    assert call("config", "dump", "--config", tmp_path / "mine.toml")[1] == output


def test_sequence_list_knows_every_file_of_the_catalog(call):
    known = sorted(path.stem for path in (ROOT / "sequences").glob("*.toml"))
    code, output, errors = call("sequence", "list")
    assert (code, errors) == (0, "")
    assert [line.split()[0] for line in output.splitlines()] == known
    tree = json.loads(call("sequence", "list", "--json")[1])
    assert list(tree) == known and tree["demo-office"]["source"]["world"] == "office"


def test_sequence_get_does_not_make_again_what_is_there(call, tmp_path):
    (tmp_path / "demo-office.mcap").write_bytes(b"there")
    code, output, errors = call("sequence", "get", "demo-office", "--out", tmp_path, "--json")
    assert (code, errors) == (0, "")
    assert json.loads(output) == {"name": "demo-office", "path": str(tmp_path / "demo-office.mcap")}
    assert (tmp_path / "demo-office.mcap").read_bytes() == b"there"


def test_simulate_writes_a_log_and_its_truth_once(call, refused, tmp_path):
    words = ["simulate", "office", tmp_path / "x.mcap", "--duration", "1", "--seed", "5"]
    code, output, errors = call(*words)
    assert (code, errors) == (0, "")
    says(output, tmp_path / "x.mcap", "10 scans", tmp_path / "x.tum")
    assert len(np.loadtxt(tmp_path / "x.tum")) == 10
    first = (tmp_path / "x.mcap").read_bytes()
    says(refused(*words), tmp_path / "x", "exists", "--force")
    assert call(*words, "--force")[0] == 0
    assert (tmp_path / "x.mcap").read_bytes() == first


def test_simulate_takes_sensor_noise_and_dropout(call, tmp_path):
    words = ["--duration", "0.2", "--sensor", "vlp-16", "--dropout", "0.9"]
    assert call("simulate", "town", tmp_path / "x.mcap", *words)[0] == 0
    said = json.loads(call("info", tmp_path / "x.mcap", "--json")[1])
    assert (said["dimension"], said["scans"]) == (3, 2)
    assert (tmp_path / "x.mcap").stat().st_size < 200_000


# pose graphs


@pytest.fixture
def ring(tmp_path):
    """A square of four poses and one false edge across it, as g2o."""
    path = tmp_path / "ring.g2o"
    lines = [f"EDGE_SE2 {i} {(i + 1) % 4} 1 0 {math.pi / 2} 100 0 0 100 0 1000" for i in range(4)]
    path.write_text("\n".join([*lines, "EDGE_SE2 0 2 1 1.01 3.14 100 0 0 100 0 1000", "PARAMS 7"]) + "\n")
    return path


def test_optimize_prints_what_it_did_and_writes_the_graph(call, tmp_path, ring):
    code, output, errors = call("optimize", ring, "--out", tmp_path / "done.g2o")
    assert (code, errors) == (0, "")
    says(output, "2D, 4 poses, 5 edges", "1 line PARAMS", "odometry, as the file has no vertices")
    says(output, "chi2", "iterations", "below the tolerance", "certificate    globally optimal to rounding")
    written = (tmp_path / "done.g2o").read_text()
    assert written.count("VERTEX_SE2") == 4 and written.count("EDGE_SE2") == 5 and written.endswith("PARAMS 7\n")
    again = json.loads(call("optimize", tmp_path / "done.g2o", "--json")[1])
    assert again["chi2_before"] == pytest.approx(again["chi2_after"], rel=1e-9)
    assert again["certificate"]["certified"] and again["certificate"]["relative_gap"] < 1e-6
    assert again["initialization"] == "given" and again["kept_lines"] == {"PARAMS": 1}


def test_optimize_rejects_a_false_edge_when_told_to_be_suspicious(call, tmp_path, ring):
    ring.write_text(ring.read_text() + "EDGE_SE2 1 3 9 9 1 100 0 0 100 0 1000\n")
    trusting = json.loads(call("optimize", ring, "--json")[1])
    assert trusting["robust_edges"] == 0 and trusting["rejected"] == [] and trusting["chi2_after"] > 1000.0
    code, output, _ = call("optimize", ring, "--robust", "truncated")
    assert code == 0
    says(output, "rejected       1 of 3 loop edges")
    tree = json.loads(call("optimize", ring, "--graph.robust", "truncated", "--json")[1])
    assert tree["rejected"] == [[1, 3]] and tree["certificate"]["chi2"] < 1.0
    assert tree["chi2_after"] == pytest.approx(tree["certificate"]["chi2"]) and tree["degrees_of_freedom"] == 6
    before = trusting["chi2_before"]
    says(
        output,
        f"chi2           {before:.6g} before, over 9 degrees of freedom; ",
        " after, over 6 degrees of freedom",
    )
    assert tree["chi2_before"] == pytest.approx(before) and tree["degrees_of_freedom_before"] == 9
    assert tree["warnings"] == [] and "warning" not in output


def test_the_picture_names_the_fit_of_the_edges_in_force_at_either_time(call, monkeypatch, tmp_path, ring):
    ring.write_text(ring.read_text() + "EDGE_SE2 1 3 9 9 1 100 0 0 100 0 1000\n")
    titles = []
    monkeypatch.setattr("matplotlib.axes.Axes.set_title", lambda _, text, **how: titles.append(text))
    assert call("optimize", ring, "--robust", "truncated", "--png", tmp_path / "a.png")[0] == 0
    before, after = titles
    assert "over 9 degrees of freedom" in before and "rejected" not in before
    assert "over 6 degrees of freedom, 1 edge rejected" in after


@pytest.mark.parametrize("robust", ["truncated", "huber"])
def test_an_answer_that_rests_on_a_minority_of_the_loop_edges_says_so_first(call, ring, robust):
    ring.write_text(ring.read_text() + "".join(f"EDGE_SE2 {i} 3 9 {i} 1 100 0 0 100 0 1000\n" for i in (0, 1, 1)))
    output = call("optimize", ring, "--robust", robust)[1]
    assert re.match(r"warning        \d of 5 loop edges are rejected or have a weight below ½", output)
    says(output, "not their selection", "certificate    globally optimal")


def test_optimize_writes_graphs_of_the_known_formats_alone(call, refused, tmp_path, ring):
    says(refused("optimize", ring, "--out", tmp_path / "zz.txt"), "zz.txt: name a file", ".g2o or .graph or .toro")
    for suffix in ("g2o", "graph", "toro"):
        assert call("optimize", ring, "--out", tmp_path / f"done.{suffix}")[0] == 0


@pytest.mark.parametrize("robust", ["truncated", "geman-mcclure", "tukey", "cauchy", "huber"])
def test_the_graph_of_a_robust_answer_holds_what_is_in_force_and_its_own_minimum(call, tmp_path, ring, robust):
    ring.write_text(ring.read_text() + "EDGE_SE2 1 3 9 9 1 100 0 0 100 0 1000\n")
    words = ["--robust", robust, "--graph.tolerance", "1e-12", "--out", tmp_path / "done.g2o", "--json"]
    tree = json.loads(call("optimize", ring, *words)[1])
    assert tree["rejected"] == [[1, 3]] and str(tmp_path / "done_rejected.g2o") in tree["written"]
    assert (tmp_path / "done.g2o").read_text().count("EDGE_SE2") == 5
    assert (tmp_path / "done_rejected.g2o").read_text().count("EDGE_SE2 1 3") == 1
    before = read_g2o(tmp_path / "done.g2o").graph.poses
    again = json.loads(call("optimize", tmp_path / "done.g2o", "--out", tmp_path / "again.g2o", "--json")[1])
    assert again["chi2_before"] == pytest.approx(tree["chi2_after"], rel=1e-9)
    assert np.abs(read_g2o(tmp_path / "again.g2o").graph.poses - before).max() < 1e-6


def test_the_rejected_edges_of_an_earlier_answer_do_not_stay_behind(call, refused, tmp_path, ring):
    stale = tmp_path / "done_rejected.g2o"
    stale.write_text("of an earlier answer")
    says(refused("optimize", ring, "--out", tmp_path / "done.g2o"), "done_rejected.g2o", "--force")
    assert call("optimize", ring, "--out", tmp_path / "done.g2o", "--force")[0] == 0
    assert not stale.exists()


def test_optimize_names_the_poses_that_are_free_before_it_certifies_anything(call, ring):
    lines = ring.read_text().splitlines()[:3]
    ring.write_text("\n".join([*lines, "EDGE_SE2 3 17 1 0 0 100 0 0 100 0 0"]) + "\n")
    code, output, errors = call("optimize", ring)
    assert (code, errors) == (0, "")
    says(output, "free           the edges leave 1 pose free: 17 (yaw)")
    says(output, "certificate    not certified: the edges leave 1 pose free: 17 (yaw)")
    tree = json.loads(call("optimize", ring, "--json")[1])
    assert (
        tree["free"] == [{"name": 17, "axes": ["yaw"], "followers": []}] and not tree["certificate"]["certified"]
    )
    ring.write_text("\n".join([*lines, "EDGE_SE2 3 17 1 0 0 1e-7 0 0 1e-7 0 1e-6"]) + "\n")
    says(call("optimize", ring)[1], "weakly joined  pose 17 by edges of less than a millionth")


def test_optimize_says_loudly_that_it_projects_indefinite_information(call, refused, ring):
    ring.write_text(ring.read_text().replace("0 2 1 1.01 3.14 100 0 0 100", "0 2 1 1.01 3.14 100 150 0 100"))
    code, output, errors = call("optimize", ring)
    assert code == 0
    says(
        errors, "warning: ", "1 of 5 edges have an indefinite information matrix", "nearest", "first 0-2 in line 5"
    )
    says(errors, "--indefinite refuse")
    says(output, "projected      1 of 5")
    code, output, errors = call("optimize", ring, "--json")
    assert json.loads(output)["projected"]["edges"] == 1 and "warning: " in errors
    says(refused("optimize", ring, "--indefinite", "refuse"), "ring.g2o:5: information matrix of edge 0-2")


def test_a_chain_has_no_loops_to_check(call, ring):
    lines = ring.read_text().splitlines(keepends=True)
    ring.write_text("".join(line for line in lines if " 3 0 " not in line and " 0 2 " not in line))
    code, output, _ = call("optimize", ring)
    assert code == 0
    says(output, "chi2           no loops to check")


def test_loops_that_leave_no_degrees_of_freedom_have_a_chi2_all_the_same(call, ring):
    lines = [f"EDGE_SE2 {i} {i + 1} 1 0 0 100 0 0 100 0 1000" for i in range(2)]
    ring.write_text("\n".join([*lines, "EDGE_SE2 0 2 3 0 0 100 0 0 0 0 0"]) + "\n")
    chi2 = "chi2           100 before, over 1 degree of freedom; 33.333333 after, over 1 degree of freedom\n"
    says(call("optimize", ring)[1], chi2)
    lines[0] = "EDGE_SE2 0 1 1 0 0 100 0 0 100 0 0"
    ring.write_text("\n".join([*lines, "EDGE_SE2 0 2 3 0 0 100 0 0 0 0 0"]) + "\n")
    code, output, _ = call("optimize", ring)
    says(output, " after, over 0 degrees of freedom")
    assert code == 0 and "no loops" not in output


def test_optimize_writes_covariances_a_picture_and_a_recording(call, tmp_path, ring):
    png, rrd = tmp_path / "ring.png", tmp_path / "ring.rrd"
    words = ["--out", tmp_path / "done.graph", "--marginals", "0,2", "--png", png, "--recording", rrd]
    code, output, errors = call("optimize", ring, *words)
    assert (code, errors) == (0, "")
    says(output, png, rrd, tmp_path / "done.marginals.csv")
    rows = [line.split(",") for line in (tmp_path / "done.marginals.csv").read_text().splitlines()]
    assert rows[0] == ["id", "x_x", "x_y", "x_yaw", "y_y", "y_yaw", "yaw_yaw"]
    assert [row[0] for row in rows[1:]] == ["0", "2"]
    assert float(rows[1][1]) == 0.0 and 0.0 < float(rows[2][1]) < 0.02
    assert png.read_bytes().startswith(b"\x89PNG") and rrd.read_bytes().startswith(b"RRF")
    assert (tmp_path / "done.graph").read_text().startswith("VERTEX2 0 ")


@pytest.mark.parametrize(
    "name", ["done.g2o", "done.graph", "done_rejected.g2o", "done.marginals.csv", "ring.png", "a.rrd"]
)
def test_a_full_disk_leaves_the_files_of_an_earlier_answer_as_they_are(call, monkeypatch, tmp_path, ring, name):
    ring.write_text(ring.read_text() + "EDGE_SE2 1 3 9 9 1 100 0 0 100 0 1000\n")
    out = tmp_path / ("done.graph" if name == "done.graph" else "done.g2o")
    words = ["--out", out, "--robust", "truncated", "--marginals", "all", "--png", tmp_path / "ring.png"]
    words += ["--recording", tmp_path / "a.rrd"]
    assert call("optimize", ring, *words)[0] == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    write_bytes = Path.write_bytes

    def fill_up(path, data):
        if not path.name.startswith(name):
            return write_bytes(path, data)
        write_bytes(path, data[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_up)
    code, output, errors = call("optimize", ring, *words, "--force")
    assert (code, output, errors) == (1, "", f"error: {tmp_path / name}: {FULL}\n")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_an_answer_that_did_not_converge_is_written_and_says_so(call, tmp_path, ring):
    words = ["optimize", ring, "--graph.max_iterations", "1", "--out", tmp_path / "done.g2o", "--force"]
    code, output, errors = call(*words)
    assert (code, errors) == (1, "") and (tmp_path / "done.g2o").exists()
    says(output, "iterations     1 in", "; DID NOT CONVERGE: 1 iteration reached")
    code, output, _ = call(*words, "--json")
    assert code == 1 and json.loads(output)["converged"] is False


@pytest.mark.parametrize(("optimizer", "initialize"), [("dogleg", "chordal"), ("newton", "spanning-tree")])
def test_optimize_takes_an_optimizer_and_a_first_guess(call, ring, optimizer, initialize):
    words = ["--optimizer", optimizer, "--initialize", initialize, "--graph.max_iterations", "99", "--json"]
    tree = json.loads(call("optimize", ring, *words)[1])
    assert tree["initialization"] == initialize and tree["converged"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--marginals", "all"], "give --out FILE"),
        (["--marginals", "9", "--out", "{}/a.g2o"], "--marginals 9: no such vertex; the ids go from 0 to 3"),
        (["--marginals", "one", "--out", "{}/a.g2o"], "take all, or vertex ids"),
        (["--png", "{}/a.jpg"], "name a file that ends in .png"),
        (["--recording", "{}/a.png"], "name a file that ends in .rrd"),
        (["--out", "{}/none/a.g2o"], "there is no folder"),
        (["--out", "{}/ring.g2o"], "exists; choose another name, or --force"),
        (["--out", "{}"], "is a folder"),
        (["--optimizer", "magic"], "graph.optimizer is 'magic'; it must be one of"),
        (["--loops.drift", "1"], "--loops.drift has no meaning for optimize"),
    ],
)
def test_optimize_refuses_what_it_cannot_do_before_it_begins(refused, tmp_path, ring, words, said):
    says(refused("optimize", ring, *(word.format(tmp_path) for word in words)), said)


def test_optimize_refuses_bad_graphs_in_one_line(refused, tmp_path, ring):
    says(refused("optimize", tmp_path / "none.g2o"), "none.g2o: cannot be read as g2o")
    ring.write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 2 3 1 0 0 1 0 0 1 0 1\n")
    says(refused("optimize", ring), "2 of 4 poses are not joined to a fixed one")
    ring.write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 x\n")
    says(refused("optimize", ring), "ring.g2o:1: EDGE_SE2: could not convert")
    ring.write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 a b 1 0 0 1 0 0 1 0 1\n")
    says(refused("optimize", ring), "ring.g2o:2: EDGE_SE2: vertex id 'a' is not a whole number; write 0, 1")
    ring.write_text("FIX 99999999999999999999\n")
    says(
        refused("optimize", ring),
        "ring.g2o:1: FIX: vertex id '99999999999999999999' is too large; the limit is 9223",
    )


# as a program


def program(*words):
    return subprocess.run(
        [sys.executable, "-m", "scanchain", *map(str, words)], cwd=ROOT, capture_output=True, text=True, timeout=60
    )


def test_it_runs_as_a_module_with_its_exit_codes(tmp_path):
    good = program("config", "show", "--json")
    assert (good.returncode, good.stderr) == (0, "") and json.loads(good.stdout)
    bad = program("info", tmp_path / "absent.mcap")
    assert (bad.returncode, bad.stdout) == (2, "")
    assert re.fullmatch(r"error: .*absent\.mcap: no such file; check the path\n", bad.stderr)


def test_a_reader_that_goes_away_is_no_error_to_talk_about():
    command = f"{sys.executable} -m scanchain config show --json | head -c 1"
    answer = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (answer.stdout, answer.stderr) == ("[", "")


def test_help_does_not_load_the_heavy_packages():
    script = """
import sys
from scanchain.__main__ import main
main(["run", "--help"])
print([name for name in ("numba", "scipy", "pyarrow", "rerun") if name in sys.modules], file=sys.stderr)
"""
    answer = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert answer.stderr == "[]\n"


def test_info_and_convert_take_the_short_option_that_the_error_names(call, tmp_path):
    said = [scan_said(STAMP_NS, laser_scan(STAMP_NS, [1.0] * 9), topic) for topic in ("/front", "/rear")]
    path = write(tmp_path / "two.mcap", said)
    says(call("info", path)[1], "choose one with --topic")
    code, output, _ = call("info", path, "--topic", "/rear")
    assert code == 0 and "lidar     /rear: 2D, 1 scan" in output and "problem" not in output
    code, output, _ = call("convert", path, tmp_path / "rear.mcap", "--topic", "/rear")
    assert code == 0 and "/rear" in output and "/front" not in output
