"""3D odometry over worlds and sensors: who is how accurate, who gets lost, and where ours stands.

    python -m tests.benchmarks.odometry3d_set [--worlds town,...] [--sensors vlp-16,...] [--scans N] [--cache DIR]

Every world of scanchain.simulation that is driven with a 3D lidar, with every 3D sensor, is simulated into a cache
folder unless it lies there already; the cache is named after the simulator's source, so that worlds which changed
are made anew. Every log has a process of its own.

A cell is the KITTI translation error in % over stretches of 10, 20 and 40 m, and the ATE in meters. Where the path
is shorter than 20 m the first number is the ATE over the length of the path, marked *. LOST: the last pose, seen
from the first, is off by more than 5 % of the path or 2 m, whichever is larger, or there is none.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import scanchain
from scanchain import lie
from scanchain.data import Trajectory
from scanchain.evaluation import SHORT_LENGTHS_M, Pairs, absolute_error, kitti_error, pair
from scanchain.simulation import SENSORS, WORLDS, simulate
from tests.benchmarks.contest import OURS, Run, default_methods, in_fresh_process, read, run_all

INDOORS = frozenset({"corridor", "staircase", "hall"})  # where others' settings for indoors are taken
SHORT_PATH_M, LOST_SHARE, LOST_M = 20.0, 0.05, 2.0
SEED = 1
LIDARS = [name for name, sensor in SENSORS.items() if sensor.dimension == 3]
PLACES = [name for name, world in WORLDS.items() if world.sensor in LIDARS]
CACHE = Path(tempfile.gettempdir()) / "scanchain_odometry3d"


@dataclass(frozen=True, slots=True)
class Score:
    """How good a method was on a sequence; infinite where it was lost for want of a pose."""

    translation_percent: float
    is_of_path: bool
    ate_m: float
    final_m: float
    is_lost: bool
    median_s: float

    def __str__(self) -> str:
        star = "*" if self.is_of_path else ""
        return f"{self.translation_percent:.3f}{star} {self.ate_m:.3f}m{' LOST' if self.is_lost else ''}"


def log_of(world: str, sensor: str, scans: int, cache: Path, seed: int = SEED) -> Path:
    """The simulated log, made if it is not there yet."""
    place, period_s = WORLDS[world], SENSORS[sensor].period_ns * 1e-9
    duration_s = min(place.duration_s, scans * period_s)
    folder = cache / simulator_version()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{world}_{sensor}_{duration_s:g}s{'' if seed == SEED else f'_seed{seed}'}.mcap"
    if not path.exists():
        draft = path.with_suffix(".draft.mcap")
        simulate(world, draft, seed=seed, duration_s=duration_s, sensor=sensor, force=True)
        draft.with_suffix(".tum").unlink()  # the log has the truth
        draft.rename(path)
    return path


def scores(path: Path, methods: tuple[str, ...]) -> list[Score]:
    """One score a method."""
    recording = read(path, 10**9)
    if recording.ground_truth is None:
        raise ValueError(f"{path} has no ground truth")
    return [score(run, recording.ground_truth) for run in run_all(recording, methods)]


def score(run: Run, ground_truth: Trajectory) -> Score:
    """Errors of a run against the truth."""
    median_s = float(np.median(run.seconds[1:]))
    if not run.is_whole:
        return Score(np.inf, False, np.inf, np.inf, True, median_s)
    pairs = pair(run.trajectory, ground_truth)
    absolute = absolute_error(pairs)
    final_m = _final_error_m(pairs)
    is_short = absolute.path_length_m < SHORT_PATH_M
    return Score(
        100.0 * (absolute.share_of_path if is_short else _drift(pairs)),
        is_short,
        absolute.translation_m.rmse,
        final_m,
        final_m > max(LOST_SHARE * absolute.path_length_m, LOST_M),
        median_s,
    )


def _drift(pairs: Pairs) -> float:
    return kitti_error(pairs, SHORT_LENGTHS_M, every=1).translation_share


def _final_error_m(pairs: Pairs) -> float:
    """Distance between the last positions, both seen from the first pose."""
    estimate = lie.inverse(pairs.estimate[0]) @ pairs.estimate[-1]
    reference = lie.inverse(pairs.reference[0]) @ pairs.reference[-1]
    return float(np.linalg.norm(estimate[:3, 3] - reference[:3, 3]))


def rank(row: Sequence[Score], first_rival: int, place: int) -> int:
    """Place of one of ours among itself and the rivals, 1 is best; the lost stand behind all others."""
    own = (row[place].is_lost, row[place].translation_percent)
    return 1 + sum((rival.is_lost, rival.translation_percent) < own for rival in row[first_rival:])


def summary(rows: dict[str, list[Score]], methods: Sequence[str]) -> None:
    """Means, ranks and losses, and what the issue asks for."""
    table = list(rows.values())
    percent = np.array([[score.translation_percent for score in row] for row in table])
    held = percent[[not any(score.is_lost for score in row) for row in table]]
    for head, values in (
        ("mean", [f"{value:.3f}" for value in percent.mean(axis=0)]),
        ("median", [f"{value:.3f}" for value in np.median(percent, axis=0)]),
        (f"mean of {len(held)} all hold", [f"{value:.3f}" for value in held.mean(axis=0)] if len(held) else []),
        ("lost", [str(sum(row[m].is_lost for row in table)) for m in range(len(methods))]),
        ("ms a scan", [f"{1e3 * np.median([row[m].median_s for row in table]):.1f}" for m in range(len(methods))]),
    ):
        print(f"{head:22}" + "".join(f"{value:>21}" for value in values))
    first_rival = sum(name in OURS for name in methods)
    for place, name in enumerate(methods[:first_rival]):
        ranks = np.array([rank(row, first_rival, place) for row in table])
        alone = [case for case, row in rows.items() if _is_lost_alone(row, first_rival, place)]
        print(
            f"{name}: first on {np.sum(ranks == 1)}, first or second on {np.sum(ranks <= 2)} of {len(ranks)} "
            f"({100.0 * np.mean(ranks <= 2):.0f} %); lost where another holds: {', '.join(alone) or 'never'}"
        )


def _is_lost_alone(row: Sequence[Score], first_rival: int, place: int) -> bool:
    return row[place].is_lost and not all(rival.is_lost for rival in row[first_rival:])


def simulator_version() -> str:
    """A name for the simulator as it is now."""
    root = Path(scanchain.__file__).parent
    sources = sorted([*root.glob("simulation/**/*.py"), *root.glob("kernels/raycast/*.py")])
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:8]


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """A command line that chooses among the simulated sequences."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default=",".join(PLACES), help="default: %(default)s")
    parser.add_argument("--sensors", default=",".join(LIDARS), help="default: %(default)s")
    parser.add_argument("--scans", type=int, default=300, help="at most, default: %(default)s")
    parser.add_argument("--cache", type=Path, default=CACHE)
    return parser


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--methods", help="ours first; genz-icp stands for its settings for the place")
    arguments = parser.parse_args()
    chosen = arguments.methods.split(",") if arguments.methods else default_methods(Path("log"), indoor=False)
    methods = sorted(chosen, key=lambda name: name not in OURS)
    print(f"{'sequence':22}" + "".join(f"{name:>21}" for name in methods) + f"{'rank':>6}", flush=True)
    rows: dict[str, list[Score]] = {}
    for world in arguments.worlds.split(","):
        settings = {"genz-icp": "genz-icp-indoor"} if world in INDOORS else {}
        for sensor in arguments.sensors.split(","):
            path = log_of(world, sensor, arguments.scans, arguments.cache)
            try:
                row = in_fresh_process(scores, path, tuple(settings.get(name, name) for name in methods))
            except BrokenProcessPool:
                print(f"{world} {sensor}: a method broke the process; try them one by one with --methods")
                continue
            rows[f"{world} {sensor}"] = row
            place = rank(row, sum(name in OURS for name in methods), 0)
            print(
                f"{world + ' ' + sensor:22}" + "".join(f"{cell!s:>21}" for cell in row) + f"{place:6}", flush=True
            )
    summary(rows, methods)


if __name__ == "__main__":
    main()
