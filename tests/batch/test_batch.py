"""Many logs: each is isolated, each is a row, and what is done stays done."""

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import unquote

import numpy as np
import pyarrow.parquet as pq
import pytest

from scanchain.__main__ import main
from scanchain.batch import batch, task
from scanchain.batch.batch import collect
from scanchain.errors import InputError
from scanchain.files import Address
from scanchain.logs.writer import LogWriter, pack_laser_scan, pack_odometry, place_of
from scanchain.processes import Ending, KilledFor, resident_mib
from scanchain_viz.report.batch import names_of
from tests.support import made
from tests.support.browser import look
from tests.support.killing import processes_about, wait_until
from tests.support.scenes import ROOT
from tests.support.web_server import serving

POISON = """
import sys
words = " ".join(sys.argv)
if "-m" in sys.orig_argv and "crashing" in words:
    import ctypes
    ctypes.string_at(0)
if "-m" in sys.orig_argv and "hungry" in words:
    import time
    eaten = []
    for _ in range(64):
        eaten.append(b"x" * (64 << 20))
        time.sleep(0.05)
"""


@pytest.fixture(scope="module")
def drawers(tmp_path_factory):
    """Six logs of two seconds each, no two alike; two of them are poison."""
    folder = tmp_path_factory.mktemp("logs")
    names = [f"log_{k:02}" for k in range(4)] + ["crashing", "hungry"]
    for seed, name in enumerate(names):
        shutil.copy(made.log("office", seconds=2, seed=seed), folder / f"{name}.mcap")
    return folder


