"""Killing runs at random moments, reading what is left of them, and going on."""

import json
import os
import random
import subprocess
import sys
import time
import tomllib
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
from rerun.chunk import RrdReader

from scanchain.errors import InputError
from scanchain.graph.g2o import read_g2o
from scanchain.maps import MAP_FOLDER, open_saved_map, read_map, read_ply
from scanchain.runs.directory import CHECKPOINT_FILE, POINTS_FILE, RECORDING_FILE
from scanchain.runs.resume import Checkpoints, read_checkpoint
from scanchain.settings import load_settings
from scanchain.trajectory import read_kitti, read_tum
from scanchain_viz.recording import entities
from tests.support.scenes import ROOT

_KILLS_A_RUN = 3  # then it may go on to its end
COLUMNS = ["index", "stamp_ns", "x", "y", "z", "qx", "qy", "qz", "qw", "odom_x", "odom_qz", "covariance", "state",
           "reason", "keyframe", "inliers", "iterations", "residual_m"]  # fmt: skip


@dataclass
class Killed:
    """What a killed process left: the moment of its end, and how far the run had come."""

    after_s: float
    where: str
    steps: int


def start(log, out, *words, **options):
    command = [sys.executable, "-m", "scanchain", "run", str(log), "--out", str(out), *words]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL} | options
    return subprocess.Popen(command, cwd=ROOT, **quiet)


