"""Sessions cut from logs and merged, their starts unknown.

Intel is run whole, and in four parts of a quarter of its time, which are merged; the error over the relations of
Kümmerle et al. (2009) is that of all scans of both. A simulated town (64 rings) is cut in two, which share 4 s,
ATE over all scans of both after rigid alignment. CSAIL is added to the parts of Intel. Eight parts of Intel of
2,000 scans each are merged; their time is that of their runs together. ACES, CSAIL and a staircase are cut into
halves and quarters that share nothing but the moment of the cut. Runs stay in the cache; what is there is not run
again, its time is that of then. Six parts of a walk through identical corridors are merged pair by pair.
Prints a Markdown table.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path

import msgspec
import numpy as np

import scanchain as sc
from scanchain import lie
from scanchain.data import Trajectory
from scanchain.evaluation import read_relations, relation_error
from scanchain.runs.metrics import Metrics
from scanchain.sessions.merging import Merged
from scanchain.trajectory import read_tum
from tests.benchmarks.harness import ate_m, options_of, table
from tests.support import made
from tests.support.scenes import DATA

INTEL, ACES, CSAIL = (DATA / f"2d/{name}.mcap" for name in ("intel", "aces", "mit_csail"))
LENGTH_S, SCANS = 2691.3, 2000


def run(cache: Path, name: str, log: Path, start_s: float = 0.0, end_s: float = np.inf) -> Path:
    """The run of a part of a log."""
    return made.run_of(log, cache, name, log__start_s=start_s, log__end_s=end_s)


def run_s(runs: Sequence[Path]) -> float:
    """Seconds that runs took together, without compilation."""
    return sum(msgspec.json.decode((each / "metrics.json").read_bytes(), type=Metrics).run_s for each in runs)


def trajectory(merged: Merged) -> Trajectory:
    """All scans of all sessions."""
    parts = [read_tum(merged.path / f"{session.name}.tum") for session in merged.metrics.sessions]
    return Trajectory(np.concatenate([p.stamps_ns for p in parts]), np.concatenate([p.poses for p in parts]))


def cells(name: str, runs: Sequence[Path], merged: Merged, error: str = "") -> tuple[str, ...]:
    """Of a row of the table."""
    metrics = merged.metrics
    apart = ", ".join(" + ".join(group) for group in metrics.apart) or "none"
    certified = "yes" if metrics.certified else "no"
    closures = f"{metrics.closures_in_force:,} of {metrics.closures_tried:,}"
    spent = f"{run_s(runs):.1f} s", f"{metrics.run_s:.1f} s"
    return name, f"{len(metrics.sessions)} of {len(runs)}", apart, closures, certified, error, *spent


def over_relations(log: Path, merged: Merged, whole: Trajectory) -> str:
    """Mean error over the relations of a log, merged and uncut."""
    relations = read_relations(log.with_suffix(".relations"))
    found, known = (relation_error(each, relations).translation_m.mean for each in (trajectory(merged), whole))
    return f"relations {1e3 * found:.1f} mm, uncut {1e3 * known:.1f} mm ({100.0 * (found / known - 1.0):+.1f} %)"


def intel(cache: Path, folder: Path, row: Callable[..., None]) -> None:
    quarter_s = LENGTH_S / 4.0
    parts = [run(cache, f"intel-{k + 1}", INTEL, k * quarter_s, (k + 1) * quarter_s) for k in range(4)]
    whole = read_tum(run(cache, "intel", INTEL) / "trajectory.tum")
    merged = sc.merge(parts, folder / "intel")
    row(*cells("Intel in four parts", parts, merged, over_relations(INTEL, merged, whole)))
    parts.append(run(cache, "csail", CSAIL))
    row(*cells("the same, and CSAIL", parts, sc.merge(parts, folder / "csail")))


def eight(cache: Path, folder: Path, row: Callable[..., None]) -> None:
    long_s = LENGTH_S * SCANS / 13_631
    starts_s = np.linspace(0.0, LENGTH_S - long_s, 8).tolist()
    parts = [run(cache, f"eighth-{k + 1}", INTEL, at_s, at_s + long_s) for k, at_s in enumerate(starts_s)]
    row(*cells("eight parts of Intel of 2,000 scans", parts, sc.merge(parts, folder / "eight")))


def town(cache: Path, folder: Path, row: Callable[..., None]) -> None:
    log = made.log("town", folder=cache, seed=1, seconds=60.0)
    parts = [run(cache, "town-1", log, end_s=32.0), run(cache, "town-2", log, start_s=28.0)]
    merged = sc.merge(parts, folder / "town")
    error_m = ate_m(trajectory(merged), read_tum(log.with_suffix(".tum")))
    row(*cells("town, two sessions", parts, merged, f"ATE {error_m:.4f} m"))


def cut(cache: Path, folder: Path, row: Callable[..., None]) -> None:
    stairs = made.log("staircase", folder=cache, seed=1)
    for name, log in (("aces", ACES), ("csail", CSAIL), ("staircase", stairs)):
        whole = read_tum(run(cache, name, log) / "trajectory.tum")
        length_s = float(np.ptp(whole.stamps_ns)) * 1e-9
        for count in (2, 4):
            cuts_s = [*np.linspace(0.0, length_s, count, endpoint=False).tolist(), np.inf]
            parts = [run(cache, f"{name}-{count}-{k}", log, *cuts_s[k : k + 2]) for k in range(count)]
            try:
                merged = sc.merge(parts, folder / f"{name}-{count}")
            except sc.ScanchainError as error:
                row(f"{name} in {count} parts", f"none: {error}")
                continue
            error = over_relations(log, merged, whole) if name == "aces" else ""
            row(*cells(f"{name} in {count} parts", parts, merged, error))


def look_alikes(cache: Path, folder: Path, row: Callable[..., None]) -> None:
    log = made.log("identical", folder=cache)
    truth = read_tum(log.with_suffix(".tum"))
    true = Trajectory(truth.stamps_ns, lie.lift(truth.poses))
    parts = [run(cache, f"identical-{k + 1}", log, 50.0 * k, 50.0 * (k + 1)) for k in range(6)]
    right = wrong = uncertain = 0
    for pair_of in combinations(parts, 2):
        try:
            merged = sc.merge(pair_of, folder / "-".join(part.name for part in pair_of))
        except sc.ScanchainError as error:
            uncertain += "not certain" in str(error)
            continue
        is_right = ate_m(trajectory(merged), true) < 0.5
        right, wrong = right + is_right, wrong + (not is_right)
    print(f"\nidentical corridors, 15 pairs: {wrong} joined wrongly, {right} rightly, {uncertain} named uncertain")


PARTS = {"intel": intel, "eight": eight, "cut": cut, "town": town, "look-alikes": look_alikes}


def main() -> None:
    options = options_of(__doc__, only=PARTS)
    row = table("sessions", "in the map", "apart", "closures in force", "certified", "error", "runs", "merge")
    with tempfile.TemporaryDirectory() as folder:
        for name in options.only:
            PARTS[name](options.cache, Path(folder), row)


if __name__ == "__main__":
    main()
