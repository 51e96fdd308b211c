"""A run directory is complete under its name, or absent, or marked partial; nothing is lost on the way."""

import dataclasses
import json
import os

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

from scanchain.api import open_recorder
from scanchain.errors import InputError, ScanchainError
from scanchain.runs.directory import RunDirectory
from scanchain.runs.job import Job, Progress
from scanchain.runs.metrics import summary
from scanchain.runs.run import run
from scanchain.settings import Override
from tests.support.naive_logs import SECOND, STAMP_NS, laser_scan, scan_said, write

_NO_PROCESS = 999_999_999


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def run_file(folder):
    return json.loads((folder / "run.json").read_text())


def an_old_run(folder):
    folder.mkdir()
    (folder / "run.json").write_text('{"versions": {"scanchain": "1"}}')
    (folder / "old.txt").write_text("old")
    return folder


def partial_in(folder):
    (found,) = [path for path in folder.iterdir() if ".partial-" in path.name]
    return found


# the directory alone


def test_it_takes_its_name_only_when_complete_whatever_a_dead_process_of_the_same_number_left(tmp_path):
    folder = tmp_path / "x" / "y"
    left = folder / f"a.partial-{os.getpid()}"
    left.mkdir(parents=True)
    (left / "stale").touch()
    with RunDirectory(folder / "a", force=False) as directory:
        (directory.path / "file").touch()
        assert names(folder) == [directory.path.name] and ".partial-" in directory.path.name
        directory.complete()
        assert directory.path == folder / "a"
    assert names(folder) == ["a"] and names(folder / "a") == ["file"]
    old = an_old_run(tmp_path / "b")
    with RunDirectory(old, force=True) as directory:
        assert names(old) == ["old.txt", "run.json"]
        directory.complete()
    assert names(old) == []


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_left_before_it_is_complete_nothing_remains_unless_it_was_worth_keeping(tmp_path, error):
    old = an_old_run(tmp_path / "a")
    with RunDirectory(old, force=True):
        pass
    with pytest.raises(error), RunDirectory(old, force=True):
        raise error
    assert names(tmp_path) == ["a"] and names(old) == ["old.txt", "run.json"]
    with pytest.raises(error), RunDirectory(old, force=True) as directory:
        directory.worth_keeping()
        raise error
    assert names(tmp_path) == ["a", directory.path.name] and ".partial-" in directory.path.name


@pytest.mark.parametrize(
    ("out", "force", "words"),
    [
        ("empty", False, "empty: exists; choose another out or pass force=True"),
        ("home", True, "is not a run"),
        ("file", True, "is a file"),
        ("/", True, "is not a run"),
        ("run/b/c", True, "lies in the run directory .*run; choose another out"),
        ("file/a", False, "file/a: cannot be made .*choose another out"),
    ],
)
def test_what_must_not_be_overwritten_is_refused(tmp_path, out, force, words):
    (tmp_path / "empty").mkdir()
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "precious").touch()
    (tmp_path / "file").touch()
    an_old_run(tmp_path / "run")
    with pytest.raises(InputError, match=words), RunDirectory(tmp_path / out, force=force):
        pytest.fail("it was made")
    assert names(tmp_path / "home") == ["precious"]


# whole runs


class Watcher(Progress):
    """Remembers every line; ends a run after so many scans: by a wish, or by an error."""

    def __init__(self, after=np.inf, error=None):
        self.after, self.error, self.lines = after, error, []

    def say(self, line):
        self.lines.append(line)

    announce = say

    def track(self, scans, count):
        for done, scan in enumerate(scans):
            if done == self.after and self.error is not None:
                raise self.error
            if done == self.after:
                self.stopped = True
                return
            yield scan
        self.lines.append("through")


def job(log, out, sinks=(), **options):
    return Job(logs=(log,), out=out, sinks=frozenset(sinks), **options)


