"""3D odometry, ours against others, on the same decoded scans, scan by scan in turn.

    python -m tests.benchmarks.odometry3d [LOG ...] [--methods plicp,kiss-icp,...] [--scans N] [--indoor] [--quick]

LOG is any MCAP with a 3D lidar. Its scans are decoded once into memory. Each method first gets the first few
scans on a throwaway instance, so that compilation and imports are done; then every scan goes through all methods
in turn, starting with another one each time, so that whatever else the machine does meets all of them alike. The
time is that of ``track`` alone, the first scan left out. Poses hold at the scan's stamp; where a method's own hold
elsewhere in the sweep, its wrapper moves them. Every log has a process of its own, and so has every method for its
memory (the scans held here would drown it). --indoor takes the settings that others recommend for indoors where
they have some; --quick leaves memory and sharpness out.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import (
    SHORT_LENGTHS_M,
    Sharpness,
    absolute_error,
    kitti_error,
    pair,
    relative_error_over_frames,
    sampled_map,
    sampling_step,
    sharpness,
)
from tests.benchmarks.contest import OURS, Recording, Run, default_methods, in_fresh_process, read, run_all
from tests.benchmarks.peak_memory import PeakMemory, measure

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("SCANCHAIN_DATA", ROOT.parent / "shared" / "data")) / "3d"
DEFAULT_LOGS = ("kitti_0005_first60.mcap", "kitti_0001_first54.mcap")
LEGEND = """\
  x: over the same of the first row of ours; CPU ms: median, all threads together
  peak: resident memory of a process that reads the log and runs this method only; growth: of it, after one scan
  ATE: rmse after rigid alignment; RPE: rmse from scan to scan; KITTI: mean over all stretches of 10, 20 and 40 m
  entropy, planes: mean map entropy and plane thickness, lower is sharper (scanchain.evaluation.map_sharpness)
  to KISS: median distance between the motion of a scan and that which KISS-ICP finds"""


@dataclass(frozen=True, slots=True)
class Column:
    """How a number is shown, and whether its ratio to ours says anything."""

    head: str
    digits: int
    has_ratio: bool = True

    @property
    def width(self) -> int:
        return max(len(self.head), 14 if self.has_ratio else 7) + 2

    def show(self, value: float, base: float) -> str:
        if not np.isfinite(value):
            return f"{'-':>{self.width}}"
        ratio = f" x{value / base:.2f}" if self.has_ratio and base > 0.0 else ""
        return f"{f'{value:.{self.digits}f}{ratio}':>{self.width}}"


COLUMNS = (
    *(
        Column("median ms", 2),
        Column("p95 ms", 1, False),
        Column("CPU ms", 2),
        Column("peak MiB", 0),
        Column("growth MiB", 1, False),
    ),
    *(Column("ATE m", 4), Column("RPE mm", 1), Column("KITTI %", 3), Column("KITTI deg/m", 4)),
    *(Column("entropy nats", 4, False), Column("planes mm", 2), Column("to KISS mm", 1, False)),
)


def run_log(path: Path, methods: tuple[str, ...], scans: int, quick: bool) -> None:
    """Race, measure, print."""
    recording = read(path, scans)
    runs = run_all(recording, methods)
    whole = [run for run in runs if run.is_whole]
    sharp: dict[str, Sharpness | None] = {}
    memory: dict[str, PeakMemory | None] = {}
    if not quick:
        step = sampling_step(sum(len(scan.points) for scan in recording.scans))
        answers = sharpness([sampled_map(recording.scans, run.trajectory, step) for run in whole])
        sharp = {run.name: answer for run, answer in zip(whole, answers, strict=True)}
        memory = {run.name: measure(path, run.name, len(recording.scans)) for run in runs}
    report(path, recording, runs, sharp, memory)


def report(
    path: Path,
    recording: Recording,
    runs: list[Run],
    sharp: dict[str, Sharpness | None],
    memory: dict[str, PeakMemory | None],
) -> None:
    """One line a method, then what each one did."""
    points = np.mean([len(scan.points) for scan in recording.scans])
    timed = "with" if len(recording.scans[0].times_s) else "without"
    print(f"\n{path.name}: {len(recording.scans)} scans of {points:.0f} points, {timed} times")
    print(f"{os.cpu_count()} cores, load average of the last minute {os.getloadavg()[0]:.1f}; quiet is below 2")
    print(f"{'method':17}" + "".join(f"{column.head:>{column.width}}" for column in COLUMNS))
    kiss = next((run for run in runs if run.name == "kiss-icp" and run.is_whole), None)
    rows = {
        run.name: (
            *(1e3 * np.median(run.seconds[1:]), 1e3 * np.percentile(run.seconds[1:], 95)),
            1e3 * np.median(run.cpu_seconds[1:]),
            *_memory(memory.get(run.name)),
            *accuracy(run, recording.ground_truth),
            *_sharpness(sharp.get(run.name)),
            apart_mm(run, kiss),
        )
        for run in runs
    }
    base = rows[next((run.name for run in runs if run.name in OURS), runs[0].name)]
    for name, row in rows.items():
        print(f"{name:17}" + "".join(c.show(v, b) for c, v, b in zip(COLUMNS, row, base, strict=True)))
    print(LEGEND)
    for run in runs:
        print(f"  {run.name}: {run.description}{'; FAILED at ' + run.failure if run.failure else ''}", flush=True)


def accuracy(run: Run, ground_truth: Trajectory | None) -> tuple[float, float, float, float]:
    """ATE in meters, RPE in mm, KITTI in % and deg/m; NaN where there is no ground truth or too short a path."""
    if ground_truth is None or not run.is_whole:
        return np.nan, np.nan, np.nan, np.nan
    pairs = pair(run.trajectory, ground_truth)
    ate_m = absolute_error(pairs).translation_m.rmse
    rpe_mm = 1e3 * relative_error_over_frames(pairs).translation_m.rmse
    try:
        drift = kitti_error(pairs, SHORT_LENGTHS_M, every=1)
    except InputError:
        return ate_m, rpe_mm, np.nan, np.nan
    return ate_m, rpe_mm, 100.0 * drift.translation_share, float(np.degrees(drift.rotation_rad_per_m))


def apart_mm(run: Run, other: Run | None) -> float:
    """Median over the scans of the distance between two methods' motions; NaN without one of them."""
    if other is None or not run.is_whole:
        return np.nan
    first, second = (lie.inverse(r.trajectory.poses[:-1]) @ r.trajectory.poses[1:] for r in (run, other))
    return 1e3 * float(np.median(np.linalg.norm((lie.inverse(first) @ second)[:, :3, 3], axis=1)))


def _memory(memory: PeakMemory | None) -> tuple[float, float]:
    return (memory.peak_mib, memory.growth_mib) if memory else (np.nan, np.nan)


def _sharpness(sharp: Sharpness | None) -> tuple[float, float]:
    return (sharp.mean_map_entropy, 1e3 * sharp.thickness_m) if sharp else (np.nan, np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path, default=[DATA / name for name in DEFAULT_LOGS])
    parser.add_argument(
        "--methods", help="ours are plicp and svd; one that is unknown is answered with all others"
    )
    parser.add_argument("--scans", type=int, default=10**9)
    parser.add_argument("--indoor", action="store_true")
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for path in arguments.logs:
        methods = (
            arguments.methods.split(",") if arguments.methods else default_methods(path, indoor=arguments.indoor)
        )
        in_fresh_process(run_log, path, tuple(methods), arguments.scans, arguments.quick)


if __name__ == "__main__":
    main()
