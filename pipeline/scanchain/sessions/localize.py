"""``scanchain localize``: localizes a log in a map and writes a directory with poses in the map's frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct
from numpy.typing import NDArray

from scanchain import lie
from scanchain.ahead import compile_ahead
from scanchain.clock import working_s
from scanchain.config import Config
from scanchain.data import ClosureVerdict, Pose, brief
from scanchain.errors import FIRST, InputError, counted
from scanchain.logs import Log
from scanchain.loops.evidence import SEARCHED_M
from scanchain.maps import SavedMap
from scanchain.runs.directory import POINTS_FILE, RunDirectory, write_figures
from scanchain.runs.job import Job, Progress
from scanchain.runs.metrics import GroundTruth, accuracy_lines, text_of
from scanchain.runs.opening import Opened, opened
from scanchain.runs.step_table import pose_columns
from scanchain.sessions.alignment import opened_maps
from scanchain.sessions.joining import MAX_REPEATED, repeated_paths
from scanchain.sessions.localizer import Localization, Localizer, MapState
from scanchain.trajectory import read_tum, write_tum
from scanchain.verdict import Judged, Verdict, merged

LOCALIZATION_FILE = "localization.parquet"
_WITHOUT_MAP_M = {2: 2.0, 3: 10.0}  # shortest path without a match with the map that is reported
_MOVED = (0.3, 5.0)  # m and σ, least reported difference of the live and the final pose of a scan
_APART_S = 1.0  # largest time between the first scan and the nearest pose of a file
_AMBIGUOUS_SHARE = 0.5  # least share of ambiguous searches for which a log that is not found is called ambiguous


class Part(Struct, frozen=True):
    """Consecutive scans whose pose in the map is uncertain or unknown: first and last, seconds, meters of path."""

    kind: str
    first: int
    last: int
    start_s: float
    end_s: float
    length_m: float

    @property
    def is_doubtful(self) -> bool:
        """False if the log was tracked throughout the part, be it by odometry alone."""
        return self.kind not in (MapState.UNMATCHED, MapState.OUTSIDE)

    @property
    def text(self) -> str:
        """The part in words."""
        return (
            f"scans {self.first:,} to {self.last:,} ({self.start_s:.1f} to {self.end_s:.1f} s, "
            f"{self.length_m:.1f} m): {self.kind}"
        )


class LocalizeMetrics(Struct, frozen=True):
    """Contents of metrics.json of a localized log.

    ``found_*`` say where the log was first localized; −1 and NaN if it never was. ``matches`` are closures of
    keyframes with the map, ``rejected`` those that the optimizer rejected in the end. ``log_odds`` are of the
    location where the log was placed or, if they do not suffice, of the best one that was tested; NaN if there was
    none. Standard deviations are medians, of live and of final positions. ``ground_truth`` is the accuracy of the
    scans that are placed.
    """

    verdict: Verdict
    reason: str
    parts: tuple[Part, ...]
    map: str
    map_keyframes: int
    scans: int
    placed: int
    states: dict[str, int]
    found_scan: int
    found_after_s: float
    found_after_m: float
    path_m: float
    matches: int
    rejected: int
    median_overlap: float
    median_sigma_m: float
    median_final_sigma_m: float
    log_odds: float
    time_s: float
    warnings: tuple[str, ...]
    ground_truth: GroundTruth | None = None

    @property
    def judged(self) -> Judged:
        """Verdict and reason."""
        return Judged(self.verdict, self.reason)


@dataclass(frozen=True, slots=True)
class LocalizedLog:
    """A localized log: its directory, the map, its poses in it, metrics and summary."""

    __repr__ = brief
    path: Path
    prior: SavedMap
    localization: Localization
    metrics: LocalizeMetrics
    summary: str


Draw = Callable[[Path, LocalizedLog], None]
Initial = Callable[[int, SavedMap], Pose]


def localize(
    job: Job,
    map_path: Path,
    progress: Progress,
    draw: Draw = lambda folder, localized: None,
    *,
    initial: Initial | None = None,
) -> LocalizedLog:
    """Localize a log; returns the contents of the directory.

    map_path : run directory, or folder, of the map; draw : adds report and recording to the folder
    initial : if known, function of the first scan's stamp and the map that returns T_map_lidar of that scan
    Raises InputError for a log or a map that cannot be read.
    """
    directory = RunDirectory(job.out, force=job.force, sources=job.logs, command=job.command)
    (prior,) = opened_maps([map_path], job.out)
    source = opened(job, progress)
    log, config = source.log, source.config
    if not config.loops.enabled:
        raise InputError("loops.enabled is false, but localization in a map needs loop closures; leave it true")
    if log.dimension != prior.dimension:
        raise InputError(
            f"{log.name}: has {log.dimension}D scans, the map {prior.name} is {prior.dimension}D; give a map of "
            "the same kind"
        )
    progress.say(f"{log.topics}: {counted(log.scan_count, 'scan')}; map {prior.name}")
    with directory:
        directory.begin(source.configuration, config)
        compile_ahead([f"{log.dimension}d", "rest"], progress.compiling)
        localizer = _tracked(source, prior, initial, directory.path / POINTS_FILE)
        progress.say("smoothing the trajectory")
        found = localizer.finish()
        stopped = source.stopped_after(len(found.states))
        warnings = (*filter(None, [stopped]), *log.damage, *localizer.warnings)
        time_s, truth = working_s() - directory.began_s, None
        progress.say("writing the results")
        with directory.results() as folder:
            if found.is_placed.any():
                truth, note = source.accuracy(replace(found.result, trajectory=found.placed), folder)
                warnings += note
            metrics = measure(found, prior, config, time_s, warnings, truth)
            text = _summary(metrics, prior, log, found.result.sensor_notes)
            localized = LocalizedLog(directory.destination, prior, found, metrics, text)
            _write(folder, localized)
            draw(folder, localized)
        localizer.slam.points.close()
        (directory.path / POINTS_FILE).unlink(missing_ok=True)
        directory.end(stopped=stopped)
        directory.complete()
    return localized


def _tracked(source: Opened, prior: SavedMap, initial: Initial | None, points_file: Path) -> Localizer:
    """The localizer after all scans of the log. Raises InputError if there is no scan."""
    localizer, log, config = None, source.log, source.config
    with closing(log.scans(config.preprocess)) as scans:
        for scan in source.progress.track(scans, log.scan_count):
            if localizer is None:
                T = None if initial is None else initial(scan.stamp_ns, prior)
                localizer = Localizer(
                    prior, config, log.stated_mounting, initial=T, points_file=points_file, is_live=False
                )
            localizer.process(scan)
    if localizer is None:
        raise InputError(f"{log.name}: has no scan to localize; scanchain doctor says why")
    return localizer


def measure(
    found: Localization,
    prior: SavedMap,
    config: Config,
    time_s: float,
    warnings: tuple[str, ...],
    ground_truth: GroundTruth | None = None,
) -> LocalizeMetrics:
    """Metrics and verdict of a localized log."""
    first, graph = found.found_at, found.result.graph
    seconds = (found.trajectory.stamps_ns - found.trajectory.stamps_ns[0]) * 1e-9
    overlaps = [each.overlap for each in found.closures if each.verdict is ClosureVerdict.ACCEPTED]
    in_map = graph.is_loop & (graph.edges[:, 0] < len(prior.keyframes))
    states = {state: int((found.states == state).sum()) for state in MapState}
    parts = tuple(_parts(found, seconds))
    verdict, reason = _verdict(found, prior, states, parts, _doubt(found, prior, config))
    return LocalizeMetrics(
        verdict=verdict,
        reason=reason,
        parts=parts,
        map=str(prior.folder.resolve()),
        map_keyframes=len(prior.keyframes),
        scans=len(found.states),
        placed=int(found.is_placed.sum()),
        states={str(state): count for state, count in states.items()},
        found_scan=first,
        found_after_s=float(seconds[first]) if first >= 0 else np.nan,
        found_after_m=float(found.traveled_m[first]) if first >= 0 else np.nan,
        path_m=float(found.traveled_m[-1]),
        matches=len(overlaps),
        rejected=int((graph.is_rejected & in_map).sum()),
        median_overlap=_median(np.array(overlaps)),
        median_sigma_m=_median(found.sigma_m),
        median_final_sigma_m=_median(found.final_sigma_m),
        log_odds=found.result.map_log_odds,
        time_s=time_s,
        warnings=warnings,
        ground_truth=ground_truth,
    )


def _median(values: NDArray[np.float64]) -> float:
    """Median of the finite ones, NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _parts(found: Localization, seconds: NDArray[np.float64]) -> Iterator[Part]:
    """Parts of a localized log whose pose in the map is uncertain, unknown, or was corrected later."""
    if found.found_at < 0:
        return
    dimension = found.trajectory.dimension
    after = np.arange(len(found.states)) >= found.found_at
    away_m = np.linalg.norm((found.live - found.trajectory.poses)[:, :-1, -1], axis=1)
    wrong = found.is_placed & (away_m > np.maximum(_MOVED[0], _MOVED[1] * found.sigma_m))
    kinds = (
        ("not joined to the map", ~found.is_placed, 0.0),
        ("lost", after & found.is_placed & (found.states == MapState.LOST), 0.0),
        ("place unknown at the time", after & found.is_placed & (found.states == MapState.SEARCHING), 0.0),
        (MapState.UNMATCHED.value, found.is_placed & (found.states == MapState.UNMATCHED), 1.0),
        (MapState.OUTSIDE.value, found.is_placed & (found.states == MapState.OUTSIDE), 1.0),
        ("place corrected later", wrong, 0.0),
    )
    for kind, chosen, shortest in kinds:
        for begin, end in ((part.start, part.stop) for part in merged(chosen, 0)):
            length_m = float(found.traveled_m[end - 1] - found.traveled_m[begin])
            if length_m >= shortest * _WITHOUT_MAP_M[dimension]:
                yield Part(kind, begin, end - 1, float(seconds[begin]), float(seconds[end - 1]), length_m)


