"""How much longer a whole run takes than its odometry alone, and where its time goes.

*run* is ``scanchain run LOG --out DIR``: loops on, recording, map and report written. *odometry* is a process
that reads the same log and tracks its scans with the same configuration, and nothing else. Both are taken by the
clock, from the start of the interpreter to its end, with compiled kernels. *tracking* is the sum over the scans
of ``Odometry.track`` in that process: without interpreter, imports and reading. Each is the least of several
repeats, which take turns, with Python's bytecode on disk as after any installation. With ``--cold`` one more run
compiles all kernels.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.settings import load_settings
from tests.benchmarks.harness import KITTI, options_of
from tests.support.scenes import DATA, ROOT


def main() -> None:
    logs = [DATA / "3d" / name for name in KITTI]
    arguments = options_of(__doc__, "logs", cache=False, logs=logs, repeats=5, cold=False, track=False)
    if arguments.track:
        print(track(arguments.logs[0]))
    else:
        for path in arguments.logs:
            show(path.resolve(), arguments.repeats, cold=arguments.cold)


def show(path: Path, repeats: int, *, cold: bool) -> None:
    """Measure one log and print what it took; cold: also a run without compiled kernels, and the one after it."""
    runs, alone, tracking = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        words = ("scanchain", "run", str(path), "--out", f"{folder}/run", "--force")
        for _ in range(repeats + 1):
            runs.append(timed(*words)[0])
            seconds, answer = timed("tests.benchmarks.whole_run", str(path), "--track")
            alone.append(seconds)
            tracking.append(float(answer))
        spent_s = [timed(*words, NUMBA_CACHE_DIR=f"{folder}/kernels")[0] for _ in range(2 if cold else 0)]
    run_s, alone_s, tracking_s = (min(each[1:]) for each in (runs, alone, tracking))  # the first may compile
    print(f"\n{path.name}, least of {repeats}")
    print(f"  run {run_s:.2f} s, odometry {alone_s:.2f} s, tracking {tracking_s:.2f} s")
    print(f"  run / odometry {run_s / alone_s:.2f}, run / tracking {run_s / tracking_s:.2f}", flush=True)
    if cold:
        cold_s, warm_s = spent_s
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


if __name__ == "__main__":
    main()