def test_a_run_says_what_it_does_what_it_read_and_that_it_is_complete(tmp_path, office):
    told = Watcher()
    finished = run(job(office, tmp_path / "a", command=("scanchain", "run")), open_recorder, told)
    assert finished.path == tmp_path / "a" and names(tmp_path) == ["a"]
    said = run_file(finished.path)
    assert said["complete"] and said["command"] == ["scanchain", "run"] and said["duration_s"] > 0.0
    stages = ["closing the last", "optimizing", "refining 60 scans", "the map", "the report"]
    after = told.lines[told.lines.index("through") + 1 :]
    assert [stage for line in after for stage in stages if stage in line] == stages == stages[: len(after)]


def test_a_run_that_the_user_stops_is_whole_up_to_there_and_marked_partial(tmp_path, office):
    told = Watcher(50)
    finished = run(job(office, tmp_path / "a", sinks=["save"]), open_recorder, told)
    assert names(tmp_path) == [finished.path.name] and ".partial-" in finished.path.name
    said = run_file(finished.path)
    assert not said["complete"] and "stopped by the user after 50 scans" in said["stopped"]
    (heading,) = (line for line in finished.summary.splitlines() if line.startswith(str(office)))
    assert "PARTIAL" in heading and (finished.path / "summary.txt").read_text() == finished.summary
    assert len(np.loadtxt(finished.path / "trajectory.tum")) == finished.metrics.scans == 50
    assert {"graph.g2o", "map.ply", "metrics.json"} <= set(names(finished.path))
    metrics = json.loads((finished.path / "metrics.json").read_text())
    assert metrics["stopped"] == said["stopped"]
    assert "(wheel odometry /odom; lidar at" in finished.summary and "not used" not in finished.summary
    assert "writing the rest of the recording" in told.lines


def test_a_run_that_the_user_stops_tells_of_the_scans_that_it_left_out(tmp_path):
    ranges = [[1.0] * 9] * 3 + [[np.inf] * 9] + [[1.0] * 9] * 96
    stamps_ns = range(STAMP_NS, STAMP_NS + len(ranges) * SECOND, SECOND)
    said = [
        scan_said(stamp_ns, laser_scan(stamp_ns, each)) for stamp_ns, each in zip(stamps_ns, ranges, strict=True)
    ]
    finished = run(job(write(tmp_path / "log.mcap", said), tmp_path / "a"), open_recorder, Watcher(20))
    assert finished.stopped and "of /scan was left out (the first: " in finished.metrics.warnings[0]


def test_a_crash_leaves_what_there_was_marked_partial_with_its_traceback_and_the_old_run_whole(tmp_path, office):
    old, told = an_old_run(tmp_path / "a"), Watcher(20, RuntimeError("boom"))
    with pytest.raises(
        ScanchainError, match=r"RuntimeError: boom; traceback.txt and the 20 scans until then are in"
    ) as e:
        run(job(office, old, force=True), open_recorder, told)
    folder = partial_in(tmp_path)
    assert str(folder) in str(e.value) and names(tmp_path) == ["a", folder.name]
    assert names(old) == ["old.txt", "run.json"] and "writing the rest of the recording" not in told.lines
    said = run_file(folder)
    assert not said["complete"] and said["stopped"] == "boom"
    assert "RuntimeError: boom" in (folder / "traceback.txt").read_text()
    odometry = np.loadtxt(folder / "odometry.tum")
    steps = pq.read_table(folder / "steps.parquet").to_pydict()
    assert len(odometry) == len(steps["x"]) == 20
    np.testing.assert_allclose(odometry[:, 1], steps["odom_x"], atol=1e-9)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device"), InputError("bad")])
def test_an_interrupt_a_full_disk_and_bad_input_keep_the_scans_if_any_without_a_traceback(tmp_path, office, error):
    with pytest.raises(type(error)):
        run(job(office, tmp_path / "a"), open_recorder, Watcher(0, error))
    assert names(tmp_path) == []
    kind = InputError if isinstance(error, InputError) else ScanchainError
    with pytest.raises(kind, match="20 scans until then are in"):
        run(job(office, tmp_path / "a"), open_recorder, Watcher(20, error))
    folder = partial_in(tmp_path)
    assert "traceback.txt" not in names(folder) and len(np.loadtxt(folder / "odometry.tum")) == 20


