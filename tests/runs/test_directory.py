"""A run directory is complete under its name, or absent, or marked partial; nothing is lost on the way."""

import dataclasses
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader

from scanchain.api import open_recorder
from scanchain.errors import InputError
from scanchain.runs.directory import RunDirectory
from scanchain.runs.job import Job, Progress
from scanchain.runs.metrics import summary
from scanchain.runs.resume import PartialRunError
from scanchain.runs.run import run
from scanchain.settings import Override
from scanchain.simulation import simulate
from tests.support.naive_logs import SECOND, STAMP_NS, laser_scan, scan_said, write
from tests.support.scenes import ROOT


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """Six seconds in the simulated office, 60 scans."""
    path = tmp_path_factory.mktemp("log") / "office.mcap"
    simulate("office", path, duration_s=6.0)
    return path


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def run_file(folder):
    return json.loads((folder / "run.json").read_text())


def an_old_run(folder):
    folder.mkdir()
    (folder / "run.json").write_text("{}")
    (folder / "old.txt").write_text("old")
    return folder


def partial_in(folder):
    (found,) = [path for path in folder.iterdir() if ".partial-" in path.name]
    return found


# the directory alone


def test_it_takes_its_name_only_when_complete(tmp_path):
    with RunDirectory(tmp_path / "a", force=False) as directory:
        (directory.path / "file").touch()
        assert not (tmp_path / "a").exists()
        assert ".partial-" in directory.path.name and directory.path.parent == tmp_path
        directory.complete()
        assert directory.path == tmp_path / "a"
    assert names(tmp_path) == ["a"] and names(tmp_path / "a") == ["file"]


def test_left_without_a_word_nothing_remains(tmp_path):
    with RunDirectory(tmp_path / "a", force=False) as directory:
        (directory.path / "file").touch()
    assert names(tmp_path) == []


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_nothing_unless_it_was_worth_keeping(tmp_path, error):
    with pytest.raises(error), RunDirectory(tmp_path / "a", force=False):
        raise error
    assert names(tmp_path) == []
    with pytest.raises(error), RunDirectory(tmp_path / "a", force=False) as directory:
        directory.worth_keeping()
        raise error
    assert names(tmp_path) == [directory.path.name] and ".partial-" in directory.path.name


def test_parents_are_made(tmp_path):
    with RunDirectory(tmp_path / "x" / "y" / "a", force=False) as directory:
        directory.complete()
    assert names(tmp_path / "x" / "y") == ["a"]


def test_an_existing_directory_is_refused_even_if_it_is_empty(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match=r"a: exists; choose another out or pass force=True"):
        RunDirectory(tmp_path / "a", force=False)


def test_force_replaces_a_run_only_once_the_new_one_is_complete(tmp_path):
    old = an_old_run(tmp_path / "a")
    with RunDirectory(old, force=True) as directory:
        (directory.path / "new.txt").touch()
        assert names(old) == ["old.txt", "run.json"]
        directory.complete()
    assert names(tmp_path) == ["a"] and names(old) == ["new.txt"]


def test_a_forced_run_that_fails_leaves_the_old_one_as_it_was(tmp_path):
    old = an_old_run(tmp_path / "a")
    with pytest.raises(RuntimeError), RunDirectory(old, force=True):
        raise RuntimeError
    assert names(tmp_path) == ["a"] and (old / "old.txt").read_text() == "old"


def test_force_replaces_nothing_that_is_no_run(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "precious").touch()
    with pytest.raises(InputError, match="is not a run"):
        RunDirectory(tmp_path / "home", force=True)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file"):
        RunDirectory(tmp_path / "file", force=True)
    with pytest.raises(InputError, match="is not a run"):
        RunDirectory(Path("/"), force=True)
    assert names(tmp_path / "home") == ["precious"]


def test_what_came_to_be_in_the_meantime_is_not_overwritten(tmp_path):
    with pytest.raises(InputError, match="exists"), RunDirectory(tmp_path / "a", force=False) as directory:
        directory.worth_keeping()
        (directory.path / "mine").touch()
        an_old_run(tmp_path / "a")
        directory.complete()
    assert names(tmp_path / "a") == ["old.txt", "run.json"]
    assert names(directory.path) == ["mine"]


def test_the_leftovers_of_a_dead_process_of_the_same_number_are_cleared(tmp_path):
    left = tmp_path / f"a.partial-{os.getpid()}"
    left.mkdir()
    (left / "stale").touch()
    with RunDirectory(tmp_path / "a", force=False) as directory:
        directory.complete()
    assert names(tmp_path) == ["a"] and names(tmp_path / "a") == []


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    with (
        pytest.raises(InputError, match=r"file/a: cannot be made .*choose another out"),
        RunDirectory(tmp_path / "file" / "a", force=False),
    ):
        pytest.fail("it was made")