def _doubt(found: Localization, prior: SavedMap, config: Config) -> str:
    """Reason why a log may be from another location than where it was found; empty if there is none."""
    result, of_map, graph = found.result, len(prior.keyframes), found.result.graph
    chosen = [each for each in result.keyframes[of_map:] if found.is_placed[each.scan_index]]
    if chosen and np.isfinite(result.map_rival_log_odds):
        odds = f"log-odds {result.map_rival_log_odds:.0f} against {result.map_log_odds:.0f}"
        return f"its last keyframes match another location in the map, too ({odds})"
    if not chosen or prior.dimension == 3 or found.found_at == 0:  # its initial pose was given
        return ""
    placed = [replace(each, T_odom_lidar=found.trajectory.poses[each.scan_index]) for each in chosen]
    sources = graph.edges[graph.is_loop & ~graph.is_rejected & (graph.edges[:, 0] < of_map), 1]
    agreeing = np.flatnonzero(np.isin([each.index for each in chosen], sources))
    repeated, paths = repeated_paths(prior.keyframes, placed, agreeing, config)
    if repeated <= MAX_REPEATED * paths:
        return ""
    return f"{repeated} of {paths} paths in it also fit other locations"


def _verdict(
    found: Localization, prior: SavedMap, states: dict[MapState, int], parts: tuple[Part, ...], doubt: str
) -> tuple[Verdict, str]:
    scans, path_m, log_odds = len(found.states), float(found.traveled_m[-1]), found.result.map_log_odds
    tried = f"{counted(scans, 'scan')} over {path_m:.1f} m"
    if not found.is_placed.any():
        if path_m < SEARCHED_M[found.trajectory.dimension]:
            reason = f"not found in {prior.name}: {tried} are too short a path to decide"
        elif np.isfinite(log_odds):
            reason = f"not certain: {tried} may be in {prior.name}, but log-odds of {log_odds:.1f} are too low"
        elif known := scans - states[MapState.SEARCHING]:
            had = f"{counted(known, 'scan')} had a location in {prior.name} that was withdrawn"
            reason = f"not certain: of {tried}, {had}"
        elif found.result.map_ambiguous_share >= _AMBIGUOUS_SHARE:
            reason = f"not certain: {tried} fit several locations in {prior.name} equally well"
        else:
            scale = "" if len(prior.edges.pairs) else ", or the scale of its file is wrong"  # of an imported map
            reason = f"not from this place: nothing in {tried} matches {prior.name}{scale}"
        return Verdict.NOT_TRUSTWORTHY, reason
    at = found.found_at
    where = f"found in {prior.name}" + (f" after {found.traveled_m[at]:.1f} m" if at >= 0 else " in the end")
    matched, unmatched, outside = (
        states[state] for state in (MapState.LOCALIZED, MapState.UNMATCHED, MapState.OUTSIDE)
    )
    share = f"{100.0 * matched / max(matched + unmatched, 1):.0f} % of the scans within the map matched"
    away = f", {100.0 * outside / scans:.0f} % outside of it" if outside else ""
    evidence = f"{share}{away}"
    doubt = doubt or ("" if matched else "no scan matched the map")
    doubtful = sorted((part for part in parts if part.is_doubtful), key=lambda part: -part.length_m)
    if not doubtful and not doubt:
        return Verdict.TRUSTWORTHY, f"{where}, and tracked: {tried}; {evidence}"
    more = f"and {len(doubtful) - FIRST:,} more" if len(doubtful) > FIRST else ""
    reasons = [where, evidence, doubt, *(part.text for part in doubtful[:FIRST]), more]
    return Verdict.CHECK, "; ".join(filter(None, reasons))


