"""Logs that begin outside of a map and enter it later: ``python -m tests.benchmarks.late_entry``.

    [--kind 2d 3d] [--cases NAME ...] [--cache DIR] [--seed N] [--set KEY=VALUE ...]

A map is made of a part of a drive, and another part is localized in it that begins elsewhere. A scan is inside
where its true position lies within 5 m (in space 10 m) of a keyframe of the map. Prints, for each case: path
outside before it enters, and inside; path inside until it is found (negative: before it entered), the largest
error of the poses that were given inside at their time, from the third on, and the verdict.

Truth of a simulated world is the simulator's; of a real log it is the trajectory of the whole log, with its loops.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time

import numpy as np
from scipy.spatial import KDTree

import scanchain as sc
from scanchain import lie
from scanchain.data import Matrix, Trajectory
from scanchain.maps import SavedMap, open_saved_map
from scanchain.trajectory import read_tum
from tests.benchmarks.foreign import CACHE, log_of

INSIDE_M = {2: 5.0, 3: 10.0}
WRONG_M = {2: 1.0, 3: 2.0}  # error from which on a pose is wrong


@dataclass(frozen=True, slots=True)
class Case:
    """A drive, real or simulated, and its parts in seconds or in meters along the route."""

    log: str
    mapped: tuple[float, float]  # real: begin and end in s; simulated: begin in m and duration in s
    entering: tuple[float, float]
    options: dict[str, object] = field(default_factory=dict)


def _planar(world: str, mapped: tuple[float, float], entering: tuple[float, float], **options: object) -> Case:
    return Case(world, mapped, entering, {"sensor": "lms-270", **options})


def _space(world: str, mapped: tuple[float, float], entering: tuple[float, float], **options: object) -> Case:
    return Case(world, mapped, entering, {"sensor": "vlp-16", **options})


CASES = {
    "csail-204": Case("csail", (18.0, 71.0), (124.0, 424.0)),
    "csail-149": Case("csail", (53.0, 124.0), (159.0, 424.0)),
    "csail-76": Case("csail", (194.0, 300.0), (53.0, 194.0)),
    "aces-140": Case("aces", (1081.0, 1252.0), (0.0, 1081.0)),
    "aces-113": Case("aces", (0.0, 228.0), (284.0, 1366.0)),
    "intel-170": Case("intel", (785.0, 1121.0), (1234.0, 2691.0)),
    "intel-114": Case("intel", (673.0, 1121.0), (1234.0, 2691.0)),
    "intel-76": Case("intel", (2355.0, 2691.0), (897.0, 2355.0)),
    "office": Case("office", (60.0, 60.0), (0.0, 100.0)),
    "streets": _planar("town", (190.0, 10.0), (280.0, 45.0)),
    "streets-changed": _planar("town", (90.0, 10.0), (180.0, 45.0)),
    "town": _space("town", (190.0, 10.0), (280.0, 45.0)),
    "town-changed": _space("town", (90.0, 10.0), (180.0, 45.0)),
    "forest": _space("forest", (100.0, 20.0), (0.0, 60.0)),
    "highway": _space("highway", (300.0, 10.0), (0.0, 25.0)),
}
REAL = ("csail", "aces", "intel")


def kind_of(case: Case) -> int:
    """Dimension."""
    return 3 if case.options.get("sensor") == "vlp-16" else 2


def _simulated(
    name: str, which: str, options: dict[str, object], seed: int, cache: Path
) -> tuple[Path, Trajectory]:
    """A drive, and its truth."""
    log = cache / f"late_{name}_{which}_{seed}.mcap"
    if not log.exists():
        sc.simulate(CASES[name].log, log, seed=seed, force=True, **options)
    return log, read_tum(log.with_suffix(".tum"))


def prepared(name: str, seed: int, cache: Path) -> tuple[Path, Path, dict[str, object], Trajectory, Trajectory]:
    """Map, log, options of the log, and the truth of both."""
    case = CASES[name]
    out = cache / f"late_{name}_{seed}.run"
    (map_begin, map_end), (begin, end) = case.mapped, case.entering
    if case.log in REAL:
        log, whole = log_of(case.log, seed, cache, again=False), cache / f"{case.log}_whole.run"
        if not whole.exists():
            sc.run(log, whole, recording=False)
        truth = read_tum(whole / "trajectory.tum")
        if not out.exists():
            sc.run(log, out, recording=False, log__start_s=map_begin, log__end_s=map_end)
        return out, log, {"log__start_s": begin, "log__end_s": end}, truth, truth
    mapped, map_truth = _simulated(
        name, "map", {**case.options, "start_m": map_begin, "duration_s": map_end}, seed, cache
    )
    later: dict[str, object] = {"start_m": begin, "duration_s": end}
    if "changed" in name:
        later["changed"] = 1
    log, truth = _simulated(name, "log", {**case.options, **later}, seed, cache)
    if not out.exists():
        sc.run(mapped, out, recording=False)
    return out, log, {}, map_truth, truth


def at(trajectory: Trajectory, stamps_ns: Matrix) -> Matrix:
    """Poses nearest in time."""
    order = np.argsort(trajectory.stamps_ns, kind="stable")
    stamps = trajectory.stamps_ns[order]
    after = np.clip(np.searchsorted(stamps, stamps_ns), 1, len(stamps) - 1)
    nearer = after - (stamps_ns - stamps[after - 1] < stamps[after] - stamps_ns)
    return trajectory.poses[order[nearer]]


def true_in_map(prior: SavedMap, map_truth: Trajectory, poses: Matrix) -> tuple[Matrix, Matrix]:
    """True poses (N, 4, 4) in the frame of the map, as it lies around them, and distances from it (N,)."""
    true = at(map_truth, np.array([each.stamp_ns for each in prior.keyframes]))
    away_m, nearest = KDTree(true[:, :-1, -1]).query(poses[:, :-1, -1])
    return lie.lift(prior.poses[nearest]) @ lie.inverse(true[nearest]) @ poses, away_m


def rows(name: str, seed: int, cache: Path, settings: dict[str, object]) -> Iterator[str]:
    """The row of a case."""
    case = CASES[name]
    out, log, options, map_truth, truth = prepared(name, seed, cache)
    prior = open_saved_map(out)
    began_s = process_time()
    with tempfile.TemporaryDirectory() as folder:
        result = sc.localize(log, prior.folder, Path(folder) / "out", recording=False, **options, **settings)
        found, metrics = result.localization, result.metrics
    spent_s = process_time() - began_s
    d = kind_of(case)
    expected, away_m = true_in_map(prior, map_truth, at(truth, found.trajectory.stamps_ns))
    inside = away_m < INSIDE_M[d]
    path_m = found.traveled_m
    entry = int(inside.argmax())
    steps_m = np.diff(path_m, prepend=path_m[0]) * inside
    inside_m = np.cumsum(steps_m)
    first = found.found_at
    error_m = np.linalg.norm((lie.lift(found.live) - expected)[:, :-1, -1], axis=1)
    known = np.flatnonzero(inside & np.isfinite(error_m))
    wrong = int((error_m[known] > WRONG_M[d]).sum())
    final_m = np.linalg.norm((lie.lift(found.trajectory.poses) - expected)[:, :-1, -1], axis=1)[
        inside & found.is_placed
    ]
    chosen = inside & found.is_placed
    nees = [
        float(np.mean((errors_m / sigma_m) ** 2)) / d if len(errors_m) else np.nan
        for errors_m, sigma_m in ((error_m[known], found.sigma_m[known]), (final_m, found.final_sigma_m[chosen]))
    ]
    error = f"{np.median(final_m):.3f}" if len(final_m) else "none"
    early_m = path_m[entry] - path_m[first] if first < entry else 0.0
    state = "never" if first < 0 else f"{inside_m[first] - early_m:.1f}"
    yield (
        f"| {name} | {path_m[entry]:.0f} | {inside_m[-1]:.0f} | {state} | {wrong} of {len(known)} | {error} | "
        f"{metrics.median_sigma_m:.3f}, {metrics.median_final_sigma_m:.3f} | {nees[0]:.2f}, {nees[1]:.2f} | "
        f"{spent_s:.0f} | {metrics.sentence.split(':')[0]} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", nargs="+", choices=("2d", "3d"), default=["2d", "3d"])
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--seed", type=int, default=0, help="of the worlds")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    pairs = (each.partition("=") for each in options.set)
    settings: dict[str, object] = {key.replace(".", "__"): value for key, _, value in pairs}
    print(
        "| log | outside | inside | found after | wrong poses | error | σ then, final | NEES | CPU s | verdict |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in options.cases:
        if f"{kind_of(CASES[name])}d" in options.kind:
            for row in rows(name, options.seed, options.cache, settings):
                print(row, flush=True)


if __name__ == "__main__":
    main()
