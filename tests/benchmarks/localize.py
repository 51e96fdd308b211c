"""Localization in a map from nowhere: how soon, how surely, how accurately, and what it costs.

From each start a log begins anew, in the map of another drive or of an earlier part of its own, and is processed
until it is found and 3 m farther, or until it has traveled 15 m (in space 40 m, in the city 60 m). Logs of other
places are run whole by ``tests.benchmarks.places``. Starts are evenly spread; those of planar logs over places
that the map has seen: of the scans of the next 5 m 60 % of the points lie on its points.

  found     travel until the state is no longer ``searching``
  wrong     a pose from there on is more than 0.5 m or 5° off the reference, in space 1 m or 3°
  error     median over the scans after that. The reference is the truth of a simulated log, of a real one SLAM
            over all of it; seen from the map's nearest keyframe, which leaves out the map's own error
  time      CPU time a scan, over that of odometry alone on the same scans; longest of one without the first three
  whole     the log from its first scan to its last: ATE of all scans, and of the poses known at the time; time
            over that of odometry, after the first quarter; time to open the map; growth of the resident memory

"vlp-16", "os1-32", "changed": a town mapped with an HDL-64, on another day, with other parked cars, driven the
other way round with that lidar. "rounds" and "woods" likewise; "forest": a forest in the map of the town.
"city": a town with so many kilometers of streets, of which every so many sweeps are recorded. --live: in slices,
so that no scan waits. --memory: the peak of ``run`` and ``localize`` with all they write, each a process of its
own.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from time import perf_counter, thread_time

import numpy as np
import psutil
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Matrix, Scan
from scanchain.evaluation import path_length
from scanchain.logs import open_log
from scanchain.maps import SavedMap, open_saved_map
from scanchain.odometry import Odometry
from scanchain.processes import Limits, run_within
from scanchain.sessions.localizer import Localizer
from scanchain.settings import load_settings
from scanchain.simulation.drive import plan
from scanchain.simulation.worlds import WORLDS, outdoor
from scanchain.trajectory import read_tum
from tests.benchmarks.harness import in_fresh_process, options_of, recorded, table, true_in_map
from tests.support import made
from tests.support.scenes import DATA

SEEN_M, SEEN_SHARE, ON_MAP_M = 5.0, 0.6, 0.2
GIVE_UP_M, AFTER_M, WARM_UP = {2: 15.0, 3: 40.0}, 3.0, 3
WRONG = {2: (0.5, np.radians(5.0)), 3: (1.0, np.radians(3.0))}
WITHIN_M = (5.0, 10.0)
STREET_M, BLOCK_M, CITY_SPEED_M_S = 1000.0, (50.0, 40.0), 8.7  # bends included
HEAD = "case", "starts", "within 5 m", "10 m", "ever", "wrong", "error", "time", "longest"
WHOLE = "ATE", "at the time", "time", "opening", "memory"


@dataclass(frozen=True, slots=True)
class Case:
    """A map, a log to localize in it, and its true poses (N, 4, 4) in the map; without any it is of another place.

    ``first`` is the first scan that may be started from.
    """

    prior: SavedMap
    log: Path
    T_map_lidar: Matrix | None
    first: int = 0
    give_up_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """Travel until a log was found, infinite if it was not; errors (M, 2) from there on; CPU seconds of scans."""

    found_m: float
    errors: NDArray[np.float64]
    seconds: list[float]
    odometry_s: float

    def is_wrong(self, dimension: int) -> bool:
        return bool((self.errors > WRONG[dimension]).any())


# ---------------------------------------------------------------- cases


def later_part(name: str, end_s: float, options: argparse.Namespace) -> Case:
    """A log, in the map of its first seconds."""
    log = DATA / "2d" / f"{name}.mcap"
    prior = open_saved_map(made.run_of(log, options.cache, f"{name}_{end_s:g}", log__end_s=end_s))
    whole = read_tum(made.run_of(log, options.cache, name) / "trajectory.tum")
    first = max(keyframe.scan_index for keyframe in prior.keyframes) + 1
    return Case(prior, log, true_in_map(prior, whole, whole.poses)[0], first)


def driven_twice(world: str, options: argparse.Namespace) -> Case:
    """A simulated world, in the map of another drive through it."""
    drives = plan(world, seed=0), plan(world, seed=1)
    logs = [recorded(f"{world}_{k}", replace(drives[k], solids=drives[0].solids), options.cache) for k in (0, 1)]
    return _mapped(options, *logs)


def another_day(map_world: str, log_world: str, options: argparse.Namespace, **of_log: object) -> Case:
    """A drive in the map that another one made with an HDL-64."""
    drive = {"folder": options.cache, "seed": 1, "seconds": of_log.pop("seconds", 66.0)}
    mapped = made.log(map_world, **drive)
    again = made.log(log_world, **{"reverse": True, "start_m": 130.0, "sensor": "hdl-64", **of_log}, **drive)
    case = _mapped(options, mapped, again)
    return case if map_world == log_world else replace(case, T_map_lidar=None)


def city(options: argparse.Namespace) -> Case:
    """Streets that run east, a kilometer each, driven from end to end one after the other; then back."""
    x_m = np.arange(0.0, min(STREET_M, 1e3 * options.km) + 1.0, BLOCK_M[0]).tolist()
    y_m = (np.arange(max(round(1e3 * options.km / STREET_M), 2)) * BLOCK_M[1]).tolist()
    ends = ((x_m[0], x_m[-1]), (x_m[-1], x_m[0]))
    route = np.array([(x, y) for k, y in enumerate(y_m) for x in ends[k % 2]])
    name = f"city-{options.km:g}"
    build = partial(outdoor.town, streets_x_m=x_m, streets_y_m=y_m)
    WORLDS[name] = replace(WORLDS["town"], build=build, route=route)
    logs = []
    for part, of_part in (("map", {}), ("log", {"changed": 1, "reverse": True})):
        duration_s = 1e3 * options.km / CITY_SPEED_M_S
        drive = plan(name, seed=1, sensor=options.sensor, duration_s=duration_s, **of_part)
        drive = replace(drive, scans=drive.scans[:: options.every])
        stem = f"{name}_{part}_{options.sensor}_{options.every}"
        logs.append(recorded(stem, drive, options.cache))
    case = replace(_mapped(options, *logs), give_up_m=60.0)
    if options.memory:
        run, found = (str(options.cache / f"{name}.{command}") for command in ("run", "localize"))
        _print_peak("run", str(logs[0]), "--out", run, "--force")
        _print_peak("localize", str(logs[1]), "--map", run, "--out", found, "--force")
    return case


def _mapped(options: argparse.Namespace, mapped: Path, log: Path) -> Case:
    prior = open_saved_map(made.run_of(mapped, options.cache, mapped.stem))
    truths = open_log(mapped).ground_truth(), open_log(log).ground_truth().poses
    return Case(prior, log, true_in_map(prior, *truths)[0])


def _print_peak(*words: str) -> None:
    """Run a command of scanchain; the peak of its resident memory, its exit code 1 being a verdict."""
    with tempfile.TemporaryDirectory() as folder:
        unlimited, said = Limits(np.inf, np.inf), Path(folder) / "said"
        ended = run_within(unlimited, "scanchain", words, os.environ, output=said)
    assert ended.code in (0, 1), ended
    print(f"{words[0]}: {ended.peak_mib:.0f} MiB at most", flush=True)


CASES: dict[str, Callable[[argparse.Namespace], Case]] = {
    "intel": partial(later_part, "intel", 1400.0),
    "aces": partial(later_part, "aces", 700.0),
    "csail": partial(later_part, "mit_csail", 212.0),
    "office": partial(driven_twice, "office"),
    "identical": partial(driven_twice, "identical"),
    "same": partial(another_day, "town", "town", reverse=False, start_m=0.0),
    "changed": partial(another_day, "town", "town", changed=1),
    "vlp-16": partial(another_day, "town", "town", sensor="vlp-16", changed=2),
    "os1-32": partial(another_day, "town", "town", sensor="os1-32", changed=3, start_m=50.0),
    "rounds": partial(another_day, "rounds", "rounds", changed=4, start_m=300.0, seconds=160.0),
    "forest": partial(another_day, "town", "forest", changed=1),
    "woods": partial(another_day, "forest", "forest", changed=1),
    "city": city,
}


# ---------------------------------------------------------------- starts


def starts_of(case: Case, log_scans: list[Scan], count: int) -> list[int]:
    """Scans from which the log begins."""
    if case.prior.dimension == 3:
        length = len(open_log(case.log).ground_truth())
        return np.linspace(0, int(length * 0.9), count).astype(int).tolist()  # so that there is path left
    surfaces = KDTree(np.vstack([lie.transform(k.T_odom_lidar, k.points[::2]) for k in case.prior.keyframes]))
    poses = lie.flatten(case.T_map_lidar)
    some = np.arange(case.first, len(log_scans), 5)
    share = np.array([
        np.mean(surfaces.query(lie.transform(poses[i], log_scans[i].points[::3].astype(float)))[0] < ON_MAP_M)
        for i in some.tolist()
    ])  # fmt: skip
    path_m = path_length(poses[some])
    ends = np.searchsorted(path_m, path_m + SEEN_M).tolist()
    is_seen = [
        share[k] > SEEN_SHARE and share[k : end + 1].mean() > SEEN_SHARE and path_m[-1] > path_m[k] + GIVE_UP_M[2]
        for k, end in enumerate(ends)
    ]
    seen = some[is_seen]
    return seen[np.linspace(0, len(seen) - 1, min(count, len(seen))).astype(int)].tolist()


def localized(case: Case, scans: Iterable[Scan], *, is_live: bool) -> Outcome:
    """What becomes of the log that begins with these scans."""
    config, T_base_lidar = load_settings(case.prior.dimension).config, open_log(case.log).T_base_lidar
    localizer = Localizer(case.prior, config, T_base_lidar, is_live=is_live)
    odometry = Odometry(config, T_base_lidar)
    give_up_m = case.give_up_m or GIVE_UP_M[case.prior.dimension]
    found_m, odometry_s = np.inf, 0.0
    seconds: list[float] = []
    errors: list[tuple[float, float]] = []
    for number, scan in enumerate(scans):
        begun_s = thread_time()
        placed = localizer.process(replace(scan, index=number))
        between_s = thread_time()
        odometry.process(scan)
        seconds.append(between_s - begun_s)
        odometry_s += thread_time() - between_s
        gone_m = localizer.traveled_m[-1]
        if placed.T_map_lidar is not None:
            found_m = min(found_m, gone_m)
            true = None if case.T_map_lidar is None else case.T_map_lidar[scan.index]
            errors.append((np.inf, np.inf) if true is None else lie.apart(true, lie.lift(placed.T_map_lidar)))
        if gone_m > min(found_m + AFTER_M, give_up_m):
            break
    return Outcome(found_m, np.array(errors).reshape(-1, 2), seconds, odometry_s)


def whole(case: Case, scans: Iterable[Scan]) -> tuple[str, ...]:
    """The whole log in the map, and odometry alone scan by scan beside it: both timed under the same load."""
    config, T_base_lidar = load_settings(case.prior.dimension).config, open_log(case.log).T_base_lidar
    held, started = psutil.Process().memory_info().rss, perf_counter()
    prior = open_saved_map(case.prior.folder)
    localizer = Localizer(prior, config, T_base_lidar, is_live=False)
    opening_s = perf_counter() - started
    odometry = Odometry(config, T_base_lidar)
    seconds = []
    for scan in scans:
        begun_s = thread_time()
        odometry.process(scan)
        between_s = thread_time()
        localizer.process(scan)
        seconds.append((between_s - begun_s, thread_time() - between_s))
    grown_mib = (psutil.Process().memory_info().rss - held) / 2**20
    odometry_s, scan_s = np.mean(seconds[len(seconds) // 4 :], axis=0)
    found = localizer.finish()
    true, known = case.T_map_lidar[:, :3, 3], np.isfinite(found.live[:, 0, 0])
    live_m = _rmse(lie.lift(found.live[known])[:, :3, 3] - true[known])
    ate_m = _rmse(lie.lift(found.trajectory.poses)[:, :3, 3] - true)
    spent = f"{1e3 * scan_s:.0f} ms, {scan_s / odometry_s:.2f}"
    return f"{ate_m:.4f} m", f"{live_m:.4f} m", spent, f"{opening_s:.2f} s", f"{grown_mib:.0f} MiB"


def _rmse(off: Matrix) -> float:
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) if len(off) else np.nan


def row(name: str, options: argparse.Namespace) -> tuple[object, ...]:
    """The cells of one case."""
    case = CASES[name](options)
    d, log = case.prior.dimension, open_log(case.log)
    scans = [] if name == "city" else list(log.scans(load_settings(d).config.preprocess))
    outcomes = []
    for start in starts_of(case, scans, options.starts):
        following = scans[start:] or islice(log.scans(load_settings(d).config.preprocess), start, None)
        outcomes.append(localized(case, following, is_live=options.live))
    found_m = np.array([each.found_m for each in outcomes])
    errors = np.vstack([each.errors for each in outcomes if not each.is_wrong(d)])
    m, rad = np.median(errors, axis=0) if len(errors) else (np.nan, np.nan)
    ratio = sum(sum(each.seconds) for each in outcomes) / max(sum(each.odometry_s for each in outcomes), 1e-9)
    longest_s = max(max(each.seconds[WARM_UP:], default=0.0) for each in outcomes[1:] or outcomes)
    shares = [f"{100.0 * np.mean(found_m <= limit):.1f} %" for limit in (*WITHIN_M, 1e9)]
    wrong = sum(each.is_wrong(d) for each in outcomes)
    error = f"{1e3 * m:.0f} mm, {np.degrees(rad):.2f}°"
    cells = name, len(outcomes), *shares, wrong, error, f"{ratio:.2f}", f"{1e3 * longest_s:.0f} ms"
    return *cells, *(whole(case, scans) if options.whole and case.T_map_lidar is not None else ())


def main() -> None:
    options = options_of(
        __doc__, cases="intel,aces,identical,vlp-16,os1-32,changed", starts=200, whole=False, live=False, km=10.0,
        sensor="vlp-16", every=2, memory=False,
    )  # fmt: skip
    line = table(*HEAD, *(WHOLE if options.whole else ()))
    for name in options.cases.split(","):
        line(*in_fresh_process(row, name, options))


if __name__ == "__main__":
    main()