def pose_near(x_m: float, y_m: float, yaw_deg: float) -> Initial:
    """T_map_lidar at a position and heading; in 3D, height and tilt are those of the nearest keyframe."""

    def pose(stamp_ns: int, prior: SavedMap) -> Pose:
        planar = lie.pose_2d(x_m, y_m, np.radians(yaw_deg))
        if prior.dimension == 2:
            return planar
        poses = prior.poses
        nearest = poses[np.argmin(np.hypot(poses[:, 0, 3] - x_m, poses[:, 1, 3] - y_m))]
        T = lie.lift(planar)
        turn = float(lie.yaw(lie.flatten(nearest)))
        T[:3, :3] = T[:3, :3] @ lie.lift(lie.pose_2d(0.0, 0.0, -turn))[:3, :3] @ nearest[:3, :3]
        T[2, 3] = nearest[2, 3]
        return T

    return pose


def pose_in_file(path: Path) -> Initial:
    """T_map_lidar of the first scan from a TUM file."""
    trajectory = read_tum(path)

    def pose(stamp_ns: int, prior: SavedMap) -> Pose:
        nearest = int(np.argmin(np.abs(trajectory.stamps_ns - stamp_ns)))
        away_s = abs(int(trajectory.stamps_ns[nearest]) - stamp_ns) * 1e-9
        if away_s > _APART_S:
            raise InputError(f"{path}: has no pose within {_APART_S:g} s of the first scan ({away_s:.1f} s away)")
        T = trajectory.poses[nearest]
        return lie.flatten(T) if prior.dimension == 2 else T

    return pose


