"""How much longer a whole run takes than its odometry alone, and where its time goes.

    python -m tests.benchmarks.whole_run [LOG ...] [--repeats 5] [--cold]

*run* is ``scanchain run LOG --out DIR``: loops on, recording, map and report written. *odometry* is a process that
reads the same log and tracks its scans with the same configuration, and nothing else. Both are taken by the clock,
from the start of the interpreter to its end, with compiled kernels. *tracking* is the sum over the scans of
``Odometry.track`` in that process: without interpreter, imports and reading. Each is the least of several repeats,
which take turns, with Python's bytecode on disk as after any installation. The stages are those of one more run,
in the main thread and beside it; it imports rather more at its start than others do. With ``--cold`` one more run
compiles all kernels.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter, time
from typing import Any

from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.settings import load_settings
from tests.benchmarks.odometry3d import DATA, DEFAULT_LOGS
from tests.benchmarks.peak_memory import ROOT
from tests.benchmarks.stopwatch import Stopwatch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path, default=[DATA / name for name in DEFAULT_LOGS])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cold", action="store_true", help="time a first run too, which compiles")
    parser.add_argument("--track", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--stages", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.track:
        print(track(arguments.logs[0]))
    elif arguments.stages:
        print(json.dumps(seconds_by_stage(arguments.logs[0], arguments.stages)))
    else:
        for path in arguments.logs:
            show(path.resolve(), arguments.repeats)
            if arguments.cold:
                show_cold(path.resolve())


def show(path: Path, repeats: int) -> None:
    """Measure one log and print what it took."""
    runs, alone, tracking = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(repeats + 1):
            runs.append(timed("scanchain", "run", str(path), "--out", f"{folder}/run", "--force")[0])
            seconds, answer = timed("tests.benchmarks.whole_run", str(path), "--track")
            alone.append(seconds)
            tracking.append(float(answer))
    run_s, alone_s, tracking_s = (min(each[1:]) for each in (runs, alone, tracking))  # the first may compile
    print(f"\n{path.name}, least of {repeats}")
    print(f"  run {run_s:.2f} s, odometry {alone_s:.2f} s, tracking {tracking_s:.2f} s")
    print(f"  run / odometry {run_s / alone_s:.2f}, run / tracking {run_s / tracking_s:.2f}")
    whole_s, answer = timed("tests.benchmarks.whole_run", str(path), "--stages", repr(time()))
    stages = json.loads(answer.splitlines()[-1])
    print(f"  {'stage':26}{'in turn':>10}{'beside':>10}")
    for name, (main_s, beside_s) in stages.items():
        print(f"  {name:26}{main_s:8.2f} s{beside_s:8.2f} s")
    rest_s = whole_s - sum(main_s for main_s, _ in stages.values())
    print(f"  {'the rest':26}{rest_s:8.2f} s\n  {'whole':26}{whole_s:8.2f} s", flush=True)


def show_cold(path: Path) -> None:
    """A run without compiled kernels, and the one after it."""
    with tempfile.TemporaryDirectory() as folder:
        words = ("scanchain", "run", str(path), "--out", f"{folder}/run", "--force")
        cold_s, warm_s = (timed(*words, NUMBA_CACHE_DIR=f"{folder}/kernels")[0] for _ in range(2))
    print(f"  first run {cold_s:.1f} s, second {warm_s:.1f} s: {cold_s - warm_s:.1f} s to compile", flush=True)


def timed(*module_and_words: str, **environment: str) -> tuple[float, str]:
    """How long ``python -m`` takes, and what it prints."""
    started = perf_counter()
    answer = subprocess.run(
        [sys.executable, "-m", *module_and_words],
        cwd=ROOT,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": ""} | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return perf_counter() - started, answer.stdout


def track(path: Path) -> float:
    """The odometry of a log and nothing else; seconds spent in ``track``."""
    log = open_log(path)
    odometry = Odometry(load_settings(log.dimension).config, log.T_base_lidar)
    seconds = 0.0
    for scan in log.scans():
        started = perf_counter()
        odometry.process(scan)
        seconds += perf_counter() - started
    return seconds


def seconds_by_stage(path: Path, began: float) -> dict[str, tuple[float, float]]:
    """A run in this process, which was begun at that time, with a watch over what it consists of."""
    from scanchain import api
    from scanchain.__main__ import main as scanchain
    from scanchain.graph.pose_graph import PoseGraph
    from scanchain.loops import LoopCloser
    from scanchain.point_store import PointStore
    from scanchain.runs import processing, results, run
    from scanchain.runs.resume.journal import Journal
    from scanchain.runs.step_table import StepTable

    watch = Stopwatch()
    watch.add("start and imports", time() - began)
    watch.over("opening the log", run, "open_log")
    watch.over("odometry", Odometry, "process")
    watch.over("loops", LoopCloser, "close", "finish")
    watch.over("optimizing", PoseGraph, "optimize")
    watch.over("points kept", PointStore, "add", "read")
    watch.over("journal", Journal, "append")
    watch.over("map", results, "build_point_map", "write_ply", "draw_grid", "write_map")
    watch.over("what moved", results, "moved")
    watch.over("other results", processing, "write_results", "record_results")
    watch.over("other results", StepTable, "write")
    watch.over("other results", run, "accuracy_of", "measure")
    watch.over("report", run, "_report")
    open_recording = api.open_recorder

    def record(*arguments: Any, **options: Any) -> Any:
        recording = open_recording(*arguments, **options)
        watch.over("recording", type(recording), "__enter__", "close", "log", "log_trajectory", "log_map")
        watch.over("recording", sys.modules["scanchain_viz.recording.messages"].Message, "send")
        return recording

    api.open_recorder = watch.timed("recording", record)
    with tempfile.TemporaryDirectory() as folder:
        assert scanchain(["run", str(path), "--out", f"{folder}/run", "--json"]) == 0
    return watch.seconds


if __name__ == "__main__":
    main()
