"""metrics.json and summary.txt: the figures of a run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from msgspec import Struct

from scanchain.data import BACK_END, VERIFICATION, State, Trajectory, fit_text
from scanchain.errors import FIRST, InputError, counted, folded
from scanchain.evaluation import ExpectedError, Pairs, absolute_error_of_any_path, kitti_error_of_any_path, pair
from scanchain.evaluation.errors import far_off, path_length
from scanchain.runs.results import Results
from scanchain.slam import SlamResult
from scanchain.steps import STAGES
from scanchain.verdict import Judged, Segment, Verdict

VERDICT, REASON = "verdict", " " * 15  # first word of a summary, and indent of the reasons below it
_BY_STAGE = ("ms per scan", "  median", "  95th perc.")  # first words of lines that it omits
_CONDITIONS = {
    Verdict.TRUSTWORTHY: "",
    Verdict.CHECK: " if no segment is wrong",
    Verdict.NOT_TRUSTWORTHY: " if the trajectory were right",
}


class Accuracy(Struct, frozen=True):
    """Accuracy of a trajectory against the ground truth; figures that need a longer path are null.

    ``pairs`` is the number of scans with a true pose; ``missing`` states how many have none and why, or is empty.
    """

    pairs: int
    missing: str
    ate_rmse_m: float
    ate_mean_m: float
    ate_max_m: float
    ate_share_of_path: float | None
    ate_rotation_rmse_rad: float
    kitti_translation_share: float | None
    kitti_rotation_rad_per_m: float | None
    definition: str
    kitti_definition: str = ""


class GroundTruth(Struct, frozen=True):
    """Accuracy of a run against the ground truth, after and before optimization.

    ``max_gap_s`` : longest gap between true poses to interpolate over, as requested; null for the default
    """

    source: str
    path_length_m: float
    optimized: Accuracy
    odometry: Accuracy
    max_gap_s: float | None = None

    @property
    def complaint(self) -> str:
        """Warning that the trajectory is far from the ground truth; empty if it is not."""
        error, length_m = self.optimized, self.path_length_m
        return far_off(error.ate_rmse_m, length_m, error.ate_rotation_rmse_rad)


class Metrics(Struct, frozen=True):
    """Figures of a run; ``*_ms`` are per scan, by stage; the residual is null where nothing was matched.

    Only ``compile_s`` includes the compilation of kernels, which happens once after an installation.
    Closures tried = rejected by verification + verified; verified = rejected by the back end + accepted.
    ``chi2`` and its degrees of freedom are those of the edges in force, which are the edges in graph.g2o.
    ``stopped`` is the reason why a run ended before its log; these figures are of the scans before. Else empty.
    ``contradicted`` scans are matched, but their correspondences contradict the pose (``fit`` below 0.6).
    ``expected_ate_m`` is the ATE estimated without ground truth; null where the graph has no edge or its edges do
    not constrain all poses.
    ``verdict`` is the reliability of the result, ``verdict_reason`` the reason, ``verdict_error`` the error
    estimate, ``segments`` the suspicious segments to check.
    ``elevation_offset_rad`` is the correction of the lidar's vertical angles from the scan ``calibrated_from`` on;
    0 where no error was found; ``elevation_sigma_rad`` its standard deviation, null where none was estimated.
    ``odometry_errors`` : drift, slips and jumps of odometry that loop closures show, corrected in the graph
    ``range_noise_m`` : standard deviation of the ranges, estimated on the first scans; null where unknown
    ``range_noise`` : the same by range, in words
    ``distortion`` : motion distortion of scans without point times, in words, where it is not removed
    ``warnings`` : data lost, skipped or wrong, one line each
    """

    scans: int
    dimension: int
    log_span_s: float
    run_s: float
    scans_per_s: float
    times_real_time: float
    traveled_m: float
    scan_points: int
    dropped_points: int
    ok: int
    contradicted: int
    degenerate: int
    lost: int
    keyframes: int
    closures_tried: int
    closures_rejected_by_verification: int
    closures_verified: int
    closures_rejected_by_back_end: int
    closures_accepted: int
    map_points: int
    moving_points_removed: int
    chi2: float
    degrees_of_freedom: int
    median_ms: dict[str, float]
    p95_ms: dict[str, float]
    median_inlier_share: float
    median_residual_m: float | None
    median_iterations: float
    ground_truth: GroundTruth | None
    warnings: tuple[str, ...]
    verdict: Verdict = Verdict.TRUSTWORTHY
    verdict_reason: str = ""
    segments: tuple[Segment, ...] = ()
    expected_ate_m: ExpectedError | None = None
    stopped: str = ""
    compile_s: float = 0.0
    elevation_offset_rad: float = 0.0
    elevation_sigma_rad: float | None = None
    calibrated_from: int = 0
    odometry_errors: tuple[str, ...] = ()
    verdict_error: str = ""
    range_noise_m: float | None = None
    range_noise: str = ""
    distortion: str = ""

    @property
    def refuted(self) -> str:
        """Message that the ATE against the ground truth is outside of the error bar; empty if it is not."""
        bar, truth = self.expected_ate_m, self.ground_truth
        if bar is None or truth is None or bar.low <= truth.optimized.ate_rmse_m <= bar.high:
            return ""
        return f"the ground truth refutes the error bar: ATE {truth.optimized.ate_rmse_m:.4f} m, not {bar.bounds}"

    @property
    def judged(self) -> Judged:
        """Verdict, error estimate, reason and segments to check."""
        return Judged(self.verdict, self.verdict_reason, self.segments, self.verdict_error)

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return self.judged.sentence


def measure(
    results: Results, expected: ExpectedError | None, judged: Judged, *, run_s: float, **of_run: Any
) -> Metrics:
    """Metrics of a finished run; ``of_run`` are those that are neither of its scans nor of its results."""
    result, cloud, final, steps = results.result, results.cloud, results.final, results.result.steps
    columns, states = steps.columns, steps.states()
    residuals_m = columns["residual_m"][np.isfinite(columns["residual_m"])]
    stage_s = columns["timing"]
    total_s = np.column_stack([stage_s, stage_s[:, 1:].sum(axis=1)])
    names = (*STAGES, "all_but_read")
    rejected = Counter(item.rejected_by for item in final)
    scan_numbers = np.array([keyframe.scan_index for keyframe in result.keyframes])
    return Metrics(
        scans=len(steps),
        dimension=result.trajectory.dimension,
        log_span_s=steps.span_s,
        run_s=run_s,
        scans_per_s=len(steps) / run_s,
        times_real_time=steps.span_s / run_s,
        traveled_m=float(path_length(result.trajectory.poses)[-1]),
        scan_points=int(columns["scan_points"].sum()),
        dropped_points=int(columns["dropped"].sum()),
        ok=states[State.OK],
        contradicted=states[State.CONTRADICTED],
        degenerate=states[State.DEGENERATE],
        lost=states[State.LOST],
        keyframes=len(result.keyframes),
        closures_tried=len(final),
        closures_rejected_by_verification=rejected[VERIFICATION],
        closures_verified=len(final) - rejected[VERIFICATION],
        closures_rejected_by_back_end=rejected[BACK_END],
        closures_accepted=rejected[""],
        map_points=len(cloud.points),
        moving_points_removed=cloud.removed,
        chi2=result.state.chi2,
        degrees_of_freedom=result.state.degrees_of_freedom,
        median_ms=dict(zip(names, np.median(1e3 * total_s, axis=0).tolist(), strict=True)),
        p95_ms=dict(zip(names, np.percentile(1e3 * total_s, 95.0, axis=0).tolist(), strict=True)),
        median_inlier_share=float(np.median(steps.inlier_shares)),
        median_residual_m=float(np.median(residuals_m)) if len(residuals_m) else None,
        median_iterations=float(np.median(columns["iterations"])),
        verdict=judged.verdict,
        verdict_reason=judged.reason,
        segments=judged.segments,
        verdict_error=judged.error,
        expected_ate_m=expected,
        elevation_offset_rad=result.elevation_offset_rad,
        elevation_sigma_rad=result.elevation_sigma_rad if math.isfinite(result.elevation_sigma_rad) else None,
        calibrated_from=result.calibrated_from,
        odometry_errors=tuple(result.graph.corrections(scan_numbers, "scans")),
        range_noise_m=result.noise.sigma_m or None,
        range_noise=result.noise.text,
        distortion=results.log.distortion,
        **of_run,
    )


def compare_with_truth(
    result: SlamResult, reference: Trajectory, source: str, gap_s: float | None
) -> tuple[GroundTruth, list[str]]:
    """Accuracy of both trajectories of a result, and a line for each reason why it may mislead."""
    pairs = pair(result.trajectory, reference, gap_s=gap_s)
    optimized, length_m = _accuracy(pairs)
    odometry, _ = _accuracy(pair(result.odometry, reference, gap_s=gap_s))
    return GroundTruth(source, length_m, optimized, odometry, gap_s), pairs.warnings


def verdict_lines(headline: str, reasons: Sequence[str]) -> Iterator[str]:
    """The first lines of a summary: the verdict, and one indented line per reason."""
    yield f"{VERDICT:<14} {headline}"
    yield from (f"{REASON}{reason}" for reason in reasons)


def shortened(summary: str) -> str:
    """A summary for a terminal: lines wrapped, with the first reasons only, without times by stage."""
    lines = [line for line in summary.splitlines() if not line.startswith(_BY_STAGE)]
    reasons = [line for line in lines if line.startswith(REASON)]
    more = [f"{REASON}{len(reasons) - FIRST:,} more in summary.txt"] if len(reasons) > FIRST else []
    return folded("\n".join([*lines[:1], *reasons[:FIRST], *more, *lines[1 + len(reasons) :]])) + "\n"


def removed(points: int) -> str:
    """Number of points of moving objects removed from a map, in words; empty for none."""
    return f"; {counted(points, 'point')} of moving objects removed" if points else ""


def lines_of(m: Metrics) -> Iterator[tuple[str, str]]:
    """Label and text of each figure, for summary and report, without accuracy and times by stage."""
    states = {"ok": m.ok, "contradicted": m.contradicted, "degenerate": m.degenerate, "lost": m.lost}
    counts = ", ".join(f"{count:,} {state}" for state, count in states.items())
    yield "scans", f"{m.scans:,} over {m.log_span_s:.1f} s: {counts}"
    if m.dropped_points:
        yield "points", f"{counted(m.dropped_points, 'invalid return')} left out"
    at_rest = ": the noise of one that does not move" if "does not move" in m.verdict_reason else ""
    yield "trajectory", f"{m.traveled_m:.1f} m, {counted(m.keyframes, 'keyframe')}{at_rest}"
    if (error := m.expected_ate_m) is None:
        yield "expected ATE", "unknown: the pose graph has no edge, or its edges leave poses free"
    else:
        yield "expected ATE", f"{error.mean:.3f} m ({error.bounds}){_CONDITIONS[m.verdict]}"
    by_back_end = m.closures_rejected_by_back_end
    yield (
        "loop closures",
        f"{m.closures_tried:,} tried: {m.closures_rejected_by_verification:,} rejected by verification, "
        f"{by_back_end:,} by the back end, {m.closures_accepted:,} accepted"
        if m.closures_tried
        else "none tried",
    )
    rejected = f"{counted(by_back_end, 'closure')} rejected by the back end" if by_back_end else ""
    yield "pose graph", fit_text(m.chi2, m.degrees_of_freedom, rejected, has_loops=m.closures_accepted > 0)
    yield "map", f"{counted(m.map_points, 'point')}{removed(m.moving_points_removed)}"
    residual = "–" if m.median_residual_m is None else f"{1e3 * m.median_residual_m:.1f} mm"
    inliers, iterations = 100.0 * m.median_inlier_share, counted(round(m.median_iterations), "iteration")
    yield "matching", f"inliers {inliers:.0f} %, residual {residual}, {iterations} (medians)"
    if m.range_noise_m:
        yield "lidar noise", m.range_noise
    if m.elevation_offset_rad and m.elevation_sigma_rad is not None:
        by_deg, sigma_deg = math.degrees(m.elevation_offset_rad), math.degrees(m.elevation_sigma_rad)
        angles = f"vertical angles corrected by {by_deg:+.2f} ± {sigma_deg:.2f} deg"
        yield "calibration", f"{angles} from scan {m.calibrated_from:,} on (preprocess.calibrate_elevation)"
    yield from (("odometry", error) for error in m.odometry_errors)
    compiling = f" (and {m.compile_s:.0f} s compiling, once after an installation)"
    took = f"{m.run_s:.1f} s{compiling if m.compile_s >= 0.5 else ''} with map and results"
    yield "time", f"{took}, {counted(round(m.scans_per_s), 'scan')}/s, {m.times_real_time:.1f} x real time"


def summary(metrics: Metrics, heading: str, configuration: str, notes: Sequence[str]) -> str:
    """The metrics as text."""
    stages = {"median": metrics.median_ms, "95th perc.": metrics.p95_ms}
    return text_of(metrics.judged, [
        ("", heading),
        ("configuration", configuration),
        *lines_of(metrics),
        (_BY_STAGE[0], "".join(f"{stage:>12}" for stage in STAGES)),
        *((f"  {name}", "".join(f"{of[stage]:12.2f}" for stage in STAGES)) for name, of in stages.items()),
        *accuracy_lines(metrics.ground_truth),
        *((("accuracy", metrics.refuted),) if metrics.refuted else ()),
        *(("warning", warning) for warning in metrics.warnings),
        *(("note", note) for note in notes),
    ])  # fmt: skip


def text_of(judged: Judged | None, lines: Iterable[tuple[str, str]]) -> str:
    """The text of summary.txt: the verdict with its reasons, and a line for each label and text."""
    first = [] if judged is None else verdict_lines(judged.headline, judged.reasons)
    return "\n".join([*first, *(f"{label:<14} {text}" if label else text for label, text in lines)]) + "\n"


def _accuracy(pairs: Pairs) -> tuple[Accuracy, float]:
    ate = absolute_error_of_any_path(pairs)
    try:
        kitti = kitti_error_of_any_path(pairs)
    except InputError:
        kitti = None
    accuracy = Accuracy(
        pairs=len(pairs),
        missing=pairs.missing,
        ate_rmse_m=ate.translation_m.rmse,
        ate_mean_m=ate.translation_m.mean,
        ate_max_m=ate.translation_m.maximum,
        ate_share_of_path=ate.share_of_path,
        ate_rotation_rmse_rad=ate.rotation_rad.rmse,
        kitti_translation_share=None if kitti is None else kitti.translation_share,
        kitti_rotation_rad_per_m=None if kitti is None else kitti.rotation_rad_per_m,
        definition=f"{ate.definition}, over {ate.pairing}",
        kitti_definition="" if kitti is None else kitti.definition,
    )
    return accuracy, ate.path_length_m


def accuracy_lines(truth: GroundTruth | None) -> Iterator[tuple[str, str]]:
    """Label and text of the accuracy, if there is ground truth."""
    if truth is None:
        return
    missing = f"; {truth.optimized.missing}" if truth.optimized.missing else ""
    scans = counted(truth.optimized.pairs, "scan")
    yield "ground truth", f"{truth.source}: {truth.path_length_m:.1f} m, {scans}{missing}"
    for name, error in (("ATE", truth.optimized), ("ATE odometry", truth.odometry)):
        share = error.ate_share_of_path
        of_path = "" if share is None else f" ({100.0 * share:.3f} % of the path)"
        yield (
            name,
            f"rmse {error.ate_rmse_m:.4f} m{of_path}, max {error.ate_max_m:.4f} m, "
            f"rotation rmse {np.degrees(error.ate_rotation_rmse_rad):.3f} deg",
        )
