"""``scanchain localize``: a log and a map in, a directory with poses in the map's frame out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct, json
from msgspec.structs import replace
from numpy.typing import NDArray

from scanchain import lie
from scanchain.clock import working_s
from scanchain.config import Config
from scanchain.data import ClosureVerdict, Pose, Trajectory, brief
from scanchain.errors import InputError
from scanchain.logs import Log, open_log
from scanchain.maps import SavedMap, open_saved_map
from scanchain.runs.directory import POINTS_FILE, RUN_FILE, RunDirectory
from scanchain.runs.job import Progress
from scanchain.runs.provenance import Hashing, describe_start
from scanchain.sessions.localizer import Localization, Localizer, MapState
from scanchain.settings import Override, dump, load_settings
from scanchain.source import Source
from scanchain.trajectory import write_tum
from scanchain.verdict import Verdict
from scanchain.whole_file import write_whole
from scanchain.words import counted

LOCALIZATION_FILE = "localization.parquet"
_SHORT_M = {2: 5.0, 3: 20.0}  # path below which a place that is not found says nothing
_WITHOUT_MAP_M = {2: 2.0, 3: 10.0}  # shortest path without the map that is told as a stretch
_MOVED_M, _MOVED_SIGMAS = 0.3, 5.0  # between a pose as known at its time and in the end, that is told
_SHOWN = 3  # stretches that the verdict lists


@dataclass(frozen=True, slots=True)
class Localizing:
    """A log to localize.

    Attributes
    ----------
    logs : the files of one log; prior : run directory, or folder, of the map; out : the directory to create
    initial : T_map_lidar of the first scan, where known: a function of the stamp of that scan and of the map
    config_file, overrides, force, command : as in ``scanchain.runs.job.Job``
    """

    logs: tuple[Source, ...]
    prior: Path
    out: Path
    initial: Callable[[int, SavedMap], Pose] | None = None
    config_file: Path | None = None
    overrides: tuple[Override, ...] = ()
    force: bool = False
    command: tuple[str, ...] = ()


class Part(Struct, frozen=True):
    """Consecutive scans whose place is less certain, or not known: first and last, seconds, meters of path."""

    kind: str
    first: int
    last: int
    start_s: float
    end_s: float
    length_m: float

    @property
    def text(self) -> str:
        """The part in words."""
        return (
            f"scans {self.first:,} to {self.last:,} ({self.start_s:.1f} to {self.end_s:.1f} s, "
            f"{self.length_m:.1f} m): {self.kind}"
        )


class LocalizeMetrics(Struct, frozen=True):
    """Contents of metrics.json of a localized log.

    ``found_*`` say where the place of the log was first known; −1 and NaN where it never was. ``matches`` are
    closures of keyframes with the map, ``rejected`` those that the graph left out in the end.
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
    time_s: float
    warnings: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """Verdict and reason."""
        return f"{self.verdict}: {self.reason}"


@dataclass(frozen=True, slots=True)
class LocalizedLog:
    """A localized log for report and recording: its directory, the map, its poses in it, the metrics."""

    __repr__ = brief
    path: Path
    prior: SavedMap
    localization: Localization
    metrics: LocalizeMetrics


Draw = Callable[[Path, LocalizedLog], None]


def localize(
    job: Localizing, progress: Progress, draw: Draw = lambda folder, localized: None
) -> tuple[LocalizedLog, str]:
    """Localize a log; returns what is in the directory, and the summary.

    draw : adds report and recording to the folder
    Raises InputError for a log or a map that cannot be read.
    """
    started = working_s()
    prior = _opened(job)
    RunDirectory(job.out, force=job.force)  # refused before the log is read
    early = load_settings(file=job.config_file, overrides=job.overrides)
    log = open_log(job.logs, early.config.log)
    settings = load_settings(log.dimension, file=job.config_file, overrides=job.overrides, idle=log.idle_keys())
    _check(log, prior, settings.config)
    progress.say(f"{log.topic}: {counted(log.scan_count, 'scan')}; map {prior.name}")
    provenance = describe_start(job.command, job.logs, settings.source)
    with RunDirectory(job.out, force=job.force) as directory, Hashing(job.logs) as hashing:
        provenance.write(directory.path / RUN_FILE)
        write_whole(directory.path / "config.toml", dump(settings.config).encode())
        scans = log.scans(settings.config.preprocess)
        localizer: Localizer | None = None
        with closing(scans):
            for scan in progress.track(scans, log.scan_count):
                if localizer is None:
                    initial = None if job.initial is None else job.initial(scan.stamp_ns, prior)
                    points_file = directory.path / POINTS_FILE
                    localizer = Localizer(
                        prior,
                        settings.config,
                        log.T_base_lidar,
                        initial=initial,
                        points_file=points_file,
                        is_live=False,
                    )
                localizer.process(scan)
        if localizer is None:
            raise InputError(f"{log.name}: has no scan to localize; scanchain doctor says why")
        progress.say("smoothing the path")
        found = localizer.finish()
        count = counted(len(found.states), "scan")
        stopped = (f"stopped by the user after {count}",) if progress.stopped else ()
        warnings = (*stopped, *log.damage, *log.copies, *settings.without_effect)
        metrics = measure(found, prior, working_s() - started, warnings)
        localized = LocalizedLog(directory.path, prior, found, metrics)
        text = summary(localized, log)
        progress.say("writing the results")
        with directory.results() as folder:
            _write(folder, localized, text)
            draw(folder, localized)
        localizer.slam.points.close()
        (directory.path / POINTS_FILE).unlink(missing_ok=True)
        made = replace(
            provenance.hashed(hashing), complete=True, stopped="".join(stopped), duration_s=working_s() - started
        )
        made.write(directory.path / RUN_FILE)
        directory.complete()
    return localized, text