def lines_of(m: LocalizeMetrics) -> Iterator[tuple[str, str]]:
    """Label and text of each figure, for summary and report."""
    states = ", ".join(f"{count:,} {state}" for state, count in m.states.items() if count)
    yield "states", f"{states}; {m.placed:,} placed in the end"
    if m.found_scan >= 0:
        yield "found", f"at scan {m.found_scan:,}, after {m.found_after_s:.1f} s and {m.found_after_m:.1f} m"
    if m.found_scan >= 0 and np.isfinite(m.log_odds):
        yield "evidence", f"log-odds of {m.log_odds:.0f} that this location is right"
    if m.matches:
        left_out = f", {m.rejected:,} of them rejected" if m.rejected else ""
        yield "matches", f"{m.matches:,} with the map{left_out}; overlap {m.median_overlap:.2f} (median)"
        sigmas = f"{m.median_sigma_m:.3f} m live, {m.median_final_sigma_m:.3f} m final"
        yield "sigma", f"{sigmas}: standard deviation of a position (median)"
    yield from accuracy_lines(m.ground_truth)


def _summary(m: LocalizeMetrics, prior: SavedMap, log: Log, sensor_notes: tuple[str, ...]) -> str:
    """Text of summary.txt."""
    names = ", ".join(session.name for session in prior.sessions)
    paths, scans = ", ".join(map(str, log.paths)), counted(m.scans, "scan")
    return text_of(m.judged, [
        ("log", f"{paths} {log.topics}: {scans} over {m.path_m:.1f} m"),
        ("map", f"{prior.folder}: {counted(m.map_keyframes, 'keyframe')} of {names}"),
        *lines_of(m),
        *(("segment", part.text) for part in m.parts),
        *(("warning", warning) for warning in m.warnings),
        *(("note", note) for note in (*log.notes, *sensor_notes)),
        ("time", f"{m.time_s:.1f} s, {m.scans / max(m.time_s, 1e-9):,.0f} scans/s"),
    ])  # fmt: skip


def _write(folder: Path, localized: LocalizedLog) -> None:
    """Trajectories, summary, metrics and the table: a row per scan, poses null where unknown."""
    found = localized.localization
    if found.is_placed.any():
        write_tum(folder / "trajectory.tum", found.placed)
    write_tum(folder / "odometry.tum", found.result.odometry)
    write_figures(folder, localized.metrics, localized.summary)
    columns: dict[str, pa.Array] = {
        "scan": pa.array(np.arange(len(found.states))),
        "stamp_ns": pa.array(found.trajectory.stamps_ns),
        "state": pa.array(found.states.tolist()),
        "placed": pa.array(found.is_placed),
        "traveled_m": pa.array(found.traveled_m),
        "sigma_m": pa.array(found.sigma_m, from_pandas=True),
        "final_sigma_m": pa.array(found.final_sigma_m, from_pandas=True),
    }
    live, final = (found.live, np.isfinite(found.live[:, 0, 0])), (found.trajectory.poses, found.is_placed)
    for name, (poses, known) in (("live", live), ("final", final)):
        parts = pose_columns(np.where(known[:, None, None], poses, np.eye(poses.shape[-1])))
        for part, values in parts.items():
            unit = "_m" if part in "xyz" else ""
            columns[f"{name}_{part}{unit}"] = pa.array(values, mask=~known)
    table = pa.table(columns).replace_schema_metadata({"dimension": str(localized.prior.dimension)})
    pq.write_table(table, folder / LOCALIZATION_FILE)