def test_a_run_is_not_written_into_another(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "run.json").write_text('{"versions": {"scanchain": "1"}}')
    with pytest.raises(InputError, match=r"lies in the run directory .*a; choose another out"):
        RunDirectory(tmp_path / "a" / "b" / "c", force=True)


# whole runs


class Watcher(Progress):
    """Ends a run after so many scans: by a wish, or by an error."""

    def __init__(self, after, error=None):
        self.after, self.error, self.stopped = after, error, False

    def track(self, scans, count):
        for done, scan in enumerate(scans):
            if done == self.after and self.error is not None:
                raise self.error
            if done == self.after:
                self.stopped = True
                return
            yield scan


_NO_PROCESS = 999_999_999


class Telling(Progress):
    """Remembers every line."""

    def __init__(self):
        self.lines = []

    def say(self, line):
        self.lines.append(line)

    announce = say

    def track(self, scans, count):
        yield from scans
        self.lines.append("through")


def job(log, out, **options):
    return Job(logs=(log,), out=out, sinks=frozenset(), **options)


def test_a_run_says_that_it_is_complete_and_what_it_read(tmp_path, office):
    finished = run(job(office, tmp_path / "a", command=("scanchain", "run")), open_recorder, Progress())
    assert finished.path == tmp_path / "a" and names(tmp_path) == ["a"]
    said = run_file(finished.path)
    assert (said["complete"], said["stopped"], said["command"]) == (True, "", ["scanchain", "run"])
    assert said["logs"] == [
        {
            "path": str(office),
            "size_bytes": office.stat().st_size,
            "sha256": hashlib.sha256(office.read_bytes()).hexdigest(),
            "version": "",
        }
    ]
    assert said["versions"]["numpy"] == np.__version__ and said["duration_s"] > 0.0


@pytest.mark.parametrize("sinks", [(), ("save",)])
def test_a_run_speaks_of_its_recording_only_where_it_makes_one(tmp_path, office, sinks):
    telling = Telling()
    run(Job(logs=(office,), out=tmp_path / "a", sinks=frozenset(sinks)), open_recorder, telling)
    assert ("writing the rest of the recording" in telling.lines) == bool(sinks)


def test_a_run_that_the_user_stops_is_whole_up_to_there_and_marked_partial(tmp_path, office):
    finished = run(job(office, tmp_path / "a"), open_recorder, Watcher(50))
    assert names(tmp_path) == [finished.path.name] and ".partial-" in finished.path.name
    said = run_file(finished.path)
    assert not said["complete"] and "stopped by the user after 50 scans" in said["stopped"]
    assert "PARTIAL" in (finished.path / "summary.txt").read_text().splitlines()[1]
    assert len(np.loadtxt(finished.path / "trajectory.tum")) == finished.metrics.scans == 50
    assert {"graph.g2o", "map.ply", "metrics.json"} <= set(names(finished.path))
    metrics = json.loads((finished.path / "metrics.json").read_text())
    assert metrics["stopped"] == said["stopped"]


def test_a_run_that_the_user_stops_tells_of_the_scans_that_it_left_out(tmp_path):
    ranges = [[1.0] * 9] * 3 + [[np.inf] * 9] + [[1.0] * 9] * 96
    stamps_ns = range(STAMP_NS, STAMP_NS + len(ranges) * SECOND, SECOND)
    said = [
        scan_said(stamp_ns, laser_scan(stamp_ns, each)) for stamp_ns, each in zip(stamps_ns, ranges, strict=True)
    ]
    finished = run(job(write(tmp_path / "log.mcap", said), tmp_path / "a"), open_recorder, Watcher(20))
    assert finished.stopped and "of /scan was left out (the first: " in finished.metrics.warnings[0]


def test_a_run_that_the_user_stops_says_that_it_used_the_wheels(tmp_path, office):
    text = run(job(office, tmp_path / "a"), open_recorder, Watcher(20)).summary
    assert "(wheel odometry /odom; lidar at" in text and "not used" not in text


def test_a_crash_leaves_what_there_was_marked_partial_with_its_traceback(tmp_path, office):
    with pytest.raises(
        PartialRunError, match=r"RuntimeError: boom; traceback.txt and the 20 scans until then are in"
    ) as e:
        run(job(office, tmp_path / "a"), open_recorder, Watcher(20, RuntimeError("boom")))
    folder = partial_in(tmp_path)
    assert str(folder) in str(e.value) and names(tmp_path) == [folder.name]
    said = run_file(folder)
    assert not said["complete"] and said["stopped"] == "boom"
    assert "RuntimeError: boom" in (folder / "traceback.txt").read_text()
    odometry = np.loadtxt(folder / "odometry.tum")
    steps = pq.read_table(folder / "steps.parquet").to_pydict()
    assert len(odometry) == len(steps["x"]) == 20
    np.testing.assert_allclose(odometry[:, 1], steps["odom_x"], atol=1e-9)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_an_interrupt_and_a_full_disk_keep_the_scans_without_a_traceback(tmp_path, office, error):
    with pytest.raises(PartialRunError, match="20 scans until then"):
        run(job(office, tmp_path / "a"), open_recorder, Watcher(20, error))
    folder = partial_in(tmp_path)
    assert "traceback.txt" not in names(folder) and len(np.loadtxt(folder / "odometry.tum")) == 20