@pytest.fixture
def poisoned(tmp_path, monkeypatch):
    """Interpreters in which two of the logs crash the process, or eat its memory."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(POISON)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path / 'site'}:{ROOT}", prepend=os.pathsep)


@pytest.fixture
def in_this_process(monkeypatch):
    """Logs are run one after the other in this process, not each in one of its own."""

    def run_within(limits, module, words, environment, *, output, **_):
        with output.open("w") as file, redirect_stdout(file), redirect_stderr(file):
            code = main(words[1:])
        return Ending(code, KilledFor.NOTHING, 100.0, 1.0)

    monkeypatch.setattr(task, "run_within", run_within)
    monkeypatch.setattr(batch, "_local", lambda workers, tasks: map(task.attempt, tasks))


def table(folder):
    return {row["log"].rsplit("/", 1)[1]: row for row in pq.read_table(folder / "batch.parquet").to_pylist()}


def made_at(folder):
    """When each run directory came to be."""
    return {path.parent: path.stat().st_mtime_ns for path in folder.glob("*/run.json")}


@pytest.mark.slow
def test_of_4_logs_two_are_poison_and_2_have_results_and_a_second_call_runs_only_the_rest(
    drawers, poisoned, tmp_path, capfd
):
    out = tmp_path / "out"
    logs = [str(drawers / f"{name}.mcap") for name in ("log_00", "log_01", "crashing", "hungry")]
    words = ["batch", *logs, "--out", str(out), "--memory-limit", "1.5", "--workers", "2"]
    assert main(words) == 1
    output, errors = capfd.readouterr()
    rows, first = table(out), made_at(out)
    done = {name: row for name, row in rows.items() if row["state"] == "done"}
    assert len(rows) == 4 and len(done) == len(first) == 2
    assert (rows["crashing.mcap"]["state"], rows["crashing.mcap"]["reason"]) == ("crashed", "ended by SIGSEGV")
    assert (rows["crashing.mcap"]["tries"], rows["hungry.mcap"]["tries"]) == (2, 1)
    assert rows["hungry.mcap"]["state"] == "out of memory"
    assert rows["hungry.mcap"]["reason"] == "took more than --memory-limit (1.5 GiB)"
    assert rows["hungry.mcap"]["scans"] is None
    for row in done.values():
        metrics = json.loads((out / row["run"] / "metrics.json").read_text())
        assert row["scans"] == metrics["scans"] == 20 and row["ate_rmse_m"] < 0.1
        assert (out / row["run"] / "recording.rrd").exists()  # as of scanchain run
        assert row["ate_rmse_m"] == metrics["ground_truth"]["optimized"]["ate_rmse_m"]
    assert "4: 2 done, 1 crashed, 1 out of memory" in output
    assert errors == f"error: 2 of 4 logs have no result; {out}/summary.txt has the reason\n"

    assert main(words) == 1  # only the two are tried again
    assert made_at(out) == first and "2 results from before" in capfd.readouterr()[0]


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(
    ("code", "left", "reason"),
    [
        (0, {}, "ended by exit code 0: bye"),
        (0, {"run.json": "", "metrics.json": ""}, "ended by exit code 0: bye"),
        (0, {"run.json": "{}", "metrics.json": "{}"}, "ended by exit code 0: bye"),
        (0, {"metrics.json": "[1, 2"}, "ended by exit code 0: bye"),
        (-15, {}, "ended by SIGTERM: bye"),
        (-40, {}, "ended by signal 40: bye"),  # which has no name
        (1, {"metrics.json": "{"}, "ended by exit code 1: bye"),
    ],
)
def test_a_process_that_ends_without_a_result_is_a_row_that_says_so_and_the_batch_goes_on(
    drawers, tmp_path, monkeypatch, code, left, reason
):
    def run_within(limits, module, words, environment, *, output, **_):
        output.write_text("bye\n")
        folder = Path(words[words.index("--out") + 1])
        for name, text in left.items():
            folder.mkdir(exist_ok=True)
            (folder / name).write_text(text)
        return Ending(code, KilledFor.NOTHING, 100.0, 1.0)

    monkeypatch.setattr(task, "run_within", run_within)
    out, logs = tmp_path / "out", [str(drawers / f"log_{k:02}.mcap") for k in range(2)]
    assert main(["batch", *logs, "--out", str(out)]) == 1
    rows = table(out)
    assert [(row["state"], row["reason"], row["tries"]) for row in rows.values()] == [("crashed", reason, 2)] * 2


@pytest.mark.usefixtures("in_this_process")
def test_what_is_done_is_done_until_the_file_or_the_configuration_changes(drawers, tmp_path, capfd):
    log, out = tmp_path / "log.mcap", tmp_path / "out"
    log.write_bytes((drawers / "log_00.mcap").read_bytes())
    words = ["batch", str(log), "--out", str(out)]
    assert main(words) == 0
    first = made_at(out)
    (row,) = table(out).values()
    assert row["sha256"] == hashlib.sha256(log.read_bytes()).hexdigest()
    assert main(["batch", f"{log.parent}/../{log.parent.name}/log.mcap", "--out", str(out)]) == 0
    assert made_at(out) == first and "1 result from before" in capfd.readouterr()[0].splitlines()[-1]
    (run,) = first
    (run / "metrics.json").unlink()  # a result that was thrown away is missing
    assert main(words) == 0 and (run / "metrics.json").exists()
    assert main([*words, "--matching.matcher", "svd"]) == 0
    assert len(made_at(out)) == 2
    log.write_bytes((drawers / "log_01.mcap").read_bytes())
    assert main(words) == 0
    assert len(made_at(out)) == 3 and "0 results from before" in capfd.readouterr()[0].splitlines()[-1]


def test_a_log_that_takes_too_long_is_a_row_with_the_reason(drawers, tmp_path):
    words = ["batch", str(drawers / "log_03.mcap"), "--out", str(tmp_path / "out"), "--time-limit", "0.2"]
    assert main(words) == 1
    assert table(tmp_path / "out")["log_03.mcap"]["reason"] == "took longer than --time-limit (0.2 s)"


@pytest.mark.usefixtures("in_this_process")
def test_logs_that_are_damaged_or_absent_are_rows_with_a_reason_each(drawers, tmp_path):
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "empty.mcap").touch()
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(b"no log at all")
    says = {"folder.mcap": "is a folder", "empty.mcap": "", "a.mcap": "is not a recognized log"}
    says |= {"b.mcap": "is not a recognized log", "absent.mcap": "no such file"}
    words = ["batch", *(str(tmp_path / name) for name in says), str(drawers / "log_03.mcap")]
    assert main([*words, "--out", str(tmp_path / "out")]) == 1
    rows = table(tmp_path / "out")
    assert rows.pop("log_03.mcap")["state"] == "done"
    assert {row["state"] for row in rows.values()} == {"failed"}
    for name, words in says.items():
        assert words in rows[name]["reason"] and (name == "absent.mcap" or name in rows[name]["reason"])
    assert "is a folder" not in rows["empty.mcap"]["reason"]


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes there")
@pytest.mark.usefixtures("in_this_process")
def test_a_name_that_is_not_utf_8_is_a_failed_row_and_one_line_of_run(drawers, tmp_path, capfd):
    bad, folder = (tmp_path / os.fsdecode(name) for name in (b"bad\xff.mcap", b"parts\xff"))
    folder.mkdir()
    for log in (bad, folder / "part.mcap"):
        shutil.copy(drawers / "log_00.mcap", log)
    for log in (bad, folder):
        assert main(["run", str(log), "--out", str(tmp_path / "run"), "--rerun", "off"]) == 2
        shown = str(log).encode(errors="surrogateescape").decode(errors="backslashreplace")
        errors = capfd.readouterr()[1]
        assert errors.startswith(f"error: {shown}") and errors.endswith(": the name is not UTF-8; rename it\n")
    out = tmp_path / "out"
    assert main(["batch", str(bad), str(folder), str(drawers / "log_01.mcap"), "--out", str(out)]) == 1
    rows = table(out)
    assert [row["state"] for row in rows.values()] == ["failed", "failed", "done"]
    assert rows["bad\\xff.mcap"]["reason"] == f"{tmp_path}/bad\\xff.mcap: the name is not UTF-8; rename it"
    assert "bad\\xff.mcap" in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.usefixtures("in_this_process")
def test_a_damaged_log_is_done_with_its_warnings_counted_and_told(drawers, tmp_path, capfd):
    cut, out = tmp_path / "cut.mcap", tmp_path / "out"
    cut.write_bytes((drawers / "log_00.mcap").read_bytes()[:-20])
    assert main(["batch", str(cut), str(drawers / "log_01.mcap"), "--out", str(out)]) == 0
    rows, (output, _) = table(out), capfd.readouterr()
    told = json.loads((out / rows["cut.mcap"]["run"] / "metrics.json").read_text())["warnings"]
    assert rows["cut.mcap"]["warnings"] == len(told) > 0 == rows["log_01.mcap"]["warnings"]
    first = told[0].replace(f"{cut}: ", "")
    assert f"warned         {cut}: {first}" in output and "in 1 log" in output and first != told[0]
    assert f'<td class="bad">{len(told)}</td>' in (out / "report.html").read_text(encoding="utf-8")


def test_the_time_of_logs_counts_from_the_start_of_a_batch(drawers, tmp_path):
    progress, job = Mock(), batch.Batch((drawers / "log_00.mcap",), tmp_path / "out")
    batch.run_batch(job, progress, lambda tasks: iter(()))
    progress.count.assert_called_once_with(0, 1)


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
def test_ctrl_c_kills_what_runs_and_the_table_says_what_was_not_run(drawers, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "scanchain", "batch", f"{drawers}/log_*.mcap", "--out", str(out)]
    child = subprocess.Popen(
        [*command, "--workers", "1"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    while not list(out.glob("rows/*.json")):
        time.sleep(0.05)
    child.send_signal(signal.SIGINT)
    output, errors = child.communicate(timeout=20)
    assert child.returncode == 1 and b"logs have no result" in errors and b"not run" in output
    states = [row["state"] for row in table(out).values()]
    assert len(states) == 4 and 1 <= states.count("done") < 4
    assert states.count("done") + states.count("not run") == 4


def test_what_a_killed_batch_started_ends_with_it(tmp_path):
    log = made.log("office", tmp_path, seconds=120)
    command = [sys.executable, "-m", "scanchain", "batch", str(log), "--out", str(tmp_path / "out")]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_until(lambda: list((tmp_path / "out").glob("*.partial-*/points.store")))
    assert processes_about(tmp_path)
    child.kill()
    child.wait()
    wait_until(lambda: not processes_about(tmp_path))


def test_logs_are_named_by_path_pattern_and_list_each_once(tmp_path):
    for name in ("a", "b", "c", "d"):
        (tmp_path / f"{name}.mcap").touch()
    (tmp_path / "list.txt").write_text("c.mcap  # the third\n\n# nothing\nd*.mcap\na.mcap\n")
    found = collect([tmp_path / "[ab].mcap"], [tmp_path / "list.txt"])
    assert [path.name for path in found] == ["a.mcap", "b.mcap", "c.mcap", "d.mcap"]
    with pytest.raises(InputError, match=r"x\*\.mcap: matches nothing"):
        collect([tmp_path / "x*.mcap"], [])
    with pytest.raises(InputError, match="no log is named"):
        collect([], [])
    with pytest.raises(InputError, match=r"none\.txt: cannot be read"):
        collect([], [tmp_path / "none.txt"])


def test_a_folder_is_the_logs_in_it_unless_they_are_the_parts_of_one(tmp_path):
    whole, several = made.log("office", seconds=4), tmp_path / "several"
    for place in range(2):
        part = tmp_path / "part" / f"part_{place}.mcap"
        part.parent.mkdir(exist_ok=True)
        cut = ["--start", str(2 * place), "--end", str(2 * place + 1.95)]
        assert main(["convert", str(whole), str(part), *cut]) == 0
    (several / "clouds").mkdir(parents=True)
    (several / "clouds" / "1.pcd").touch()
    (several / "truth.txt").touch()
    shutil.copytree(tmp_path / "part", several / "part")
    for seed in (1, 2):  # of the same time, by the clock of the simulation
        shutil.copy(made.log("office", seconds=2, seed=seed), several / f"{seed}.mcap")
    assert collect([tmp_path / "part"], []) == (tmp_path / "part",)
    assert {path.name for path in collect([several], [])} == {"1.mcap", "2.mcap", "clouds", "part"}
    (several / "clouds" / "1.pcd").unlink()
    assert [path.name for path in collect([several], [])] == ["part", "1.mcap", "2.mcap"]
    assert collect([several], [], "my:Format") == (several,)


def test_logs_of_the_same_name_are_told_apart_by_their_folders():
    logs = ["/a/x/log.bag", "/b/x/log.bag", "/c/other.bag", "https://host/a/one.mcap"]
    assert list(names_of(logs).values()) == ["a/x/log.bag", "b/x/log.bag", "other.bag", "one.mcap"]


@pytest.mark.parametrize(
    ("log", "out", "words", "says"),
    [
        ("logs/a.mcap", "logs", [], r"error: {out}: is not empty and not a batch.*; choose another --out"),
        ("logs/folder", "logs/folder/out", [], "error: {out}: lies in the log.*; choose another --out"),
        ("logs/a.mcap", "run/deep/out", [], "error: {out}: lies in the run directory.*; choose another --out"),
        ("logs/a.mcap", "new", ["--matching.reach", "2"], "error: .*--matching.reach.*"),
    ],
)
def test_a_batch_is_not_written_among_logs_nor_into_a_run_nor_with_a_wrong_key(
    tmp_path, capsys, log, out, words, says
):
    (tmp_path / "logs" / "folder").mkdir(parents=True)
    (tmp_path / "logs" / "folder" / "0.pcd").write_bytes(b"x")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text('{"versions": {"scanchain": "1"}}')
    out = tmp_path / out
    assert main(["batch", str(tmp_path / log), "--out", str(out), *words]) == 2
    assert re.fullmatch(says.format(out=out) + "\n", capsys.readouterr().err)
    assert not (out / "rows").exists()


def stands_still(path, ranges_m, angles):
    """A log of two seconds of two lidars that stand still, and of their true pose."""
    random = np.random.default_rng(0)
    with LogWriter(path) as writer:
        for stamp_ns in range(0, 2_000_000_000, 100_000_000):
            pose = pack_odometry(stamp_ns, "world", "lidar", place_of((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
            writer.append("/ground_truth", "nav_msgs/msg/Odometry", pose, stamp_ns)
            first = stamp_ns, "lidar", angles[0], angles[1] - angles[0]
            measured_m = ranges_m + 1e-3 * random.standard_normal(len(ranges_m))
            scan = pack_laser_scan(*first, measured_m, range_min_m=0.1, range_max_m=20.0)
            for topic in ("/front", "/rear"):
                writer.append(topic, "sensor_msgs/msg/LaserScan", scan, stamp_ns)


@pytest.mark.usefixtures("in_this_process")
def test_the_report_shows_every_log_and_names_no_key_of_an_address(drawers, tmp_path, monkeypatch):
    pytest.importorskip("fsspec", reason="the extra remote is not installed")
    out = tmp_path / "out"
    bad = tmp_path / "<bad>.mcap"
    bad.write_bytes(b"no log at all")
    with serving({"/far.mcap?key=secret": (drawers / "log_02.mcap").read_bytes()}) as site:
        logs = [f"{site.url}/far.mcap?key=secret", str(drawers / "log_03.mcap"), str(bad)]
        words = ["batch", *logs, "--memory-limit", "2", "--out", str(out)]
        monkeypatch.setattr(sys, "argv", ["scanchain", *words])
        assert main(words) == 1
        assert table(out)["far.mcap"]["reason"] == table(out)["log_03.mcap"]["reason"] == ""
        first = made_at(out)
        assert main(words) == 1 and made_at(out) == first
        site.etag = '"two"'
        assert main(words) == 1 and len(made_at(out)) == len(first) + 1 == 3
    rows = table(out)
    assert rows["far.mcap"]["log"] == f"{site.url}/far.mcap" and rows["far.mcap"]["scans"] == 20
    page = (out / "report.html").read_text()
    assert "Batch of 3 logs" in page and "&lt;bad&gt;.mcap" in page and "<bad>" not in page
    assert page.count("<svg class=") == 2
    written = [file.read_bytes() for file in out.rglob("*") if file.is_file()]
    assert not any(b"secret" in content for content in written)


@pytest.fixture
def two_lidars(tmp_path):
    """Two logs of a long name with two lidars each; the first sees one wall alone, along which all is open."""
    logs = [tmp_path / f"2026-11-22_warehouse_north_aisle_{name}_second_attempt.mcap" for name in ("wall", "room")]
    angles = np.radians(np.arange(-90.0, 90.5, 0.5))
    wall = 3.0 / np.maximum(np.cos(angles), 1e-3)
    room = np.minimum(wall, 4.0 / np.maximum(np.abs(np.sin(angles)), 1e-3))
    for log, ranges_m in zip(logs, (wall, room), strict=True):
        stands_still(log, ranges_m, angles)
    return logs


@pytest.mark.usefixtures("in_this_process")
def test_logs_with_several_lidars_take_the_flags_of_run_and_one_that_is_not_sure_is_a_row_that_says_so(
    two_lidars, tmp_path, capfd
):
    out, bad = tmp_path / "out", tmp_path / "bad.mcap"
    bad.write_bytes(b"no log at all")
    words = ["batch", *map(str, (*two_lidars, bad)), "--out", str(out)]
    assert main(words) == 1
    assert all("choose one with --topic" in row["reason"] for row in list(table(out).values())[:2])
    words += ["--topic", "/rear", "--every", "2", "--no-loops"]
    capfd.readouterr()
    assert main(words) == 1  # beside one wall nothing is sure
    output, errors = capfd.readouterr()
    rows, page = table(out), (out / "report.html").read_text(encoding="utf-8")
    wall, room, _ = rows.values()
    assert (wall["state"], room["state"]) == ("not trustworthy", "done") and "degenerate" in wall["reason"]
    assert "3: 1 done, 1 not trustworthy, 1 failed" in output
    assert "1 of 3 logs have no result, 1 of 3 logs are not trustworthy" in errors
    assert f"{two_lidars[0]} is not trustworthy" in page
    assert room["ate_share_of_path"] is None  # it stood still, without loops
    own = (out / room["run"] / "report.html").read_text(encoding="utf-8")
    assert "Accuracy" in own and "<td>–</td>" in own and "Loop closures" not in own
    for row in (wall, room):
        config = (out / row["run"] / "config.toml").read_text()
        assert row["scans"] == 10
        assert 'topic = "/rear"' in config and "every = 2" in config and "enabled = false" in config
    assert main([*words, "--gt", "truth.tum"]) == 2

    lines = [re.search(f"{name}</a>.*?</tr>", page, re.DOTALL)[0] for name in rows]
    blind, fine, _ = (re.findall(r"<td([^>]*)>([^<]*)</td>", each) for each in lines)
    assert blind[:2] == [(' class="bad"', "not trustworthy"), ("", "10")] and fine[0][1] == "trustworthy"
    assert blind[3] == (' class="bad"', str(wall["degenerate"])) and wall["degenerate"] > 5
    assert fine[2] == fine[3] == fine[4] == ("", "0")
    links = re.findall(r'<a href="([^"]+)">', page)
    assert len(links) == 3 and all((out / unquote(link)).is_file() for link in links)
    assert links[0].endswith("/report.html") and links[2].startswith("rows/")
    seen = look(out / "report.html", tmp_path, width=390)  # of a phone, beside long names
    assert 0.0 < seen["reasons"] <= 390 and seen["names"] < 0.45 * 390
    assert seen["wide"] <= seen["width"] and seen["outside"] == []


def test_of_remote_logs_a_pattern_names_those_that_match(monkeypatch):
    fsspec = pytest.importorskip("fsspec", reason="the extra remote is not installed")
    memory = fsspec.filesystem("memory")
    for name in ("b.mcap", "a.mcap", "c.txt"):
        memory.pipe_file(f"/drives/{name}", b"x")
    found = collect([Address("memory://drives/*.mcap"), Address("https://host/log.mcap?take=[1]")], [])
    assert [each.name for each in found] == ["a.mcap", "b.mcap", "log.mcap"]
    with pytest.raises(InputError, match=r"none\*: matches nothing"):
        collect([Address("memory://drives/none*")], [])


def test_the_memory_of_children_counts():
    before = resident_mib(os.getpid())
    code = "x = b'x' * (64 << 20); print(len(x), flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        child.stdout.readline()
        with_child = resident_mib(os.getpid())
        child.communicate("\n")
    assert with_child > before + 60.0 and resident_mib(child.pid) == 0.0
