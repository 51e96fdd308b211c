"""The command line: what it prints where, its exit codes, and one line for everything that can go wrong."""

import errno
import io
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from unittest.mock import Mock

import click
import numpy as np
import pytest
from mcap.reader import make_reader

from scanchain.__main__ import scanchain
from scanchain.commands.terminal import Terminal
from scanchain.data import Scan
from scanchain.settings import flatten
from tests.commands.conftest import FULL
from tests.support.messages import says
from tests.support.naive_logs import SECOND, STAMP_NS, laser_scan, odometry, odometry_said, scan_said, write
from tests.support.scenes import ROOT, configured


def commands(group=scanchain, words=()):
    """Every command and group with the words that call it."""
    yield words, group
    if isinstance(group, click.Group):
        for name, command in group.commands.items():
            yield from commands(command, (*words, name))


# help


@pytest.mark.parametrize(("words", "command"), [*commands()], ids=str)
def test_every_command_has_help_with_examples_of_itself_that_parse(call, words, command):
    code, output, errors = call(*words, "-h" if len(words) == 1 else "--help")
    assert (code, errors) == (0, "")
    says(output, "Usage: scanchain", "Examples:", f"\n    {' '.join(('scanchain', *words))} ")
    if isinstance(command, click.Group):
        code, output, _ = call(*words)
        assert code == 2 and "Examples:" in output
        return
    for line in command.help.partition("Examples:")[2].splitlines():
        example = shlex.split(line.partition(" > ")[0])[1:]
        if example[: len(words)] == list(words):
            command.make_context(words[-1], example[len(words) :])


def test_the_version_is_that_of_the_package(call):
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert call("--version") == (0, f"scanchain {version}\n", "")


# errors


class FullDisk(io.BytesIO):
    """A file on a disk that takes so many bytes."""

    room = 60_000

    def write(self, data):
        if self.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


def test_a_full_disk_is_one_line_with_what_to_do_and_nothing_is_left(call, monkeypatch, tmp_path):
    opened = Path.open

    def open_there(path, *words, **options):
        file = opened(path, *words, **options)
        return FullDisk() if path.suffix == ".partial" else file

    monkeypatch.setattr(Path, "open", open_there)
    code, _, errors = call("simulate", "office", tmp_path / "a.mcap", "--duration", "3")
    assert (code, errors) == (1, f"error: {tmp_path / 'a.mcap'}: {FULL}\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RuntimeError("two\nlines"), "error: RuntimeError: two lines; --debug shows the traceback"),
        (KeyboardInterrupt(), "error: interrupted"),
    ],
)
def test_an_error_of_ours_and_ctrl_c_are_one_line_with_exit_code_1_too(call, monkeypatch, error, said):
    monkeypatch.setattr("scanchain.logs.info.describe", Mock(side_effect=error))
    code, output, errors = call("info", "a.mcap")
    assert (code, output, errors.strip()) == (1, "", said)
    if isinstance(error, RuntimeError):
        for words in (("info", "a.mcap", "--debug"), ("--debug", "info", "a.mcap")):
            code, _, errors = call(*words)
            assert code == 1 and errors.startswith("Traceback (most recent call last):")
            assert errors.endswith("\nerror: RuntimeError: two lines\n")


def test_an_interruption_while_the_imports_run_is_one_line_too():
    stopped_at = (
        "import sys; from scanchain.entry import main\nclass Stop:\n def find_spec(*_): raise KeyboardInterrupt\n"
    )
    command = [sys.executable, "-c", f"{stopped_at}sys.meta_path.insert(0, Stop()); sys.exit(main())"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "error: interrupted\n")
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"scanchain": "scanchain.entry:main"}


# info, config, sequence, simulate


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
    assert " ".join(lines["matching.max_distance_m"].split()) == "* matching.max_distance_m 0.5 m number > 0"
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


def test_sequence_list_knows_every_file_of_the_catalog(call):
    known = sorted(path.stem for path in (ROOT / "sequences").glob("*.toml"))
    code, output, errors = call("sequence", "list")
    assert (code, errors) == (0, "")
    assert [line.split()[0] for line in output.splitlines()] == known
    tree = json.loads(call("sequence", "list", "--json")[1])
    assert list(tree) == known and tree["demo-office"]["source"]["world"] == "office"


def test_simulate_writes_a_log_and_its_truth_once_with_the_sensor_named(call, refused, tmp_path):
    words = ["simulate", "office", tmp_path / "x.mcap", "--duration", "1", "--seed", "5"]
    code, output, errors = call(*words)
    assert (code, errors) == (0, "")
    says(output, tmp_path / "x.mcap", "10 scans", tmp_path / "x.tum")
    assert len(np.loadtxt(tmp_path / "x.tum")) == 10
    first = (tmp_path / "x.mcap").read_bytes()
    says(refused(*words), tmp_path / "x", "exists", "--force")
    assert call(*words, "--force")[0] == 0
    assert (tmp_path / "x.mcap").read_bytes() == first
    words = ["--duration", "0.2", "--sensor", "vlp-16", "--dropout", "0.9"]
    assert call("simulate", "town", tmp_path / "y.mcap", *words)[0] == 0
    said = json.loads(call("info", tmp_path / "y.mcap", "--json")[1])
    assert (said["dimension"], said["scans"]) == (3, 2)
    assert (tmp_path / "y.mcap").stat().st_size < 200_000


# as a program


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


def test_the_progress_line_tells_only_what_is_known_and_counts_from_where_a_run_is_resumed(monkeypatch, capfd):
    clock = iter([100.0, 130.0, 160.0, 190.0, 190.0, 190.0, 200.0])
    monkeypatch.setattr("scanchain.commands.terminal.monotonic", lambda: next(clock))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with Terminal("logs") as terminal:
        for done in range(1, 5):
            terminal.count(done, 4)
    lines = [line.split("━ ")[-1].strip() for line in capfd.readouterr().err.split("\r\033[K")[1:]]
    assert lines == ["1/4 logs", "2/4 logs  0.033 logs/s  60.0 s left", "3/4 logs  0.033 logs/s  30.0 s left",
                     "4/4 logs  0.033 logs/s"]  # fmt: skip
    scans = [Scan(index, 0, 0, np.ones((1, 2)), np.empty(0), 0, None) for index in range(369, 372)]
    with Terminal("scans") as terminal:
        assert list(terminal.track(iter(scans), 7005)) == scans
    told = capfd.readouterr().err
    assert " 370/7,005 scans" in told and " 372/7,005 scans  0.2 scans/s  9.2 h left" in told
