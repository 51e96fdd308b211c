"""Judging how damaged run directories are read, and how runs go on from damaged checkpoints."""

import os
import shutil
import warnings
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from functools import partial
from io import StringIO
from unittest.mock import patch

import numpy as np

import scanchain
from scanchain.__main__ import main
from scanchain.api import open_recorder
from scanchain.errors import ScanchainError
from scanchain.files import write_whole
from scanchain.runs.job import Job, Progress
from scanchain.runs.run import run
from scanchain.trajectory import read_tum
from tests.support import made
from tests.support.fuzzing import within_bounds
from tests.support.mutations import any_mutant

_LEFT_AFTER = 12  # scans
_READABLE = "scanchain_viz.recording.recording.is_readable"  # tried in a process: most of the time of a case
_NOBODY = 99_999_999  # no process has this number


class _Stopping(Progress):
    """A user who stops the run."""

    def track(self, scans, count):
        for scan in scans:
            if scan.index == _LEFT_AFTER:
                self.stopped = True
                return
            yield scan


def checkpoint_complaints(folder, rng, count):
    """What is done with a damaged file of a run that was left, other than to refuse it or to go on to the same."""
    log, whole, left = made.log("office", seconds=2), folder / "whole", folder / "left"
    job = Job(logs=(log,), out=folder / "run", resume=True, force=True)
    scanchain.run(log, whole)
    truth = read_tum(whole / "trajectory.tum").poses
    run(job, open_recorder, _Stopping())
    (folder / f"run.partial-{os.getpid()}").rename(left)

    def resumed():
        try:
            done = run(job, open_recorder, Progress())
        except ScanchainError as error:
            return "" if "\n" not in error.text else f"more than a line: {error}"
        return "" if np.array_equal(read_tum(done.path / "trajectory.tum").poses, truth) else "other poses"

    for place, damaged, name in _damaged(left, folder / f"run.partial-{_NOBODY}", rng, count):
        with nullcontext() if name.endswith(".rrd") else patch(_READABLE, lambda path: True):
            wrong = _of(resumed)
        if wrong:
            yield f"checkpoint: {name}: {damaged.what}: {wrong}", damaged.data
        for path in [folder / "run", *folder.glob("run.*"), place]:
            shutil.rmtree(path, ignore_errors=True)


def run_complaints(folder, rng, count):
    """What is said of a damaged run directory other than a verdict, its map, or one line."""
    source = made.run("office", seconds=2)
    acts = (
        lambda place: _told("check", place),
        lambda place: _told(
            "localize", made.log("office", seconds=2), place, "--out", folder / "out", "--rerun", "off"
        ),
        lambda place: _told("view", place, "--png", folder / "a.png", "--force"),
    )
    for place, damaged, name in _damaged(source, folder / "run", rng, count):
        wrong = _of(partial(acts[rng.choice(3, p=[0.8, 0.05, 0.15])], place))
        if wrong:
            yield f"run: {name}: {damaged.what}: {wrong}", damaged.data
        for path in (place, folder / "out"):
            shutil.rmtree(path, ignore_errors=True)


def _damaged(source, place, rng, count):
    """So many copies of a directory in which one file is damaged: (its place, the damage, the file)."""
    names = sorted(str(path.relative_to(source)) for path in source.rglob("*") if path.is_file())
    for number in range(count):
        name = names[number % len(names)]
        shutil.copytree(source, place)
        damaged = any_mutant((place / name).read_bytes(), rng)
        write_whole(place / name, damaged.data)
        yield place, damaged, name


def _of(act):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        problem, told = within_bounds(act)
    return problem or told


def _told(*words):
    """What is wrong with the output of a command, empty where nothing is."""
    output, errors = StringIO(), StringIO()
    with redirect_stdout(output), redirect_stderr(errors):
        code = main([str(word) for word in words])
    lines = [line for line in errors.getvalue().splitlines() if line.startswith("error: ")]
    is_foreseen = len(lines) == 1 and "--debug shows the traceback" not in lines[0]
    return "" if code == 0 or is_foreseen else f"exit code {code}: {errors.getvalue()}"
