"""Whole logs in maps of other places, all ordered pairs: ``python -m tests.benchmarks.foreign``.

    [--kind 2d 3d] [--places NAME ...] [--own] [--cache DIR] [--seed N] [--from SHARE] [--half] [--set KEY=VALUE]

A map is made of each place by ``run``, and every log of another place is localized in it, from its first scan to
its last. --own localizes a log of the same place instead: another day, another start or another part of it.
--from begins logs at a share of their duration, --half ends them at half of it, --set changes the configuration
of localization (``--set log.every=2 log.wheels=``).

  refused   "not from this place", and none of its scans has ever had a pose in the map
  held      refused in the end, but scans had a pose in the map for a while
  followed  placed in the map in the end
  error     anything else that ended it

The two rooms of motion capture are one place, and so are offices, identical corridors or towns of different seeds.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from time import process_time

import scanchain as sc
from scanchain.errors import ScanchainError
from scanchain.logs import open_log
from scanchain.sessions.localizer import MapState

DATA = Path(os.environ.get("SCANCHAIN_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
CACHE = Path(tempfile.gettempdir()) / "scanchain_foreign"
PANDAR = {"log__topic": "/pandar64/points"}


@dataclass(frozen=True, slots=True)
class Place:
    """A real log, or a simulated world, and what its map and its log are made of.

    ``mapped`` and ``again`` are options of ``run`` and ``localize``, or of ``simulate``, for the map and for the
    log that is localized in its own place; ``options`` are those of both. Those of one ``site`` are one place.
    """

    kind: str
    log: str = ""
    world: str = ""
    other: str = ""
    options: dict[str, object] | None = None
    again: dict[str, object] | None = None
    mapped: dict[str, object] | None = None
    site: str = ""


def _real(log: str, end_s: float, **options: object) -> Place:
    """A log whose first seconds are the map of its own place, and the rest is localized in it."""
    return Place(log[:2], log, options=options, again={"log__start_s": end_s}, mapped={"log__end_s": end_s})


def _plane(world: str, **again: object) -> Place:
    """A world of space, driven through with a planar scanner."""
    return Place("2d", world=world, options={"sensor": "lms-270"}, again=again)


def _space(world: str, **again: object) -> Place:
    return Place("3d", world=world, options={"sensor": "vlp-16", "duration_s": 25.0}, again=again)


PLACES = {
    "intel": _real("2d/intel.mcap", 1400.0),
    "aces": _real("2d/aces.mcap", 700.0),
    "csail": _real("2d/mit_csail.mcap", 212.0),
    "mocap": Place("2d", "2d/mocap_room_1.bag", other="2d/mocap_room_2.bag", site="mocap"),
    "mocap-2": Place("2d", "2d/mocap_room_2.bag", other="2d/mocap_room_1.bag", site="mocap"),
    "office": Place("2d", world="office", again={"changed": 1, "start_m": 20.0}),
    "identical": Place("2d", world="identical", again={"reverse": True, "start_m": 15.0}),
    "streets": _plane("town", changed=1, start_m=100.0),
    "passage": _plane("corridor", start_m=30.0),
    "pillars": _plane("hall", start_m=20.0),
    "trunks": _plane("forest", reverse=True),
    "yard": _plane("turns"),
    "town": _space("town", changed=1, start_m=60.0),
    "highway": _space("highway", changed=None),
    "corridor": _space("corridor", start_m=10.0),
    "field": _space("field", start_m=30.0),
    "forest": _space("forest", reverse=True),
    "staircase": _space("staircase", reverse=True),
    "hall": _space("hall", start_m=20.0),
    "turns": _space("turns", changed=None),
    "kitti-1": _real("3d/kitti_0001_first54.mcap", 3.0),
    "kitti-5": _real("3d/kitti_0005_first60.mcap", 3.0),
    "pandaset": _real("3d/pandaset_002_sweeps30to55.mcap", 1.5, **PANDAR),
}


def log_of(name: str, seed: int, cache: Path, *, again: bool) -> Path:
    """The log of a place; again: of another drive there."""
    place = PLACES[name]
    if not place.world:
        return DATA / (place.other if again and place.other else place.log)
    path = cache / f"{name}_{seed}{'_again' if again else ''}.mcap"
    if not path.exists():
        draft = path.with_suffix(".draft.mcap")
        options = {**(place.options or {}), **((place.again or {}) if again else {})}
        sc.simulate(place.world, draft, seed=seed, force=True, **options)
        draft.with_suffix(".tum").unlink()
        draft.rename(path)
    return path


def map_of(name: str, seed: int, cache: Path, *, part: bool) -> Path:
    """The run of a place, of a part of the log where the rest is localized in it."""
    place = PLACES[name]
    options = {**(place.options or {}), **((place.mapped or {}) if part else {})} if place.log else {}
    out = cache / f"{name}_{seed}{'_part' if part and place.mapped else ''}.run"
    if not out.exists():
        sc.run(log_of(name, seed, cache, again=False), out, recording=False, **options)
    return out


def outcome(guest: str, host: str, seed: int, cache: Path, options: argparse.Namespace) -> tuple[str, str]:
    """What becomes of a log in a map: a word and a line."""
    place, again = PLACES[guest], guest == host
    prior = map_of(host, seed, cache, part=again)
    log = log_of(guest, seed, cache, again=again)
    chosen = {
        **((place.options or {}) if place.log else {}),
        **((place.again or {}) if again and place.log else {}),
    }
    chosen |= {key.replace(".", "__"): value for key, _, value in (each.partition("=") for each in options.set)}
    if options.share or options.half:
        duration_s = open_log([log]).duration_s
        chosen |= {"log__start_s": options.share * duration_s} if options.share else {}
        chosen |= {"log__end_s": 0.5 * duration_s} if options.half else {}
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = sc.localize(log, prior, Path(folder) / "out", recording=False, **chosen)
        except ScanchainError as error:
            return "error", str(error)
    metrics = found.metrics
    known = metrics.scans - metrics.states[MapState.SEARCHING]
    word = "followed" if metrics.placed else "held" if known else "refused"
    return (
        word,
        f"{metrics.sentence} ({known:,} of {metrics.scans:,} scans had a pose, {metrics.placed:,} in the end)",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", nargs="+", choices=("2d", "3d"), default=["2d", "3d"])
    parser.add_argument("--places", nargs="+", choices=list(PLACES), help="of the logs; maps are those of all")
    parser.add_argument("--own", action="store_true")
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--seed", type=int, default=0, help="of the worlds")
    parser.add_argument("--from", dest="share", type=float, default=0.0)
    parser.add_argument("--half", action="store_true")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    counts: Counter[str] = Counter()
    for kind in options.kind:
        names = [name for name, place in PLACES.items() if place.kind == kind]
        for guest in names:
            if options.places and guest not in options.places:
                continue
            site = PLACES[guest].site or guest
            foreign = [name for name in names if (PLACES[name].site or name) != site]
            for host in [guest] if options.own else foreign:
                began_s = process_time()
                word, line = outcome(guest, host, options.seed, options.cache, options)
                counts[word] += 1
                print(f"{guest} in {host}: {word}, {process_time() - began_s:.0f} s: {line}", flush=True)
    print(f"{sum(counts.values())} pairs: " + ", ".join(f"{count} {word}" for word, count in counts.items()))


if __name__ == "__main__":
    main()