def _opened(job: Localizing) -> SavedMap:
    """The map of a job. Raises InputError where it cannot be read, or the results would replace it."""
    prior = open_saved_map(job.prior)
    if job.out.resolve() in (job.prior.resolve(), prior.folder.resolve()):
        raise InputError(f"{job.out}: is the map; choose another --out")
    return prior


def _check(log: Log, prior: SavedMap, config: Config) -> None:
    if not config.loops.enabled:
        raise InputError("loops.enabled is false, but a place in a map is found by loop closures; leave it true")
    if log.dimension != prior.dimension:
        raise InputError(
            f"{log.name}: has {log.dimension}D scans, the map {prior.name} is {prior.dimension}D; give a map of "
            "the same kind"
        )


def measure(found: Localization, prior: SavedMap, time_s: float, warnings: tuple[str, ...]) -> LocalizeMetrics:
    """Figures and verdict of a localized log."""
    first = found.found_at
    seconds = (found.trajectory.stamps_ns - found.trajectory.stamps_ns[0]) * 1e-9
    with_map = [each for each in found.closures if each.verdict is ClosureVerdict.ACCEPTED]
    graph = found.result.graph
    in_map = graph.is_loop & (graph.edges[:, 0] < len(prior.keyframes))
    rejected = int((graph.is_rejected & in_map).sum())
    parts = tuple(_parts(found, seconds))
    verdict, reason = _verdict(found, prior, parts)
    sigma_m = found.sigma_m[np.isfinite(found.sigma_m)]
    return LocalizeMetrics(
        verdict=verdict,
        reason=reason,
        parts=parts,
        map=str(prior.folder),
        map_keyframes=len(prior.keyframes),
        scans=len(found.states),
        placed=int(found.is_placed.sum()),
        states={state: int((found.states == state).sum()) for state in MapState},
        found_scan=first,
        found_after_s=float(seconds[first]) if first >= 0 else np.nan,
        found_after_m=float(found.traveled_m[first]) if first >= 0 else np.nan,
        path_m=float(found.traveled_m[-1]),
        matches=len(with_map),
        rejected=rejected,
        median_overlap=float(np.median([each.overlap for each in with_map])) if with_map else np.nan,
        median_sigma_m=float(np.median(sigma_m)) if len(sigma_m) else np.nan,
        time_s=time_s,
        warnings=warnings,
    )


def _parts(found: Localization, seconds: NDArray[np.float64]) -> Iterator[Part]:
    """Parts of a log that is in the map whose place is uncertain, unknown, or was other than it was said."""
    if found.found_at < 0:
        return
    dimension = found.trajectory.dimension
    after = np.arange(len(found.states)) >= found.found_at
    away_m = np.linalg.norm((found.live - found.trajectory.poses)[:, :-1, -1], axis=1)
    wrong = found.is_placed & (away_m > np.maximum(_MOVED_M, _MOVED_SIGMAS * found.sigma_m))
    kinds = (
        ("not joined to the map", ~found.is_placed, 0.0),
        ("lost", after & found.is_placed & (found.states == MapState.LOST), 0.0),
        ("place unknown at the time", after & found.is_placed & (found.states == MapState.SEARCHING), 0.0),
        (MapState.WITHOUT_MAP.value, found.is_placed & (found.states == MapState.WITHOUT_MAP), 1.0),
        ("place corrected later", wrong, 0.0),
    )
    for kind, chosen, shortest in kinds:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]])))
        for begin, end in edges.reshape(-1, 2).tolist():
            length_m = float(found.traveled_m[end - 1] - found.traveled_m[begin])
            if length_m >= shortest * _WITHOUT_MAP_M[dimension]:
                yield Part(kind, begin, end - 1, float(seconds[begin]), float(seconds[end - 1]), length_m)


