"""Wrong and right motions of runs, flagged or not, and their verdicts.

Simulated worlds and real logs (tests.benchmarks.vouching_logs), with and without wheels, at 10, 5 and 2 Hz, with
dropped scans, a kidnapping, crowds and traffic, a wrong mounting. Logs and run directories stay in the cache:
what is there is not run again, but judged by the code as it is now.

A motion is that from a scan to the first one a second or more later, or one of the relations that come with a
real log, of at most 5 s. It is

  wrong     if the final poses are off by more than 0.1 m or 1° in the plane, 0.2 m or 1° in space, and by more
            than three standard deviations along the error. These are of ``covariance`` in steps.parquet, that of a
            match in the lidar's frame; both ends err: Σ = Σ_j + Ad(M⁻¹) Σ_i Ad(M⁻¹)ᵀ with M the motion. Where one
            is null (degenerate) nothing is claimed, and the limits in meters and degrees decide alone
  flagged   if one of its scans is not ``ok`` or lies in a segment of the verdict
  open      if the true geometry leaves a direction open: less than a thousandth of the returns speak about it.
            Right motions of this sort are not counted, flagged or not. Real logs do not say

A run is good if its ATE is below 0.15 m (plane), 0.3 m (space) and no motion is wrong, bad from 1 m on; over
relations the mean error takes the place of the ATE, 0.1 m and 1 m, and one relation more than 1 m off is bad as
well. Good runs are doubted if they are not called trustworthy, those through open geometry if they are called
not trustworthy. Cases are split in two halves by a hash of the log's name.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Trajectory
from scanchain.evaluation import absolute_error, pair, read_relations, relation_error
from scanchain.evaluation.pairing import nearest
from scanchain.runs.evidence import evidence_of
from scanchain.runs.judging import known_of_run
from scanchain.trajectory import read_tum
from scanchain.verdict import judge
from tests.benchmarks import harness
from tests.benchmarks.vouching_logs import WHEELS, Case, LogSpec, cases
from tests.support import made

Row = dict[str, Any]

LIMIT_M, LIMIT_RAD, SIGMAS = {2: 0.1, 3: 0.2}, np.radians(1.0), 3.0
OPEN_SHARE, LONGEST_RELATION_S = 1e-3, 5.0
GOOD_M, BAD_M, GOOD_RELATIONS_M = {2: 0.15, 3: 0.3}, 1.0, 0.1
BARS = "Bars: ≥ 99 % of wrong motions flagged, ≤ 2 % of right ones, no bad run trustworthy, ≤ 3 % of good doubted"
QUICK = 7  # every n-th case
CHECKS = {  # operating points
    "fit": 0.6,
    "wheel_disagreement": 8.0,
    "velocity_innovation": 4.0,
    "observability": 1.0,
    "overlap_ratio": 0.667,
}
LOW_IS_BAD = ("fit", "observability", "overlap_ratio")


class Motions(NamedTuple):
    """Motions between two scans each: first, last (M,), and their errors (M, d+1, d+1), T_true_estimated."""

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    errors: Matrix


# ---------------------------------------------------------------- one run


def measured(log_cases: Sequence[Case], cache: Path) -> list[Row]:
    """Rows of all cases of one log; a run that fails has a row that says so."""
    rows = []
    for case in log_cases:
        try:
            rows.append(judged(case, cache, _run(case, cache)))
        except Exception as error:  # a case must not end the benchmark
            traceback.print_exc(file=sys.stderr)
            rows.append({"name": case.name, "kind": case.kind, "half": case.half, "failed": str(error)})
    return rows


def _run(case: Case, cache: Path) -> Path:
    file, reference = case.log.files(cache)
    options: dict[str, object] = {"log__every": case.every, **case.log.overrides}
    if case.wheels != "wheels":
        options["odometry__prior"] = "constant-velocity"
    is_tum = reference is not None and reference.suffix == ".tum"
    name = case.name.replace(" ", "_").replace("/", "-").replace(",", "")
    return made.run_of(file, cache, name, ground_truth=reference if is_tum else None, **options)


def judged(case: Case, cache: Path, out: Path) -> Row:
    """The row of a run directory, its verdict computed by the code as it is now."""
    import pyarrow.parquet as pq

    steps = pq.read_table(out / "steps.parquet")
    if case.wheels == "no wheels":
        steps = steps.drop_columns([name for name in steps.column_names if name.startswith("wheel_")])
    loops_file = out / "loops.parquet"
    known = known_of_run(out)
    closures = pq.read_table(loops_file) if loops_file.exists() else None
    evidence = evidence_of(steps, closures, known.expected_ate_m)
    verdict = judge(evidence, distortion=known.distortion)
    trajectory = Trajectory(steps["stamp_ns"].to_numpy(), evidence.poses)
    reference = case.log.files(cache)[1] or out / "ground_truth.tum"
    motions, quality = _compared(trajectory, reference, case.log.dimension)
    if np.isinf(case.log.reference_m):  # good enough for the run as a whole alone
        motions = Motions(*(part[:0] for part in motions))
    flags = np.array(steps["state"].to_pylist()) != "ok"
    for segment in verdict.segments:
        flags[segment.first : segment.last + 1] = True
    wrong, flagged = _is_wrong(motions, steps, evidence.poses, case.log), _any(flags, motions)
    is_open = _is_open(case.log.open_shares(cache), trajectory.stamps_ns, motions)
    quality = "good but wrong motions" if quality[0] == "good" and wrong.any() else quality[0], quality[1]
    return {
        "name": case.name, "kind": case.kind, "half": case.half, "dimension": case.log.dimension,
        "wheels": case.wheels, "quality": quality[0], "error_m": quality[1], "is_open": bool(is_open.any()),
        "verdict": str(verdict.verdict), "reason": verdict.reason,
        "counts": {
            "wrong flagged": int((wrong & flagged).sum()), "wrong silent": int((wrong & ~flagged).sum()),
            "right flagged": int((~wrong & flagged & ~is_open).sum()),
            "right ok": int((~wrong & ~flagged & ~is_open).sum()),
            "open flagged": int((~wrong & flagged & is_open).sum()), "open": int((~wrong & is_open).sum()),
        },
        "checks": _checks(steps, motions, wrong, is_open),
    }  # fmt: skip


def _compared(trajectory: Trajectory, reference: Path, dimension: int) -> tuple[Motions, tuple[str, float]]:
    """Motions with their errors; quality of the run ("good", "bad" or "") and its error in meters."""
    if reference.suffix == ".relations":
        relations = read_relations(reference)
        places, off_ns = nearest(relations.stamps_ns.ravel(), trajectory.stamps_ns)
        first, last = places.reshape(-1, 2).T
        whole = relation_error(trajectory, relations)
        length_s = np.abs(np.diff(relations.stamps_ns, axis=1)[:, 0]) * 1e-9
        used = (off_ns <= 1_000_000).reshape(-1, 2).all(axis=1) & (length_s <= LONGEST_RELATION_S)
        used &= np.abs(last - first) < 100  # stamps jitter
        estimated = lie.between(trajectory.poses[first[used]], trajectory.poses[last[used]])
        errors = lie.between(lie.flatten(relations.T_first_second[used]), estimated)
        error_m, worst_m = whole.translation_m.mean, whole.translation_m.maximum
        motions = Motions(np.minimum(first, last)[used], np.maximum(first, last)[used], errors)
        return motions, _quality(error_m, GOOD_RELATIONS_M, is_bad=max(error_m, worst_m) >= BAD_M)
    truth = read_tum(reference)
    is_sparse = len(truth) < len(trajectory)  # of some scans: no motion between them is interpolated
    pairs = pair(trajectory, truth, gap_s=0.01 if is_sparse else None)
    times_s = pairs.stamps_ns * 1e-9
    after = np.searchsorted(times_s, times_s + 1.0 - 0.5 * float(np.median(np.diff(times_s))))
    first = np.flatnonzero(after < len(times_s))
    last = after[first]
    errors = lie.between(
        lie.between(pairs.reference[first], pairs.reference[last]),
        lie.between(pairs.estimate[first], pairs.estimate[last]),
    )
    error_m = absolute_error(pairs).translation_m.rmse
    motions = Motions(pairs.places[first], pairs.places[last], lie.flatten(errors) if dimension == 2 else errors)
    return motions, _quality(error_m, GOOD_M[dimension], is_bad=error_m >= BAD_M)


def _quality(error_m: float, good_m: float, *, is_bad: bool) -> tuple[str, float]:
    return ("bad" if is_bad else "good" if error_m < good_m else ""), error_m


def _is_wrong(motions: Motions, steps: Any, poses: Matrix, log: LogSpec) -> NDArray[np.bool_]:
    """(M,) motions off by more than the limits and by more than three of their own standard deviations.

    The limits are wider by what the reference is off.
    """
    d = poses.shape[-1] - 1
    k = 3 if d == 2 else 6
    covariances = np.array([row or [np.inf] * k * k for row in steps["covariance"].to_pylist()]).reshape(-1, k, k)
    Ad = lie.adjoint(lie.between(poses[motions.last], poses[motions.first]))
    known = np.isfinite(covariances[motions.first] + covariances[motions.last]).all(axis=(1, 2))
    first, last = (
        np.where(known[:, None, None], covariances[ends], 0.0) for ends in (motions.first, motions.last)
    )
    sigma2 = last + Ad @ first @ np.swapaxes(Ad, 1, 2)
    twist = lie.log(motions.errors)
    wrong = np.zeros(len(known), np.bool_)
    for part, limit in (
        (slice(0, d), LIMIT_M[d] + log.reference_m),
        (slice(d, k), LIMIT_RAD + log.reference_rad),
    ):
        size = np.linalg.norm(twist[:, part], axis=1)
        along = twist[:, part] / np.maximum(size, 1e-12)[:, None]
        variance = np.einsum("ni,nij,nj->n", along, sigma2[:, part, part], along)
        wrong |= (size > limit) & (size > SIGMAS * np.sqrt(variance))
    return wrong


def _any(flags: NDArray[np.bool_], motions: Motions) -> NDArray[np.bool_]:
    """(M,) motions one of whose scans is flagged."""
    total = np.concatenate([[0], np.cumsum(flags)])
    return total[motions.last + 1] > total[motions.first]


def _is_open(shares: Matrix | None, stamps_ns: NDArray[np.int64], motions: Motions) -> NDArray[np.bool_]:
    """(M,) motions during which the true geometry leaves a direction open."""
    if shares is None:
        return np.zeros(len(motions.first), np.bool_)
    seen = nearest(stamps_ns, shares[:, 0].astype(np.int64))[0]
    return _any(shares[seen, 1] < OPEN_SHARE, motions)


def _checks(steps: Any, motions: Motions, wrong: NDArray[np.bool_], is_open: NDArray[np.bool_]) -> Row:
    """The worst value of each check during every motion that is not open, high is bad, and which are wrong."""
    chosen = wrong | ~is_open
    spans = list(zip(motions.first[chosen], motions.last[chosen], strict=True))
    result: Row = {"wrong": wrong[chosen].tolist()}
    for name in steps.column_names:
        if name in LOW_IS_BAD or name.endswith("_innovation"):
            values = (-1.0 if name in LOW_IS_BAD else 1.0) * steps[name].to_numpy(zero_copy_only=False).astype(
                float
            )
            values = np.nan_to_num(values, nan=-np.inf)
            result[name] = [values[first : last + 1].max() for first, last in spans]
    return result


# ---------------------------------------------------------------- all runs


def table(rows: Sequence[Row]) -> None:
    """Counts by kind, totals by half against the bars, and the failures by name."""
    line = harness.table(
        "kind", "runs", "wrong, flagged", "right, flagged", "open, flagged", "bad, trustworthy", "good, doubted"
    )
    done = [row for row in rows if "failed" not in row]
    groups = {kind: [row for row in done if row["kind"] == kind] for kind in sorted({row["kind"] for row in done})}
    groups |= {wheels: [row for row in done if row["wheels"] == wheels] for wheels in WHEELS}
    groups |= {f"**half {half + 1}**": [row for row in done if row["half"] == half] for half in (0, 1)}
    for name, group in (groups | {"**all**": done}).items():
        if group:
            line(name, len(group), *_cells(group))
    print(f"\n{BARS}\n")
    for row in done:
        if _is_missed(row) or _is_doubted(row):
            word = "bad but trustworthy" if _is_missed(row) else "good but doubted"
            print(f"{word}: {row['name']}: {row['error_m']:.3f} m; half {row['half'] + 1}; {row['reason'][:160]}")
    for row in rows:
        if "failed" in row:
            print(f"failed: {row['name']}: {row['failed']}")


def _cells(rows: Sequence[Row]) -> tuple[str, ...]:
    """Shares of motions and of runs."""
    counts = {key: sum(row["counts"][key] for row in rows) for key in rows[0]["counts"]}
    wrong = counts["wrong flagged"] + counts["wrong silent"]
    right = counts["right flagged"] + counts["right ok"]
    bad, good = ([row for row in rows if row["quality"] == quality] for quality in ("bad", "good"))
    return (
        _share(counts["wrong flagged"], wrong), _share(counts["right flagged"], right),
        _share(counts["open flagged"], counts["open"]), _share(sum(map(_is_missed, bad)), len(bad)),
        _share(sum(map(_is_doubted, good)), len(good)),
    )  # fmt: skip


def _share(part: int, whole: int) -> str:
    return f"{part:,} of {whole:,} ({100.0 * part / whole:.1f} %)" if whole else "–"


def _is_missed(row: Row) -> bool:
    return row["quality"] == "bad" and row["verdict"] == "trustworthy"


def _is_doubted(row: Row) -> bool:
    allowed = ("trustworthy", "check these segments") if row["is_open"] else ("trustworthy",)
    return row["quality"] == "good" and row["verdict"] not in allowed


def draw(rows: Sequence[Row], path: Path) -> None:
    """ROC curves of the checks over motions that are not open, for each half; dots are operating points."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 5), sharey=True)
    for half, axis in enumerate(axes):
        chosen = [row["checks"] for row in rows if "failed" not in row and row["half"] == half]
        for name in sorted({name for each in chosen for name in each} - {"wrong"}):
            sign = -1.0 if name in LOW_IS_BAD else 1.0
            wrong = np.concatenate([each["wrong"] for each in chosen if name in each]).astype(np.bool_)
            score = np.concatenate([each[name] for each in chosen if name in each])
            if not wrong.any() or wrong.all():
                continue
            order = np.argsort(-score, kind="stable")
            ends = np.flatnonzero(np.diff(score[order], append=-np.inf) != 0.0)  # ties are one point
            found = np.cumsum(wrong[order])[ends] / wrong.sum()
            false = np.cumsum(~wrong[order])[ends] / (~wrong).sum()
            label = f"{name} ({wrong.sum():,} of {len(wrong):,} wrong)"
            (line,) = axis.plot(np.append(0.0, false), np.append(0.0, found), label=label)
            if name in CHECKS:
                at = score > sign * CHECKS[name]
                axis.plot(at[~wrong].mean(), at[wrong].mean(), "o", color=line.get_color())
        axis.set_xscale("symlog", linthresh=0.01, linscale=0.4)
        axis.set(xlim=(0, 1), ylim=(0, 1.02), title=f"half {half + 1}", xlabel="share of right motions flagged")
        axis.grid(alpha=0.3)
        axis.legend(loc="lower right", fontsize=7)
    axes[0].set_ylabel("share of wrong motions flagged")
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main() -> None:
    options = harness.options_of(__doc__, quick=False, only="", jobs=1, png=Path)
    chosen = [case for case in cases() if all(word in case.name for word in options.only.split())]
    rows = _run_all(chosen[:: QUICK if options.quick else 1], options)
    table(rows)
    if options.png:
        draw(rows, options.png)


def _run_all(chosen: Sequence[Case], options: argparse.Namespace) -> list[Row]:
    """Rows of the cases, in their order; those of one log in one process."""
    by_log: dict[str, list[Case]] = {}
    for case in chosen:
        by_log.setdefault(case.log.name, []).append(case)
    rows: dict[str, Row] = {}
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        tasks = [pool.submit(measured, group, options.cache) for group in by_log.values()]
        for number, task in enumerate(as_completed(tasks), start=1):
            for row in task.result():
                rows[row["name"]] = row
                said = row.get("verdict", row.get("failed"))
                print(f"{number}/{len(tasks)} {row['name']}: {said}", file=sys.stderr)
    return [rows[case.name] for case in chosen]


if __name__ == "__main__":
    main()