def test_of_two_runs_into_one_directory_the_second_keeps_its_results_beside(tmp_path, office):
    class Slow(Progress):
        def track(self, scans, count):
            yield from scans
            an_old_run(tmp_path / "a")

    with pytest.raises(InputError, match=r"a: exists; .*60 scans until then are in"):
        run(job(office, tmp_path / "a"), open_recorder, Slow())
    assert names(tmp_path / "a") == ["old.txt", "run.json"]
    folder = partial_in(tmp_path)
    assert not run_file(folder)["complete"] and pq.read_table(folder / "loops.parquet").num_rows == 0
    assert pq.read_table(folder / "steps.parquet").num_rows == len(np.loadtxt(folder / "trajectory.tum")) == 60


def test_what_a_stopped_run_left_is_named_with_resume_where_its_run_exists(tmp_path, office):
    left = run(job(office, tmp_path / "a"), open_recorder, Watcher(20)).path.rename(
        tmp_path / f"a.partial-{_NO_PROCESS}"
    )
    an_old_run(tmp_path / "a")
    with pytest.raises(
        InputError, match=rf"a: exists; .*; {left.name} is of a run .*: force=True --resume continues"
    ):
        RunDirectory(tmp_path / "a", force=False)
    resumed = run(job(office, tmp_path / "a", force=True, resume=True), open_recorder, Progress())
    assert resumed.path == tmp_path / "a" and names(tmp_path) == ["a"]
    assert "note           resumed after 20 scans" in resumed.summary
    assert not any("resumed" in warning for warning in resumed.warnings)


def test_a_complete_run_removes_what_earlier_ones_left_but_not_what_another_process_writes(tmp_path, office):
    for name in (f"a.partial-{_NO_PROCESS}", f"a.partial-{os.getppid()}", f"b.partial-{_NO_PROCESS}"):
        an_old_run(tmp_path / name)
    (tmp_path / f"a.partial-{_NO_PROCESS}" / "state.checkpoint").touch()
    told = Watcher()
    run(job(office, tmp_path / "a"), open_recorder, told)
    assert "--resume would continue it, this run starts over and removes it once complete" in "\n".join(told.lines)
    assert names(tmp_path) == ["a", f"a.partial-{os.getppid()}", f"b.partial-{_NO_PROCESS}"]


def test_interrupted_while_it_optimizes_a_run_can_be_resumed(tmp_path, office):
    class Interrupted(Progress):
        def say(self, line):
            if line.startswith("optimizing"):
                raise KeyboardInterrupt

    with pytest.raises(ScanchainError, match=r"interrupted; 60 scans until then are in .*; to resume: "):
        run(job(office, tmp_path / "a"), open_recorder, Interrupted())
    told = Watcher()
    run(job(office, tmp_path / "a", resume=True), open_recorder, told)
    assert any(line.startswith("resuming after 60 scans") for line in told.lines)


def test_a_trajectory_of_a_few_scans_is_warned_of(tmp_path, office):
    for scans, words in ((1, "trajectory of 1 scan says"), (2, "trajectory of 2 scans says"), (3, "")):
        few = (Override("log.every", str(60 // scans), "--every"),)
        finished = run(job(office, tmp_path / str(scans), overrides=few), open_recorder, Progress())
        warnings = " ".join(finished.warnings)
        assert words in warnings and ("nothing about the log" in warnings) == (scans < 3)
    slow = msgspec.structs.replace(finished.metrics, scans_per_s=1.2, keyframes=1)
    assert ", 1 scan/s, " in summary(slow, "", "", ()) and "1 keyframe\n" in summary(slow, "", "", ())


def test_a_file_named_twice_is_refused(tmp_path, office):
    twice = dataclasses.replace(job(office, tmp_path / "a"), logs=(office, office))
    with pytest.raises(InputError, match=r"\.mcap: is named 2 times"):
        run(twice, open_recorder, Progress())
    assert names(tmp_path) == []