@pytest.mark.parametrize("error", [InputError("bad"), KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_what_ends_a_run_before_its_first_scan_leaves_nothing(tmp_path, office, error):
    with pytest.raises(type(error)):
        run(job(office, tmp_path / "a"), open_recorder, Watcher(0, error))
    assert names(tmp_path) == []


def test_a_bug_before_the_first_scan_leaves_its_traceback_alone(tmp_path, office):
    with pytest.raises(
        PartialRunError, match=r"ZeroDivisionError: boom; traceback.txt and the 0 scans until then are in"
    ):
        run(job(office, tmp_path / "a"), open_recorder, Watcher(0, ZeroDivisionError("boom")))
    folder = partial_in(tmp_path)
    assert "ZeroDivisionError" in (folder / "traceback.txt").read_text()
    assert not run_file(folder)["complete"]


def test_a_bad_scan_in_the_middle_is_bad_input_and_what_was_before_it_is_kept(tmp_path):
    good = [scan_said(STAMP_NS + k * SECOND, laser_scan(STAMP_NS + k * SECOND, [1.0] * 9)) for k in range(5)]
    bad = scan_said(STAMP_NS + 5 * SECOND, laser_scan(STAMP_NS, [np.inf] * 9))
    path = write(tmp_path / "log.mcap", [*good, bad])
    none_bad = Override("log.max_bad_scans_percent", "0", "--log.max_bad_scans_percent")
    with pytest.raises(InputError, match=r"scan 5 of /scan has no valid point .*; 5 scans until then are in"):
        run(job(path, tmp_path / "a", overrides=(none_bad,)), open_recorder, Progress())
    assert not (tmp_path / "a").exists()
    assert len(np.loadtxt(partial_in(tmp_path) / "odometry.tum")) == 5


def test_a_forced_run_that_crashes_leaves_the_old_run_whole(tmp_path, office):
    old = an_old_run(tmp_path / "a")
    with pytest.raises(PartialRunError):
        run(job(office, old, force=True), open_recorder, Watcher(20, RuntimeError("boom")))
    assert names(old) == ["old.txt", "run.json"]
    run(job(office, old, force=True), open_recorder, Progress())
    assert "old.txt" not in names(old) and run_file(old)["complete"]


def test_of_two_runs_into_one_directory_the_second_keeps_its_results_beside(tmp_path, office):
    class Slow(Progress):
        def track(self, scans, count):
            yield from scans
            an_old_run(tmp_path / "a")

    with pytest.raises(InputError, match=r"a: exists; .*60 scans until then are in"):
        run(job(office, tmp_path / "a"), open_recorder, Slow())
    assert names(tmp_path / "a") == ["old.txt", "run.json"]
    folder = partial_in(tmp_path)
    assert not run_file(folder)["complete"]
    usual = run(job(office, tmp_path / "b"), open_recorder, Progress()).path
    tables = [pq.read_table(path / "steps.parquet").select(["x", "y", "qz"]) for path in (folder, usual)]
    assert tables[0].equals(tables[1])


def test_what_a_stopped_run_left_is_named_with_resume_where_its_name_or_that_of_its_run_exists(tmp_path, office):
    left = run(job(office, tmp_path / "a"), open_recorder, Watcher(20)).path.rename(
        tmp_path / f"a.partial-{_NO_PROCESS}"
    )
    with pytest.raises(InputError, match=rf"{left.name}: exists; .*: out {tmp_path / 'a'} --resume continues it"):
        RunDirectory(left, force=False)
    an_old_run(tmp_path / "a")
    with pytest.raises(
        InputError, match=rf"a: exists; .*; {left.name} is of a run .*: force=True --resume continues"
    ):
        RunDirectory(tmp_path / "a", force=False)
    resumed = run(job(office, tmp_path / "a", force=True, resume=True), open_recorder, Progress())
    assert resumed.path == tmp_path / "a" and names(tmp_path) == ["a"]


def test_a_complete_run_removes_what_earlier_ones_left_but_not_what_another_process_writes(tmp_path, office):
    for name in (f"a.partial-{_NO_PROCESS}", f"a.partial-{os.getppid()}", f"b.partial-{_NO_PROCESS}"):
        an_old_run(tmp_path / name)
    (tmp_path / f"a.partial-{_NO_PROCESS}" / "state.checkpoint").touch()
    told = Telling()
    run(job(office, tmp_path / "a"), open_recorder, told)
    assert "--resume would continue it, this run starts over and removes it once complete" in "\n".join(told.lines)
    assert names(tmp_path) == ["a", f"a.partial-{os.getppid()}", f"b.partial-{_NO_PROCESS}"]


def test_interrupted_while_it_optimizes_a_run_can_be_resumed(tmp_path, office):
    class Interrupted(Progress):
        def say(self, line):
            if line.startswith("optimizing"):
                raise KeyboardInterrupt

    with pytest.raises(PartialRunError, match=r"interrupted; 60 scans until then are in .*; to resume: "):
        run(job(office, tmp_path / "a"), open_recorder, Interrupted())
    told = Telling()
    run(job(office, tmp_path / "a", resume=True), open_recorder, told)
    assert any(line.startswith("resuming after 60 scans") for line in told.lines)


def test_a_trajectory_of_a_few_scans_is_warned_of(tmp_path, office):
    for scans, words in ((1, "trajectory of 1 scan says"), (2, "trajectory of 2 scans says"), (3, "")):
        few = (Override("log.every", str(60 // scans), "--every"),)
        finished = run(job(office, tmp_path / str(scans), overrides=few), open_recorder, Progress())
        warnings = " ".join(finished.warnings)
        assert words in warnings and ("nothing about the log" in warnings) == (scans < 3)


def test_every_stage_after_the_last_scan_is_told_as_it_begins(tmp_path, office):
    told = Telling()
    run(job(office, tmp_path / "a"), open_recorder, told)
    stages = ["closing the last", "optimizing", "refining 60 scans", "the map", "the report"]
    after = told.lines[told.lines.index("through") + 1 :]
    assert [stage for line in after for stage in stages if stage in line] == stages == stages[: len(after)]


def test_one_keyframe_is_not_called_keyframes(tmp_path, office):
    finished = run(job(office, tmp_path / "a"), open_recorder, Watcher(3))
    text = finished.summary
    slow = msgspec.structs.replace(finished.metrics, scans_per_s=1.2)
    assert ", 1 scan/s, " in summary(slow, "", "", ())
    assert finished.metrics.expected_ate_m is None and "expected ATE   unknown: the pose graph has no edge" in text
    assert "1 keyframe\n" in text and "PARTIAL: stopped by the user after 3 scans" in text


def test_a_file_named_twice_is_refused(tmp_path, office):
    twice = dataclasses.replace(job(office, tmp_path / "a"), logs=(office, office))
    with pytest.raises(InputError, match=r"office.mcap: is named 2 times"):
        run(twice, open_recorder, Progress())
    assert names(tmp_path) == []


def started(log, out):
    """A run in a process of its own that dawdles after forty scans; given back once it is there."""
    script = """
import sys, time
from scanchain.__main__ import main
from scanchain.odometry import FrontEnd
locate = FrontEnd.locate
def waiting(self, prepared):
    if prepared.scan.index == 40:
        print("there", flush=True)
    if prepared.scan.index >= 40:
        time.sleep(0.2)
    return locate(self, prepared)
FrontEnd.locate = waiting
sys.exit(main(sys.argv[1:]))
"""
    child = subprocess.Popen(
        [sys.executable, "-c", script, "run", str(log), "--out", str(out)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stdout.readline() == "there\n", child.stderr.read()
    return child


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
def test_ctrl_c_ends_a_run_in_good_order_with_exit_code_1(tmp_path, office):
    child = started(office, tmp_path / "a")
    child.send_signal(signal.SIGINT)
    output, errors = child.communicate(timeout=30)
    folder = partial_in(tmp_path)
    assert child.returncode == 1
    assert errors.startswith("error: stopped by the user after ") and errors.count("\n") == 1
    assert str(folder) in errors and "PARTIAL" in output
    assert errors.endswith(f"to resume: scanchain run {office} --out {tmp_path / 'a'} --resume\n")
    assert 40 <= len(np.loadtxt(folder / "trajectory.tum")) < 60
    assert list(RrdReader(str(folder / "recording.rrd")).stream())


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_killed_run_is_marked_partial_and_its_recording_can_be_read(tmp_path, office):
    child = started(office, tmp_path / "a")
    time.sleep(0.3)
    child.kill()
    child.communicate(timeout=30)
    folder = partial_in(tmp_path)
    assert names(tmp_path) == [folder.name]
    assert run_file(folder)["complete"] is False
    assert list(RrdReader(str(folder / "recording.rrd")).stream())