def processes_about(folder):
    """Other processes on whose command line a folder stands."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.pid != os.getpid() and str(folder) in " ".join(process.cmdline()):
                found.append(process)
    return found


def wait_until(condition, within_s=120.0):
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < within_s
        time.sleep(0.05)


def partial(out):
    """What a killed run left, None before its directory is there."""
    return next(out.parent.glob(f"{out.name}.partial-*"), None)


def steps_on_disk(out):
    """Scans of the last checkpoint."""
    folder = partial(out) or out
    try:
        return len(read_checkpoint(folder, config_of(folder)).slam.steps)
    except (FileNotFoundError, InputError):  # not there yet, or just taking another name
        return 0


def wait_for_steps(child, out, steps):
    """Return once a run has so many steps in its checkpoint."""
    while steps_on_disk(out) < steps:
        assert child.poll() is None, "the run ended before"
        time.sleep(0.02)


def same_result(a, b):
    for name in ("trajectory.tum", "trajectory.kitti.txt", "odometry.tum", "graph.g2o", "map.ply", "map.pgm"):
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    for path in (a / MAP_FOLDER).iterdir():
        assert path.read_bytes() == (b / MAP_FOLDER / path.name).read_bytes(), path.name
    tables = [pq.read_table(folder / "steps.parquet", columns=COLUMNS) for folder in (a, b)]
    assert tables[0].equals(tables[1])
    names_a, names_b = ({path.name for path in folder.iterdir()} for folder in (a, b))
    assert names_a - {RECORDING_FILE} == names_b - {RECORDING_FILE}
    if RECORDING_FILE in names_a & names_b:
        same_recording(a / RECORDING_FILE, b / RECORDING_FILE)


def same_recording(a, b):
    """Every component of every entity holds the same at the same moments; what was measured by the clock aside."""
    recorded = [_recorded(path) for path in (a, b)]
    assert recorded[0].keys() == recorded[1].keys()
    for key, values in recorded[0].items():
        others = recorded[1][key]
        is_equal = values.equals(others) or repr(values.to_pylist()) == repr(others.to_pylist())  # a NaN is none
        assert is_equal, f"{key}: {len(values)} rows, {len(others)} rows"


def _recorded(path):
    """Columns of a recording by entity and name, row by row as written; of what never changes, the last."""
    columns = {}
    for chunk in RrdReader(str(path)).stream():
        batch, entity = chunk.to_record_batch(), chunk.entity_path.lstrip("/")
        for name in () if entity in ("__properties", entities.TIME) else batch.schema.names:
            if not name.endswith("RowId"):
                columns.setdefault((entity, chunk.is_static, name), []).append(batch.column(name))
    arrays = {key: pa.chunked_array(parts) for key, parts in columns.items()}
    return {key: rows[-1:] if key[1] else rows for key, rows in arrays.items()}


def assert_readable(folder):
    """Every file of a run directory opens and is whole; how many steps it holds and how far it had come."""
    steps = 0
    for path in sorted(folder.iterdir()):
        if path.suffix == ".new" or path.name == "unfinished":  # told by its name
            continue
        read = _READ.get(path.name) or _READ.get(path.suffix)
        assert read is not None, f"{path.name} is of no kind that a run should leave"
        try:
            found = read(path)
            steps = max(steps, found) if isinstance(found, int) else steps
        except Exception as error:
            raise AssertionError(f"{path} does not open: {type(error).__name__}: {error}") from error
    return steps


def kill_at_random(log, words, folder, whole, *, kills, seed, longest_s):
    """Kill runs of a log at moments drawn from their whole duration, going on after each; what was left each time.

    After every third kill, and wherever a run is done before it is killed, its result must equal ``whole``.
    """
    rng, killed, number = random.Random(seed), 0, 0
    while killed < kills:
        out = folder / f"run_{number}"
        for _ in range(min(_KILLS_A_RUN, kills - killed)):
            after_s = rng.uniform(0.0, longest_s)
            child = start(log, out, *words, "--resume")
            try:
                assert child.wait(after_s) == 0
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
                killed += 1
                yield _left(out, after_s)
            if out.exists():
                break
        if not out.exists():
            assert start(log, out, *words, "--resume").wait() == 0
        same_result(out, whole)
        number += 1


def _left(out, after_s):
    if out.exists():
        assert_readable(out)
        return Killed(after_s, "when it was done", len(read_tum(out / "trajectory.tum")))
    folders = list(out.parent.glob(f"{out.name}.partial-*"))
    steps = max((assert_readable(folder) for folder in folders), default=0)
    names = {path.name for folder in folders for path in folder.iterdir()}
    where = next((what for name, what in _REACHED.items() if name in names), "before its directory was there")
    return Killed(after_s, where, steps)


def taken_up(slam, folder):
    """A chain, its points in a folder, that was put down there and is taken up again."""
    Checkpoints(folder, 10.0).write(slam)
    again = read_checkpoint(folder, slam.config).slam
    again.points.reopen(folder / POINTS_FILE)
    return again


def config_of(folder):
    """The configuration of a run that was left."""
    return load_settings(file=folder / "config.toml").config


def _check(is_whole):
    assert is_whole


def _read_as_viewer(path):
    """As rerun's viewer does, without a last message that was not finished, where rerun's API refuses the file."""
    command = [sys.executable, "-m", "rerun_cli", "rrd", "print", str(path)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "ERROR" not in printed.stderr and "StoreInfo" in printed.stdout, printed.stderr


_READ = {
    CHECKPOINT_FILE: lambda path: len(read_checkpoint(path.parent, config_of(path.parent)).slam.steps),
    MAP_FOLDER: open_saved_map,
    POINTS_FILE: lambda path: np.fromfile(path, np.float32),
    "keyframes.tum": lambda path: _check(np.loadtxt(path, ndmin=2).shape[1] == 8 + 21),  # covariance's triangle
    ".tum": lambda path: len(read_tum(path)),
    "trajectory.kitti.txt": lambda path: len(read_kitti(path)),
    "summary.txt": lambda path: _check(path.read_text(encoding="utf-8").endswith("\n")),
    ".g2o": read_g2o,
    ".parquet": pq.read_table,
    ".ply": read_ply,
    ".pgm": lambda path: read_map(path.parent),
    ".yaml": lambda path: read_map(path.parent),
    ".json": lambda path: json.loads(path.read_text(encoding="utf-8")),
    ".toml": lambda path: tomllib.loads(path.read_text(encoding="utf-8")),
    ".rrd": _read_as_viewer,
    ".html": lambda path: _check(path.read_text(encoding="utf-8").rstrip().endswith("</html>")),
}
_REACHED = {
    "report.html": "completing", "metrics.json": "writing its report", "trajectory.tum": "writing results",
    CHECKPOINT_FILE: "after a checkpoint", POINTS_FILE: "before the first checkpoint", "run.json": "opening",
}  # fmt: skip