def _verdict(found: Localization, prior: SavedMap, parts: tuple[Part, ...]) -> tuple[Verdict, str]:
    scans, path_m = len(found.states), float(found.traveled_m[-1])
    tried = f"{counted(scans, 'scan')} over {path_m:.1f} m"
    if not found.is_placed.any():
        if path_m < _SHORT_M[found.trajectory.dimension]:
            return Verdict.NOT_TRUSTWORTHY, f"not found in {prior.name}: {tried} are too short a way to tell"
        return Verdict.NOT_TRUSTWORTHY, f"not from this place: nothing in {tried} is in {prior.name}"
    at = found.found_at
    where = f"found in {prior.name}" + (f" after {found.traveled_m[at]:.1f} m" if at >= 0 else " in the end")
    doubtful = [part for part in parts if part.kind != MapState.WITHOUT_MAP]
    outside = int((found.states == MapState.WITHOUT_MAP).sum())
    if not doubtful:
        share = f", {100.0 * outside / scans:.0f} % of them not matched to the map" if outside else ""
        return Verdict.TRUSTWORTHY, f"{where}, and followed: {tried}{share}"
    largest = sorted(doubtful, key=lambda part: part.length_m, reverse=True)[:_SHOWN]
    more = len(doubtful) - len(largest)
    listed = "; ".join(part.text for part in largest) + (f"; and {more:,} more" if more else "")
    return Verdict.CHECK, f"{where}; {listed}"


def summary(localized: LocalizedLog, log: Log) -> str:
    """Text of summary.txt."""
    m, prior = localized.metrics, localized.prior
    names = ", ".join(session.name for session in prior.sessions)
    states = ", ".join(f"{count:,} {state}" for state, count in Counter(m.states).items() if count)
    lines = [
        ("verdict", m.sentence),
        ("log", f"{', '.join(map(str, log.paths))} {log.topic}: {counted(m.scans, 'scan')} over {m.path_m:.1f} m"),
        ("map", f"{prior.folder}: {counted(m.map_keyframes, 'keyframe')} of {names}"),
        ("states", f"{states}; {m.placed:,} placed in the end"),
    ]
    if m.found_scan >= 0:
        lines.append(
            ("found", f"at scan {m.found_scan:,}, after {m.found_after_s:.1f} s and {m.found_after_m:.1f} m")
        )
    if m.matches:
        left_out = f", {m.rejected:,} of them left out" if m.rejected else ""
        lines.append(("matches", f"{m.matches:,} with the map{left_out}; overlap {m.median_overlap:.2f} (median)"))
        lines.append(("sigma", f"{m.median_sigma_m:.3f} m, standard deviation of a position at its time (median)"))
    lines += [("stretch", part.text) for part in m.parts]
    lines += [("warning", warning) for warning in m.warnings]
    rate = f"{m.scans / max(m.time_s, 1e-9):,.0f} scans/s"
    lines.append(("time", f"{m.time_s:.1f} s, {rate}"))
    return "".join(f"{name:<15}{text}\n" for name, text in lines)


def _write(folder: Path, localized: LocalizedLog, text: str) -> None:
    found, dimension = localized.localization, localized.prior.dimension
    placed = found.is_placed
    if placed.any():
        trajectory = found.trajectory
        write_tum(folder / "trajectory.tum", Trajectory(trajectory.stamps_ns[placed], trajectory.poses[placed]))
    write_tum(folder / "odometry.tum", found.result.odometry)
    _write_table(folder / LOCALIZATION_FILE, found, dimension)
    (folder / "summary.txt").write_text(text, encoding="utf-8")
    (folder / "metrics.json").write_bytes(json.format(json.encode(localized.metrics), indent=2) + b"\n")


def _write_table(path: Path, found: Localization, dimension: int) -> None:
    """A row a scan: state and pose at its time, and the final pose, null where unknown."""
    final = np.where(found.is_placed[:, None, None], found.trajectory.poses, np.nan)
    columns: dict[str, pa.Array] = {
        "scan": pa.array(np.arange(len(found.states))),
        "stamp_ns": pa.array(found.trajectory.stamps_ns),
        "state": pa.array(found.states.tolist()),
        "placed": pa.array(found.is_placed),
        "traveled_m": pa.array(found.traveled_m),
        "sigma_m": pa.array(found.sigma_m, from_pandas=True),
    }
    for name, poses in (("live", found.live), ("final", final)):
        spatial = lie.lift(poses)
        known = np.isfinite(spatial[:, 0, 3])
        quaternions = np.full((len(poses), 4), np.nan)
        quaternions[known] = lie.to_quaternion(spatial[known, :3, :3])
        values = np.column_stack([spatial[:, :3, 3], quaternions])
        for column, part in enumerate(("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")):
            columns[f"{name}_{part}"] = pa.array(values[:, column], from_pandas=True)
    metadata = {"dimension": str(dimension)}
    pq.write_table(pa.table(columns).replace_schema_metadata(metadata), path)
