"""The commands as functions, and the map and verdict of a SLAM result as of a run."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scanchain import checks
from scanchain.data import AnyPoints, Points, Pose
from scanchain.errors import ScanchainError
from scanchain.graph.pose_graph import PoseGraph
from scanchain.logs import sources_of
from scanchain.preprocess import downsample as first_per_voxel
from scanchain.runs.closures import closures_table, final_verdicts
from scanchain.runs.evidence import evidence_of
from scanchain.runs.job import Job, Progress
from scanchain.runs.results import cloud_of, expected_of
from scanchain.runs.run import Finished
from scanchain.runs.run import run as run_job
from scanchain.runs.step_table import steps_table
from scanchain.settings import load_settings, overrides_of
from scanchain.slam import SlamResult
from scanchain.verdict import Judged
from scanchain.verdict import judge as judge_evidence

if TYPE_CHECKING:
    from scanchain.comparison.compare import Compared
    from scanchain.graph.optimization import Optimization
    from scanchain.sessions.changes import Changes
    from scanchain.sessions.localize import LocalizedLog
    from scanchain.sessions.merging import Merged
    from scanchain_viz.recording.recording import Recording

Logs = str | Path | Sequence[str | Path]


@contextmanager
def _freeing() -> Iterator[None]:
    """Context that clears the frames of errors: one that the caller keeps then keeps no log or map alive."""
    try:
        yield
    except (ScanchainError, KeyboardInterrupt) as error:
        each: BaseException | None = error
        while each is not None:
            traceback.clear_frames(each.__traceback__)
            each = each.__cause__ or each.__context__
        raise


def cloud(result: SlamResult) -> Points:
    """(M, d) points of the map of a SLAM result, moving objects removed, as in the map.ply of a run."""
    return cloud_of(result.keyframes, result.T_world_keyframes, result.config).points


def judge(result: SlamResult) -> Judged:
    """The verdict on a SLAM result, with reasons and segments, by the same checks as for a run."""
    final, expected = final_verdicts(result.closures, result.state), expected_of(result)
    table = closures_table(final, result.keyframes, result.trajectory.dimension)
    steps = steps_table(result.steps, result.trajectory, result.T_base_lidar)
    return judge_evidence(evidence_of(steps, table, expected and expected.ate), result.T_base_lidar)


@_freeing()
def run(
    log: Logs,
    out: str | Path,
    *,
    config: str | Path | None = None,
    ground_truth: str | Path | None = None,
    recording: bool = True,
    force: bool = False,
    **overrides: object,
) -> Finished:
    """Process a log into a run directory, as ``scanchain run`` does; nothing is printed.

    log : a file, a folder, an address, or the files of one log
    out : the directory to create; with ``force`` an earlier run there is replaced
    config : a TOML file on top of the preset
    ground_truth : a TUM or KITTI file of true poses
    recording : whether a rerun recording is written
    overrides : keys of the configuration, two underscores for the dot: ``loops__drift=0.02``
    Returns path, metrics, summary and warnings; ``metrics.verdict`` says whether to rely on it.
    Raises InputError for bad input.
    """
    file, truth = _optional_path(config, "config"), _optional_path(ground_truth, "ground_truth")
    job = _job(log, out, recording, overrides, config_file=file, ground_truth=truth, force=force)
    return run_job(job, open_recorder, Progress(), write_report)


@_freeing()
def localize(
    log: Logs,
    prior: str | Path,
    out: str | Path,
    *,
    config: str | Path | None = None,
    ground_truth: str | Path | None = None,
    recording: bool = True,
    force: bool = False,
    **overrides: object,
) -> LocalizedLog:
    """Localize a log in the map of an earlier run, as ``scanchain localize`` does; nothing is printed.

    prior : the run directory that holds the map
    Other arguments as in ``run``; without ``recording`` there is no report either.
    Returns path, metrics and poses. Raises InputError for bad input.
    """
    from scanchain.sessions.localize import localize as localize_log
    from scanchain_viz.recording.results import present_localization

    file, truth = _optional_path(config, "config"), _optional_path(ground_truth, "ground_truth")
    job = _job(log, out, recording, overrides, config_file=file, ground_truth=truth, force=force)
    draw = present_localization if recording else lambda folder, localized: None
    return localize_log(job, checks.path(prior, "prior"), Progress(), draw)


def _job(log: Logs, out: str | Path, recording: bool, overrides: dict[str, object], **more: Any) -> Job:
    files = sources_of(log), checks.path(out, "out")
    return Job(*files, overrides=overrides_of(overrides), sinks=frozenset({"save"} if recording else ()), **more)


def _optional_path(value: object, name: str) -> Path | None:
    return None if value is None else checks.path(value, name)


@_freeing()
def merge(
    runs: Sequence[str | Path],
    out: str | Path,
    *,
    config: str | Path | None = None,
    fixed: bool = False,
    update: bool = False,
    force: bool = False,
    **overrides: object,
) -> Merged:
    """Merge the maps of run directories into one, as ``scanchain merge`` does; nothing is printed.

    runs : two or more; the map is in the frame of the first, whose poses stay as they are if ``fixed``
    update : whether points that newer sessions saw through are removed from the keyframes of older ones
    Other arguments as in ``run``. Returns path, metrics, summary and warnings: runs that could not be joined
    to the map are named there. Raises InputError for bad input, ScanchainError if no two runs can be joined.
    """
    from scanchain.sessions.merging import merge as merge_maps
    from scanchain_viz.recording.results import present_merge

    job = Job(
        tuple(checks.path(run, "runs") for run in runs),
        checks.path(out, "out"),
        _optional_path(config, "config"),
        overrides_of(overrides),
        force=force,
    )
    is_fixed, is_updated = checks.truth(fixed, "fixed"), checks.truth(update, "update")
    return merge_maps(job, Progress(), present_merge, fixed=is_fixed, update=is_updated)


@_freeing()
def changes(
    earlier: str | Path,
    later: str | Path | None,
    out: str | Path,
    *,
    T_earlier_later: Pose | None = None,
    voxel_size_m: float | None = None,
    min_size_m: float = 0.2,
    recording: bool = True,
    force: bool = False,
) -> Changes:
    """Compare two maps of the same place, as ``scanchain changes`` does; nothing is printed.

    earlier, later : run directories; None compares the newest session of a merged map with all before it
    T_earlier_later : (d+1, d+1) if known; estimated from loop closures if omitted
    voxel_size_m : resolution; that of the maps if omitted. min_size_m : smallest length of a change
    recording : whether report and recording are written
    Returns points, labels and clusters. Raises InputError for bad input, and for maps of different places.
    """
    from scanchain.sessions.change_run import compare_maps
    from scanchain_viz.recording.results import present_changes

    maps = [checks.path(earlier, "earlier"), _optional_path(later, "later")]
    return compare_maps(
        [each for each in maps if each is not None],
        checks.path(out, "out"),
        present_changes if recording else lambda directory, found: None,
        T_earlier_later=T_earlier_later,
        voxel_size_m=None if voxel_size_m is None else checks.positive(voxel_size_m, "voxel_size_m"),
        min_size_m=checks.positive(min_size_m, "min_size_m"),
        force=force,
    )


@_freeing()
def compare(
    log: Logs,
    out: str | Path,
    methods: Sequence[str] = (),
    *,
    ground_truth: str | Path | None = None,
    repeat: int = 1,
    force: bool = False,
    **overrides: object,
) -> Compared:
    """Run several methods over the same scans, as ``scanchain compare`` does; nothing is printed.

    methods : names such as "plicp", "kiss-icp" or "module:Class"; by default all that apply to the log
    repeat : runs of each method, interleaved
    Other arguments as in ``run``. Returns path and table. Raises InputError for bad input.
    """
    from scanchain.comparison.compare import compare as run_comparison
    from scanchain_viz.recording.results import present_comparison

    return run_comparison(
        sources_of(log),
        checks.path(out, "out"),
        present_comparison,
        Progress(),
        methods=(methods,) if isinstance(methods, str) else tuple(methods),
        overrides=overrides_of(overrides),
        ground_truth=_optional_path(ground_truth, "ground_truth"),
        repeat=repeat,
        force=force,
    )


def optimize(graph: PoseGraph, **overrides: object) -> Optimization:
    """Move the poses of a graph to the minimum of χ², as ``scanchain optimize`` does.

    overrides : keys of ``[graph]``, such as robust="truncated" where loops may be wrong; by default none is
    Returns state, χ² before and after, iterations, ``converged`` and ``reason``.
    Raises InputError if the graph is disconnected.
    """
    checks.instance(graph, PoseGraph, "graph", "read_g2o(path).graph")
    given = {name.removeprefix("graph__"): value for name, value in overrides.items()}
    changes = overrides_of({"robust": "none"} | given, "graph")
    return graph.optimize(load_settings(graph.dimension, overrides=changes).config.graph)


def downsample(points: AnyPoints, voxel_size_m: float) -> Points:
    """The first finite point of every voxel, (M, d), in the order of the points (N, d). Raises InputError."""
    valid, _ = checks.valid_points(points, "points")
    return first_per_voxel(valid, checks.positive(voxel_size_m, "voxel_size_m"))


def open_recorder(path: Path | None, **options: Any) -> Recording:
    """A rerun recording, which takes half a second to import."""
    from scanchain_viz.recording.recording import Recording

    return Recording(path, **options)


def write_report(directory: Path) -> None:
    """Add report.html to a run directory."""
    from scanchain_viz.report.run import write_run_report

    write_run_report(directory)
