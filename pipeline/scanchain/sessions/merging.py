"""Merging of the maps of several runs into one map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec

from scanchain.ahead import compile_ahead
from scanchain.clock import announcing_compilation, compiled_s, working_s
from scanchain.config import Config
from scanchain.data import REJECTED_WEIGHT, Closure, ClosureVerdict, brief
from scanchain.errors import InputError, ScanchainError, counted
from scanchain.graph.optimization import fit
from scanchain.maps import MAP_FOLDER, SavedMap, Session
from scanchain.runs.directory import RunDirectory, write_figures
from scanchain.runs.job import Job, Progress
from scanchain.runs.metrics import removed
from scanchain.runs.results import Cloud, cloud_of
from scanchain.sessions.alignment import opened_maps
from scanchain.sessions.joining import Joined, UncertainJoin, changed, graph_of, join_all
from scanchain.sessions.merged_map import MergedMap, final_closures, merged_map, session_names, write_merged
from scanchain.settings import load_settings


class SessionMetrics(Session, frozen=True):
    """A session as it is in the merged map.

    closures : number in force between it and other maps
    removed_points : number of points of its keyframes that newer sessions saw through; 0 without an update
    """

    closures: int
    removed_points: int = 0


class MergeMetrics(msgspec.Struct, frozen=True):
    """Contents of metrics.json of a merge.

    sessions : in the map, in chronological order
    apart : sessions that are not in it, in groups that belong together
    closures_tried, closures_in_force : numbers of closures between maps
    chi2, degrees_of_freedom, certified, certificate : of the pose graph
    map_points, moving_points_removed : of map.ply
    updated : whether points that newer sessions saw through were removed
    uncertain : joins without enough evidence
    run_s : wall time, without compilation
    """

    dimension: int
    sessions: tuple[SessionMetrics, ...]
    keyframes: int
    closures_tried: int
    closures_in_force: int
    chi2: float
    degrees_of_freedom: int
    fit: str
    certified: bool
    certificate: str
    map_points: int
    moving_points_removed: int
    apart: tuple[tuple[str, ...], ...] = ()
    uncertain: tuple[UncertainJoin, ...] = ()
    warnings: tuple[str, ...] = ()
    updated: bool = False
    run_s: float = 0.0
    compile_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Merged:
    """A finished merge: its directory, metrics, summary and warnings."""

    __repr__ = brief
    path: Path
    metrics: MergeMetrics
    summary: str
    warnings: tuple[str, ...]


def merge(
    job: Job, progress: Progress, report: Callable[[Path], None], *, fixed: bool = False, update: bool = False
) -> Merged:
    """Merge the maps of runs into a new run directory, to which ``report`` then adds report and recording.

    job : its ``logs`` are run directories, or map folders; the first one's frame is that of the merged map
    fixed : whether the poses of the first run's keyframes stay the same, bit for bit
    update : whether points that newer sessions saw through are removed from the keyframes of older ones
    Raises InputError for bad input, and ScanchainError where no two maps belong together.
    """
    started, compiled_before_s = working_s(), compiled_s()
    maps = _opened([Path(str(run)) for run in job.logs], job.out)
    if update:
        _check_order([session for saved in maps for session in saved.sessions])
    settings = load_settings(maps[0].dimension, file=job.config_file, overrides=job.overrides)
    config, held, folders = settings.config, 0 if fixed else -1, [saved.folder for saved in maps]
    order = _canonical(maps, held)
    names = session_names(maps, order)
    directory = RunDirectory(job.out, force=job.force, sources=folders, command=job.command)
    with directory, announcing_compilation(progress.say):
        directory.begin(settings.source, config)
        compile_ahead([f"{maps[0].dimension}d", "rest"], progress.compiling)
        groups, uncertain = join_all(maps, order, [each[0] for each in names], config, held, progress.say)
        joined = _chosen(groups, held, maps, uncertain)
        progress.say(f"making the map of {counted(len(joined.keyframes), 'keyframe')}")
        first, folder = min(joined.maps), directory.path / MAP_FOLDER
        merged = merged_map(joined, maps, names, config, folder=folder, first=first, held=held, update=update)
        cloud, final = cloud_of(merged.saved.keyframes, merged.saved.poses, config), final_closures(merged)
        write_merged(directory.path, merged, cloud, final, config)
        others = (group.maps for group in groups if group is not joined)
        apart = tuple(tuple(name for number in group for name in names[number]) for group in others)
        different = (_changed_text(names[number][0], share) for number, share in changed(joined).items())
        warnings = (*(_apart_text(each, uncertain) for each in apart), *different, *merged.warnings)
        compile_s, run_s = compiled_s() - compiled_before_s, working_s() - started
        metrics = _measured(
            merged, cloud, final, config, held, apart=apart, uncertain=tuple(uncertain), warnings=warnings,
            updated=update, run_s=run_s, compile_s=compile_s,
        )  # fmt: skip
        text = _summary(metrics, names[first][0], settings.source, fixed=fixed)
        write_figures(directory.path, metrics, text)
        directory.end(duration_s=run_s + compile_s)
        progress.say("drawing the report")
        report(directory.path)
        directory.complete()
    return Merged(directory.path, metrics, text, warnings)


def _opened(runs: Sequence[Path], out: Path) -> list[SavedMap]:
    """The maps of runs. Raises InputError where they cannot be merged."""
    if len(runs) < 2:
        raise InputError("merge needs at least two run directories; give another one")
    maps = opened_maps(runs, out)
    holders: dict[tuple[int, ...], Path] = {}
    for run, saved in zip(runs, maps, strict=True):
        if not len(saved.edges.pairs) and len(saved.keyframes) > 1:
            raise InputError(f"{run}: no edges join its keyframes, as in an imported map; merge takes runs")
        owned = list(zip(saved.session.tolist(), saved.keyframes, strict=True))
        for number in range(len(saved.sessions)):
            key = tuple(keyframe.stamp_ns for session, keyframe in owned if session == number)
            if key in holders:
                raise InputError(f"{run}: holds a session that {holders[key]} also holds; leave one of them out")
            holders[key] = run
    return maps


def _check_order(sessions: Sequence[Session]) -> None:
    """Raise InputError where it is not known which of two sessions is the newer one."""
    for before, after in pairwise(sorted(sessions, key=lambda session: session.first_stamp_ns)):
        if before.first_stamp_ns == after.first_stamp_ns:
            raise InputError(
                f"{before.name}, {after.name}: begin at the same time, so neither is newer; leave out --update"
            )


def _canonical(maps: Sequence[SavedMap], held: int) -> list[int]:
    """Numbers of the maps in canonical order: the fixed one first, then by decreasing size."""

    def key(number: int) -> tuple[object, ...]:
        saved = maps[number]
        stamps = [(session.first_stamp_ns, session.last_stamp_ns) for session in saved.sessions]
        return (number != held, -len(saved.keyframes), saved.name, stamps)

    return sorted(range(len(maps)), key=key)


def _chosen(
    groups: Sequence[Joined], held: int, maps: Sequence[SavedMap], uncertain: Sequence[UncertainJoin]
) -> Joined:
    """The group with the fixed map, else the one with the most maps or, if equal, the most keyframes."""
    chosen = max(groups, key=lambda group: (held in group.maps, len(group.maps), len(group.keyframes)))
    if len(chosen.maps) > 1:
        return chosen
    what = "no two of the maps belong together"
    if held >= 0:
        what = f"nothing belongs to {maps[held].folder.parent}"
    if uncertain:
        raise ScanchainError(f"{what} for certain: {'; '.join(each.text for each in uncertain)}")
    raise ScanchainError(
        f"{what}: too few closures between them agree; merge runs that saw the same place, or raise "
        "--loops.max_radius_m where they have drifted far"
    )


def _apart_text(names: Sequence[str], uncertain: Sequence[UncertainJoin]) -> str:
    reasons = "; ".join(each.text for each in uncertain if {each.session, each.frame} & set(names))
    together = "; they belong together: merge them on their own" if len(names) > 1 else ""
    return f"{', '.join(names)}: not in this map; {reasons or 'too few closures agree'}{together}"


def _changed_text(name: str, share: float) -> str:
    return (
        f"{name}: {100.0 * share:.1f} % of what both it and the others observed differs: much has changed, or "
        "it was recorded on another floor with the same plan; in that case, leave it out"
    )


def _measured(
    merged: MergedMap, cloud: Cloud, final: Sequence[Closure], config: Config, held: int, **of_merge: Any
) -> MergeMetrics:
    """The metrics of a merged map; ``of_merge`` are the fields about the merge itself."""
    joined, saved, graph = merged.joined, merged.saved, graph_of(merged.joined, held)
    state = graph.optimize(config.graph, initialize="given").state
    certificate = graph.certify()
    ends = saved.session[joined.edges.pairs[joined.is_between & (joined.edges.weight >= REJECTED_WEIGHT)]]
    sessions = (
        SessionMetrics(
            *msgspec.structs.astuple(each),
            closures=int((ends == number).any(axis=1).sum()),
            removed_points=int(merged.removed[saved.session == number].sum()),
        )
        for number, each in enumerate(saved.sessions)
    )
    return MergeMetrics(
        dimension=joined.dimension,
        sessions=tuple(sessions),
        keyframes=len(saved.keyframes),
        closures_tried=len(final),
        closures_in_force=sum(item.verdict is ClosureVerdict.ACCEPTED for item in final),
        chi2=state.chi2,
        degrees_of_freedom=state.degrees_of_freedom,
        fit=fit(state),
        certified=certificate.certified,
        certificate=certificate.verdict,
        map_points=len(cloud.points),
        moving_points_removed=cloud.removed,
        **of_merge,
    )


def _summary(m: MergeMetrics, first: str, configuration: str, *, fixed: bool) -> str:
    """The metrics as text."""
    width = max(len(each.name) for each in m.sessions)
    lines = [
        f"merged         {counted(len(m.sessions), 'session')} in the frame of {first}"
        + (", whose poses are fixed" if fixed else ""),
        *(
            f"session        {each.name:<{width}}  {counted(each.keyframes, 'keyframe')}, "
            f"{counted(each.closures, 'closure')} to other sessions"
            + (f", {counted(each.removed_points, 'point')} removed as gone" if m.updated else "")
            for each in m.sessions
        ),
        *(f"apart          {warning}" for warning in m.warnings[: len(m.apart)]),
        *(f"warning        {warning}" for warning in m.warnings[len(m.apart) :]),
        f"configuration  {configuration}",
        f"closures       {m.closures_tried:,} tried between maps, {m.closures_in_force:,} in force",
        f"pose graph     {m.fit}",
        f"certificate    {m.certificate}",
        f"map            {counted(m.map_points, 'point')}{removed(m.moving_points_removed)}",
        f"time           {m.run_s:.1f} s"
        + (f" (and {m.compile_s:.0f} s compiling)" if m.compile_s >= 1.0 else ""),
    ]
    return "\n".join(lines) + "\n"
