"""This program against another commit of it: time, memory and poses, in turn on the same logs.

Both are built into environments of their own, with the packages that they ask for, below --cache: in one for
development memory is 6 % larger, and a stage up to 8 % slower. Per log the two take turns, --repeats times,
each in a fresh process with compiled kernels; of every scan, kernel and run the least counts. A figure is this
program's over that one's, below 1 where it got better:

  scan, p95  CPU time of ``Odometry.process`` a scan: median, and 95th percentile
  wall       its sum by the clock
  prepare, match, map   medians of the stages, by the clock
  align, downsample, insert   CPU time of the last match once more, of its raw points, of a map of the last scans
  run        CPU time of ``scanchain run LOG``, with recording, loops, report and error bars
  by clock, peak   the same by the clock, and its memory
  bits       whether all poses of odometry are equal to the last bit

With --cold one more row for each dimension: the first run after an installation, which compiles the kernels.
KEY=VALUE among the --logs sets a key of the configuration for both.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from time import perf_counter
from typing import Any

import numpy as np

from tests.benchmarks.harness import options_of, table
from tests.support.scenes import DATA, ROOT

WORKER = Path(__file__).with_name("against_worker.py")
LOGS = ("2d/intel.mcap", "2d/mit_csail.mcap", "3d/kitti_0005_first60.mcap", "3d/kitti_0001_first54.mcap")
HEADS = ("scan", "p95", "wall", "prepare", "match", "map", "align", "downsample", "insert")


@dataclass(frozen=True)
class Program:
    """A scanchain: its interpreter, and where its compiled kernels lie."""

    python: Path
    kernels: Path

    def spent(self, *words: str, kernels: Path | None = None) -> tuple[float, float, float]:
        """CPU seconds, seconds of the clock and largest memory in MiB of ``python WORDS``."""
        own = {"PYTHONPATH": "", "PYTHONDONTWRITEBYTECODE": ""}
        own["NUMBA_CACHE_DIR"] = str(kernels or self.kernels)
        command, began = [str(self.python), *words], perf_counter()
        with TemporaryFile("w+") as said:
            process = subprocess.Popen(command, env=os.environ | own, cwd="/", stdout=said, stderr=said)
            _, status, usage = os.wait4(process.pid, 0)
            said.seek(0)
            text = said.read().lower()
            if os.waitstatus_to_exitcode(status) not in (0, 1) or "error:" in text:
                sys.exit(f"{' '.join(command)}\n{text}")  # 1: not trustworthy
        return usage.ru_utime + usage.ru_stime, perf_counter() - began, usage.ru_maxrss / 1024

    def tracked(self, log: Path, folder: str, words: Sequence[str]) -> dict[str, Any]:
        """What the worker measures on a log."""
        out = f"{folder}/tracked.npz"
        self.spent(str(WORKER), str(log), out, *words)
        with np.load(out) as measured:
            return dict(measured)

    def run(
        self, log: Path, folder: str, words: Sequence[str] = (), kernels: Path | None = None
    ) -> tuple[float, float, float]:
        """What a whole run takes, as ``spent``."""
        options = [part for word in words for part in ("--" + word).split("=", 1)]
        command = ("-m", "scanchain", "run", str(log), "--out", f"{folder}/run", "--force")
        return self.spent(*command, *options, kernels=kernels)


def main() -> None:
    logs = [str(DATA / name) for name in LOGS]
    arguments = options_of(__doc__, "commit", commit=str, logs=logs, repeats=3, cold=False)
    words = [each for each in arguments.logs if "=" in each]
    then = built(arguments.commit, arguments.cache)
    now = installed(ROOT, arguments.cache / "against/now")
    show = table("log", "scans", *HEADS, "run", "by clock", "peak", "bits")
    for log in (Path(each).resolve() for each in arguments.logs if "=" not in each):
        ratios, runs, count, is_equal = compared(now, then, log, words, arguments.repeats)
        show(log.stem, count, *(f"{each:.2f}" for each in (*ratios, *runs)), "equal" if is_equal else "differ")
    if arguments.cold:
        show_cold(now, then)


def built(commit: str, cache: Path) -> Program:
    """The commit in an environment of its own, made once."""
    sha = subprocess.check_output(["git", "rev-parse", "--short=12", commit], cwd=ROOT, text=True).strip()
    home = cache / "against" / sha
    if (home / "installed").exists():
        return Program(home / "venv/bin/python", home / "kernels")
    source = home / "source"
    source.mkdir(parents=True, exist_ok=True)
    archive = subprocess.run(["git", "archive", sha], cwd=ROOT, check=True, capture_output=True).stdout
    subprocess.run(["tar", "-x"], cwd=source, check=True, input=archive)
    program = installed(source, home)
    (home / "installed").touch()
    return program


def installed(source: Path, home: Path) -> Program:
    """The sources as they are now in an environment of their own."""
    uv, python = str(Path(sys.executable).with_name("uv")), home / "venv/bin/python"
    subprocess.run([uv, "venv", "-q", "--clear", "--python", sys.executable, home / "venv"], check=True)
    of_sources = ["--refresh-package", "scanchain", "--python", python, source]
    subprocess.run([uv, "pip", "install", "-q", *of_sources], check=True)
    return Program(python, home / "kernels")


def compared(
    now: Program, then: Program, log: Path, words: Sequence[str], repeats: int
) -> tuple[Any, Any, int, bool]:
    """Ratios of odometry and of whole runs, the number of scans, and whether poses are equal."""
    tracked: list[list[dict[str, Any]]] = [[], []]
    runs: list[list[tuple[float, float, float]]] = [[], []]
    with TemporaryDirectory() as folder:
        for program in (now, then):
            program.run(log, folder, words)  # compiles
        for _ in range(repeats):
            for which, program in enumerate((now, then)):
                tracked[which].append(program.tracked(log, folder, words))
                runs[which].append(program.run(log, folder, words))
    new, old = (figures(each) for each in tracked)
    new_poses, old_poses = (each[0]["poses"] for each in tracked)
    is_equal = np.array_equal(new_poses, old_poses)
    return new / old, np.divide(*(np.min(each, axis=0) for each in runs)), len(new_poses), is_equal


def figures(repeats: Sequence[dict[str, Any]]) -> np.ndarray:
    """What workers measured, in the order of HEADS."""
    cpu_s, wall_s, stages_s, kernels_s = (
        np.min([each[name] for each in repeats], axis=0) for name in ("cpu_s", "wall_s", "stages_s", "kernels_s")
    )
    warm = slice(3, None)
    scan = (np.median(cpu_s[warm]), np.percentile(cpu_s[warm], 95), wall_s[warm].sum())
    return np.array([*scan, *np.median(stages_s[warm], axis=0), *kernels_s])


def show_cold(now: Program, then: Program) -> None:
    """First and second runs of each, in the plane and in space."""
    show = table("first run of", "this: clock", "CPU", "that: clock", "CPU")
    for log in (DATA / LOGS[0], DATA / LOGS[2]):
        cells = []
        for program in (now, then):
            with TemporaryDirectory() as folder:
                first, second = (program.run(log, folder, kernels=Path(folder, "kernels")) for _ in range(2))
                cells += [f"{first[1] - second[1]:.1f} s", f"{first[0] - second[0]:.1f} s"]
        show(log.stem, *cells)


if __name__ == "__main__":
    main()
