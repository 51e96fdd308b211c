"""How much longer a whole run takes than its odometry alone, and where its time goes.

    python -m tests.benchmarks.whole_run [LOG ...] [--repeats 5]

*run* is ``scanchain run LOG --out DIR``: loops on, recording, map and report written. *odometry* is a process that
reads the same log and tracks its scans with the same configuration, and nothing else; both by the clock, from the
start of the interpreter to its end, with compiled kernels. *tracking* is the sum over the scans of
``Odometry.track`` in that process: without interpreter, imports, reading. Each is the least of several repeats, which
take turns. Stages are those of one more run; what is done beside the odometry, in other threads, costs the clock
little, so that they do not add up to the whole.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from threading import local
from time import perf_counter, time
from typing import Any

from pipeline.logs import open_log
from pipeline.odometry import Odometry
from pipeline.settings import load_settings
from tests.benchmarks.odometry3d import DATA, DEFAULT_LOGS
from tests.benchmarks.peak_memory import ROOT


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path, default=[DATA / name for name in DEFAULT_LOGS])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--child", choices=("odometry", "stages"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child == "odometry":
        print(track(arguments.logs[0]))
    elif arguments.child == "stages":
        print(json.dumps(seconds_by_stage(arguments.logs[0])))
    else:
        for path in arguments.logs:
            show(path.resolve(), arguments.repeats)


def show(path: Path, repeats: int) -> None:
    """Measure one log and print what it took."""
    runs: list[float] = []
    alone: list[float] = []
    tracking: list[float] = []
    for repeat in range(repeats + 1):
        run_s, _ = _timed("pipeline", "run", str(path), "--out", "run")
        alone_s, answer = _timed("tests.benchmarks.whole_run", str(path), "--child", "odometry")
        if repeat:  # the first compiles, and brings files into memory
            runs.append(run_s)
            alone.append(alone_s)
            tracking.append(float(answer))
    print(f"\n{path.name}, least of {repeats}")
    print(f"  run {min(runs):.2f} s, odometry {min(alone):.2f} s, tracking {min(tracking):.2f} s")
    print(f"  run / odometry {min(runs) / min(alone):.2f}, run / tracking {min(runs) / min(tracking):.2f}")
    whole_s, answer = _timed("tests.benchmarks.whole_run", str(path), "--child", "stages")
    for name, seconds in json.loads(answer.splitlines()[-1]).items():
        print(f"    {name:28}{seconds:6.2f} s{100.0 * seconds / whole_s:6.1f} %")
    print(f"    {'whole':28}{whole_s:6.2f} s", flush=True)


def track(path: Path) -> float:
    """The odometry of a log and nothing else; seconds spent in ``track``."""
    log = open_log(path)
    odometry = Odometry(load_settings(log.dimension).config, log.T_base_lidar)
    seconds = 0.0
    for scan in log.scans():
        started = perf_counter()
        odometry.track(scan)
        seconds += perf_counter() - started
    return seconds


def seconds_by_stage(path: Path) -> dict[str, float]:
    """A run in this process with a clock around each stage."""
    from pipeline.__main__ import main as scanchain

    clock = Clock()
    clock.watch_all()
    with tempfile.TemporaryDirectory() as folder:
        assert scanchain(["run", str(path), "--out", str(Path(folder) / "run"), "--json"]) == 0
    return dict(clock.seconds)


class Clock:
    """Adds up what passes inside functions, of each thread by itself and without what other stages take inside."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.inner = local()

    def watch_all(self) -> None:
        """Put the clock into the functions that make up a run."""
        from pipeline.graph.pose_graph import PoseGraph
        from pipeline.logs import Log
        from pipeline.loops import LoopCloser
        from pipeline.point_store import PointStore
        from pipeline.runs import processing, results, run
        from pipeline.runs.checkpoint import Checkpoints
        from pipeline.runs.journal import Journal
        from pipeline.runs.step_table import StepTable
        from viz.recording import Recording

        self.watch("opening", run, "open_log")
        self.watch("odometry", Odometry, "track")
