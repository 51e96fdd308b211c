"""Comparison of methods on a log: scans decoded once, every method run on them, figures, tables, pictures."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.ahead import compile_ahead
from scanchain.comparison.methods import Variation, default_names, resolve, shared_settings
from scanchain.comparison.processes import StoredScans, run_all, store
from scanchain.comparison.results import Reference, results_of, summarize, write_results
from scanchain.comparison.table import Table, text, write_table
from scanchain.config import NO_TOPIC
from scanchain.data import Trajectory, brief
from scanchain.errors import InputError, counted
from scanchain.evaluation import absolute_error_of_any_path, pair, read_relations, read_truth, relation_error
from scanchain.files import Source
from scanchain.logs import Log, open_log
from scanchain.odometry.distortion import choose_point_times
from scanchain.processes import MEMORY_SHARE, Limits, available_mib
from scanchain.runs.directory import RunDirectory
from scanchain.runs.job import Progress
from scanchain.settings import Override, load_settings, named

_LEAST_S, _SCAN_S = 300.0, 1.0  # default time limit, seconds: at least, and for each scan
_SHARED = "scans"  # in the directory until it is complete: what all methods read, and where each writes


@dataclass(frozen=True, slots=True)
class Compared:
    """A finished comparison, failed methods included."""

    __repr__ = brief
    path: Path
    table: Table

    @property
    def failures(self) -> list[str]:
        """Names of the methods that started and failed."""
        return [row.name for row in self.table.rows if row.status.is_failure]

    def _repr_html_(self) -> str:
        """The table, which a notebook shows."""
        return f"<pre>{escape(text(self.table))}</pre>"


def compare(
    logs: Sequence[Source],
    out: Path,
    present: Callable[[Path], None],
    progress: Progress,
    *,
    methods: Sequence[str] = (),
    matcher: str = "",
    config_file: Path | None = None,
    overrides: Sequence[Override] = (),
    ground_truth: Path | None = None,
    relations: Path | None = None,
    repeat: int = 1,
    time_s: float | None = None,
    memory_mib: float | None = None,
    force: bool = False,
    command: Sequence[str] = (),
    variation: Variation | None = None,
    needs_all: bool = False,
) -> Compared:
    """Run methods on a log and write the directory ``out``; ``present`` adds report and recording to it.

    methods : names, empty for all that apply; matcher : another one, as in the configuration
    config_file : sections of the configuration and one table per method; overrides : keys of the configuration,
        for the log and all of ours
    ground_truth : a TUM or KITTI file; None for the log's own
    repeat : runs of every method, interleaved
    time_s, memory_mib : limits of a run; None for the default ones
    variation : a setting with another value, for the methods that have it
    needs_all : whether a log whose reading the user stops is not compared; else its scans so far are
    Raises InputError for bad input before anything is run.
    """
    directory = RunDirectory(out, force=force, sources=logs, command=command)
    of_log = (*shared_settings(config_file), *overrides, *(variation.of_log if variation else ()))
    log = open_log(logs, load_settings(overrides=of_log).config.log)
    choose_point_times(log)
    settings = load_settings(log.dimension, overrides=of_log)
    names = methods or default_names(log.dimension, has_imu=log.imu is not None)
    chosen = resolve(
        names, log.dimension, file=config_file, overrides=overrides, matcher=matcher, variation=variation
    )
    with directory:
        directory.begin(", ".join(method.name for method in chosen))
        if any(method.is_ours for method in chosen):
            compile_ahead([f"{log.dimension}d", "rest"], progress.compiling)
        shared = directory.path / _SHARED
        shared.mkdir()
        decoded = progress.track(log.scans(settings.config.preprocess), log.scan_count)
        scans = store(
            decoded, log.T_base_lidar, shared / "scans",
            is_mounted=log.stated_mounting is not None, distorted_share=log.distorted_share,
        )  # fmt: skip
        if progress.stopped and needs_all:
            raise KeyboardInterrupt
        stopped = (
            f"the user stopped the reading: {counted(len(scans), 'scan')} compared" if progress.stopped else ""
        )
        reference = _reference(log, scans, ground_truth, relations, named(of_log, "log.ground_truth_topic"))
        limits = Limits(
            _LEAST_S + _SCAN_S * len(scans) if time_s is None else time_s,
            MEMORY_SHARE * available_mib() if memory_mib is None else memory_mib,
        )
        outcomes = run_all(chosen, scans, shared, repeat=repeat, limits=limits, progress=progress)
        progress.announce("evaluating and drawing")
        results = results_of(chosen, scans, outcomes, reference)
        write_results(directory.path, results)
        directory.end(stopped=stopped)
        table = summarize(results, log, limits, directory.provenance)
        write_table(directory.path, table)
        shutil.rmtree(shared)
        present(directory.path)
        directory.complete()
    return Compared(directory.path, table)


def _reference(
    log: Log, scans: StoredScans, truth_file: Path | None, relations_file: Path | None, topic: str
) -> Reference:
    """Reference of the errors, checked against the log before any method is run."""
    standing = Trajectory(scans.stamps_ns, np.tile(lie.identity(scans.dimension), (len(scans), 1, 1)))
    relations, note = None, ""
    if relations_file is not None:
        relations = read_relations(relations_file)
        relation_error(standing, relations)
    truth, source = log.ground_truth(), log.ground_truth_topic
    if truth_file is not None:
        truth, source = read_truth(truth_file).at(scans.stamps_ns), str(truth_file)
    elif topic not in ("", NO_TOPIC) and truth is None:
        raise InputError(f"{log.name}: has no poses on {topic}; scanchain info lists the topics that have")
    if truth is not None:
        try:
            pairs = pair(standing, truth)
            absolute_error_of_any_path(pairs)
            note = pairs.missing and f"Of {len(scans):,} scans {pairs.missing}"
        except InputError as error:
            if truth_file is not None or topic:
                raise
            truth, note = None, f"No accuracy against {source}: {error.text}"
    sources = [source] if truth is not None else []
    sources += [str(relations_file)] if relations is not None else []
    return Reference(truth, relations, " and ".join(sources), note)
