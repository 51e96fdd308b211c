"""Whole logs in maps of other places, or in maps that they enter later: the states of all scans and the verdict.

A map is made of each place by ``run``, and every log of another place is localized in it, from its first scan to
its last: all ordered pairs. --set changes the configuration of localization (``--set log.every=2``).

  refused   not placed, and none of its scans has ever had a pose in the map
  held      refused in the end, but scans had a pose in the map for a while
  followed  placed in the map in the end
  error     anything else that ended it

The two rooms of motion capture are one place, and so are offices, identical corridors or towns of different
seeds.

--late: a map is made of a part of a drive, and another part is localized in it that begins elsewhere. A scan is
inside where its true position lies within 5 m (in space 10 m) of a keyframe of the map. Prints, for each case:
path outside before it enters, and inside; path inside until it is found (negative: before it entered), the poses
that were given inside at their time and are wrong, the median error in the end, NEES then and in the end, the
verdict. Truth of a simulated world is the simulator's; of a real log it is the trajectory of the whole log, with
its loops.

--false-find M: the map also holds a copy of the first M meters of the log, put where nothing else lies. The log is
found there first, and leaves the copy: then it is wrong until it is found where it enters the map.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time

import numpy as np

import scanchain as sc
from scanchain import lie
from scanchain.data import Trajectory
from scanchain.errors import ScanchainError
from scanchain.maps import Edges, SavedMap, Session, open_saved_map, write_saved_map
from scanchain.sessions.localizer import MapState
from scanchain.trajectory import read_tum
from tests.benchmarks.harness import options_of, poses_at, settings_of, table, true_in_map
from tests.support import made
from tests.support.scenes import DATA

Options = dict[str, object]

PLANAR: Options = {"sensor": "lms-270"}  # a world of space, driven through with a planar scanner
SPATIAL: Options = {"sensor": "vlp-16"}
LONG: Options = {"sensor": "vlp-16", "seconds": 25.0}
INSIDE_M = {2: 5.0, 3: 10.0}
COPY_S, BESIDE_M = 120.0, {2: 100.0, 3: 300.0}  # of a log that is copied into its map, and how far off that lies
WRONG_M = {2: 1.0, 3: 2.0}  # error from which on a pose is wrong
HEAD = "log|outside|inside|found after|wrong poses|error|σ then, final|NEES|CPU s|verdict"


@dataclass(frozen=True, slots=True)
class Place:
    """A real log with options of ``run``, or a world with those of ``simulate``; those of a ``site`` are one."""

    kind: str
    log: str = ""
    world: str = ""
    options: Options = field(default_factory=dict)
    site: str = ""

    def of(self, seed: int, cache: Path) -> tuple[Path, Options]:
        """Its log, and the options of ``run`` and ``localize``."""
        if self.log:
            return DATA / self.log, self.options
        return made.log(self.world, folder=cache, seed=seed, **self.options), {}


PLACES = {
    "intel": Place("2d", "2d/intel.mcap"),
    "aces": Place("2d", "2d/aces.mcap"),
    "csail": Place("2d", "2d/mit_csail.mcap"),
    "mocap": Place("2d", "2d/mocap_room_1.bag", site="mocap"),
    "mocap-2": Place("2d", "2d/mocap_room_2.bag", site="mocap"),
    "office": Place("2d", world="office"),
    "identical": Place("2d", world="identical"),
    "streets": Place("2d", world="town", options=PLANAR),
    "passage": Place("2d", world="corridor", options=PLANAR),
    "pillars": Place("2d", world="hall", options=PLANAR),
    "trunks": Place("2d", world="forest", options=PLANAR),
    "yard": Place("2d", world="turns", options=PLANAR),
    **{
        world: Place("3d", world=world, options=LONG)
        for world in ("town", "highway", "corridor", "field", "forest", "staircase", "hall", "turns")
    },
    "kitti-1": Place("3d", "3d/kitti_0001_first54.mcap"),
    "kitti-5": Place("3d", "3d/kitti_0005_first60.mcap"),
    "pandaset": Place("3d", "3d/pandaset_002_sweeps30to55.mcap", options={"log__topic": "/pandar64/points"}),
}


def outcome(guest: str, host: str, options: argparse.Namespace) -> tuple[str, str]:
    """What becomes of a log in a map: a word and a line."""
    mapped, of_run = PLACES[host].of(options.seed, options.cache)
    prior = made.run_of(mapped, options.cache, f"{host}_{options.seed}", **of_run)
    log, chosen = PLACES[guest].of(options.seed, options.cache)
    chosen = chosen | settings_of(options.set)
    with tempfile.TemporaryDirectory() as folder:
        try:
            metrics = sc.localize(log, prior, Path(folder) / "out", recording=False, **chosen).metrics
        except ScanchainError as error:
            return "error", str(error)
    known = metrics.scans - metrics.states[MapState.SEARCHING]
    word = "followed" if metrics.placed else "held" if known else "refused"
    counts = f"{known:,} of {metrics.scans:,} scans had a pose, {metrics.placed:,} in the end"
    return word, f"{metrics.judged.sentence} ({counts})"


def all_pairs(options: argparse.Namespace) -> None:
    """A line a pair."""
    counts: Counter[str] = Counter()
    for kind in options.kind:
        sites = {name: place.site or name for name, place in PLACES.items() if place.kind == kind}
        for guest in options.places or sites:
            if guest not in sites:
                continue
            for host in (name for name in sites if sites[name] != sites[guest]):
                began_s = process_time()
                word, line = outcome(guest, host, options)
                counts[word] += 1
                print(f"{guest} in {host}: {word}, {process_time() - began_s:.0f} s: {line}", flush=True)
    print(f"{sum(counts.values())} pairs: " + ", ".join(f"{count} {word}" for word, count in counts.items()))


# ---------------------------------------------------------------- late entry


@dataclass(frozen=True, slots=True)
class Entry:
    """A drive, real or simulated, and its parts in seconds or in meters along the route."""

    log: str
    mapped: tuple[float, float]  # real: begin and end in s; simulated: begin in m and duration in s
    entering: tuple[float, float]
    options: Options = field(default_factory=dict)
    changed: int | None = None

    @property
    def dimension(self) -> int:
        return 3 if self.options == SPATIAL else 2


ENTRIES = {
    "csail-204": Entry("csail", (18.0, 71.0), (124.0, 424.0)),
    "csail-149": Entry("csail", (53.0, 124.0), (159.0, 424.0)),
    "csail-76": Entry("csail", (194.0, 300.0), (53.0, 194.0)),
    "aces-140": Entry("aces", (1081.0, 1252.0), (0.0, 1081.0)),
    "aces-113": Entry("aces", (0.0, 228.0), (284.0, 1366.0)),
    "intel-170": Entry("intel", (785.0, 1121.0), (1234.0, 2691.0)),
    "intel-114": Entry("intel", (673.0, 1121.0), (1234.0, 2691.0)),
    "intel-76": Entry("intel", (2355.0, 2691.0), (897.0, 2355.0)),
    "office": Entry("office", (60.0, 60.0), (0.0, 100.0)),
    "streets": Entry("town", (190.0, 10.0), (280.0, 45.0), PLANAR),
    "streets-changed": Entry("town", (90.0, 10.0), (180.0, 45.0), PLANAR, changed=1),
    "town": Entry("town", (190.0, 10.0), (280.0, 45.0), SPATIAL),
    "town-changed": Entry("town", (90.0, 10.0), (180.0, 45.0), SPATIAL, changed=1),
    "forest": Entry("forest", (100.0, 20.0), (0.0, 60.0), SPATIAL),
    "highway": Entry("highway", (300.0, 10.0), (0.0, 25.0), SPATIAL),
}
REAL = ("csail", "aces", "intel")


def whole_of(name: str, cache: Path) -> Path:
    """The run of a whole real log, whose poses are the truth of its parts."""
    return made.run_of(DATA / PLACES[name].log, cache, f"{name}_whole")


def prepared(name: str, seed: int, cache: Path) -> tuple[Path, Path, Options, Trajectory, Trajectory]:
    """Map, log, options of the log, and the truth of both."""
    entry = ENTRIES[name]
    out = f"late_{name}_{seed}"
    (map_begin, map_end), (begin, end) = entry.mapped, entry.entering
    if entry.log in REAL:
        log = DATA / PLACES[entry.log].log
        truth = read_tum(whole_of(entry.log, cache) / "trajectory.tum")
        prior = made.run_of(log, cache, out, log__start_s=map_begin, log__end_s=map_end)
        return prior, log, {"log__start_s": begin, "log__end_s": end}, truth, truth
    drive = {"folder": cache, "seed": seed, **entry.options}
    mapped = made.log(entry.log, start_m=map_begin, seconds=map_end, **drive)
    day = {} if entry.changed is None else {"changed": entry.changed}
    log = made.log(entry.log, start_m=begin, seconds=end, **day, **drive)
    truths = (read_tum(each.with_suffix(".tum")) for each in (mapped, log))
    return made.run_of(mapped, cache, out), log, {}, *truths


def with_copy(prior: SavedMap, seen: SavedMap, path_m: float, folder: Path) -> Path:
    """A map in a new folder that also holds the first meters of another one, beyond all that it has itself."""
    first = [each for each in seen.keyframes if each.traveled_m - seen.keyframes[0].traveled_m <= path_m]
    count, old, shift = len(first), len(prior.keyframes), lie.identity(prior.dimension)
    shift[0, -1] = prior.poses[:, 0, -1].max() - seen.poses[:count, 0, -1].min() + BESIDE_M[prior.dimension]
    begin_m = prior.keyframes[-1].traveled_m + 1e3
    copied = (
        replace(each, index=k, traveled_m=begin_m + each.traveled_m, T_odom_lidar=shift @ each.T_odom_lidar)
        for k, each in enumerate(first, old)
    )
    edges = seen.edges.among(np.arange(count))
    both = SavedMap(
        folder, prior.dimension, (*prior.keyframes, *copied), np.append(prior.session, np.full(count, 1)),
        (*prior.sessions[:1], Session("copy", first[0].stamp_ns, first[-1].stamp_ns, count)),
        Edges.chained(prior.edges, replace(edges, pairs=edges.pairs + old)),
    )  # fmt: skip
    write_saved_map(both)
    return folder


def entering(name: str, options: argparse.Namespace) -> tuple[str, ...]:
    """The cells of a case."""
    d = ENTRIES[name].dimension
    out, log, of_log, map_truth, truth = prepared(name, options.seed, options.cache)
    began_s = process_time()
    with tempfile.TemporaryDirectory() as folder:
        prior = out
        if options.false_find:
            of_copy = of_log | {"log__end_s": of_log.get("log__start_s", 0.0) + COPY_S}
            seen = made.run_of(log, options.cache, f"late_{name}_{options.seed}_copy", **of_copy)
            both = open_saved_map(out), open_saved_map(seen)
            prior = with_copy(*both, options.false_find, Path(folder) / "map")
        result = sc.localize(
            log, prior, Path(folder) / "out", recording=False, **of_log, **settings_of(options.set)
        )
        found, metrics = result.localization, result.metrics
    spent_s = process_time() - began_s
    true = poses_at(truth, found.trajectory.stamps_ns)
    expected, away_m = true_in_map(open_saved_map(out), map_truth, true)
    live_m, final_m = (
        np.linalg.norm((lie.lift(poses) - expected)[:, :3, 3], axis=1)
        for poses in (found.live, found.trajectory.poses)
    )
    inside = away_m < INSIDE_M[d]
    known, placed = inside & np.isfinite(live_m), inside & found.is_placed
    nees = [
        float(np.mean((off_m[chosen] / sigma_m[chosen]) ** 2)) / d if chosen.any() else np.nan
        for off_m, sigma_m, chosen in ((live_m, found.sigma_m, known), (final_m, found.final_sigma_m, placed))
    ]
    path_m, entry = found.traveled_m, int(inside.argmax())
    is_right = np.isfinite(live_m) & (live_m <= WRONG_M[d])
    first = int(is_right.argmax()) if is_right.any() else -1
    inside_m = np.cumsum(np.diff(path_m, prepend=path_m[0]) * inside)
    early_m = path_m[entry] - path_m[first] if first < entry else 0.0
    after = "never" if first < 0 else f"{inside_m[first] - early_m:.1f}"
    error = f"{np.median(final_m[placed]):.3f}" if placed.any() else "none"
    wrong = f"{(live_m[known] > WRONG_M[d]).sum()} of {known.sum()}"
    sigmas = f"{metrics.median_sigma_m:.3f}, {metrics.median_final_sigma_m:.3f}"
    found_there = f"{path_m[entry]:.0f}", f"{inside_m[-1]:.0f}", after, wrong, error, sigmas
    return (
        name,
        *found_there,
        f"{nees[0]:.2f}, {nees[1]:.2f}",
        f"{spent_s:.0f}",
        metrics.judged.sentence.split(":")[0],
    )


def main() -> None:
    options = options_of(__doc__, kind=["2d", "3d"], places=[], late=False, false_find=0.0, seed=0, set=[])
    if not options.late:
        all_pairs(options)
        return
    row = table(*HEAD.split("|"))
    for name in options.places or ENTRIES:
        if f"{ENTRIES[name].dimension}d" in options.kind:
            row(*entering(name, options))


if __name__ == "__main__":
    main()
