"""Which method is better on a log: scans decoded once, every method over them, figures, tables, pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import msgspec
import numpy as np

from scanchain import lie
from scanchain.comparison.judging import judge
from scanchain.comparison.methods import default_names, resolve
from scanchain.comparison.processes import limits_for, race
from scanchain.comparison.results import Evidence, Reference, write_evidence
from scanchain.comparison.scan_store import StoredScans, store
from scanchain.comparison.table import Table, maps_of, summarize, write_table
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import pair, read_relations, read_truth, relation_error
from scanchain.logs import Log, open_log
from scanchain.runs.directory import RUN_FILE, RunDirectory
from scanchain.runs.job import Progress
from scanchain.runs.provenance import Hashing, describe_start
from scanchain.settings import Override, load_settings, named
from scanchain.source import Source
from scanchain.words import counted


@dataclass(frozen=True, slots=True)
class Contest:
    """What is to be compared.

    Attributes
    ----------
    logs : the files of one log
    out : the directory to make
    methods : names; none are all that make sense; matcher : one of the configuration's, compared as well
    settings_file : a table a method; overrides : keys of the configuration, for the log and all of ours
    ground_truth : a TUM or KITTI file; None where the log's own is good
    relations : a file of relations
    repeat : runs of every method, in turn
    time_s, memory_mib : limits of a run; None for the default ones
    force : whether a directory of that name is replaced
    command : the command line, for the report
    """

    logs: tuple[Source, ...]
    out: Path
    methods: tuple[str, ...] = ()
    matcher: str = ""
    settings_file: Path | None = None
    overrides: tuple[Override, ...] = ()
    ground_truth: Path | None = None
    relations: Path | None = None
    repeat: int = 1
    time_s: float | None = None
    memory_mib: float | None = None
    force: bool = False
    command: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Compared:
    """A comparison that came to its end, failed methods or not."""

    path: Path
    table: Table

    @property
    def failures(self) -> list[str]:
        """Names of the methods that began and did not end well."""
        return [row.name for row in self.table.rows if row.status.is_failure]


def compare(contest: Contest, present: Callable[[Path], None], progress: Progress) -> Compared:
    """Run the contest and write its directory; ``present`` adds report and recording to what lies there.

    Raises InputError for bad input before anything is run.
    """
    began = perf_counter()
    log = open_log(contest.logs, load_settings(overrides=contest.overrides).config.log)
    settings = load_settings(log.dimension, overrides=contest.overrides, idle=log.idle_keys())
    methods = resolve(
        contest.methods or default_names(log.dimension),
        log.dimension,
        file=contest.settings_file,
        overrides=contest.overrides,
        matcher=contest.matcher,
    )
    for line in settings.without_effect:
        progress.tell(line)
    directory = RunDirectory(contest.out, force=contest.force)
    provenance = describe_start(contest.command, contest.logs, ", ".join(method.name for method in methods))
    with directory, Hashing(contest.logs) as hashing, TemporaryDirectory(dir=directory.path.parent) as shared:
        decoded = progress.track(log.scans(settings.config.preprocess), log.scan_count)
        scans = store(decoded, log.T_base_lidar, Path(shared))
        stopped = (
            f"the user stopped the reading: {counted(len(scans), 'scan')} compared" if progress.stopped else ""
        )
        reference = _reference(contest, log, scans)
        limits = limits_for(len(scans), contest.time_s, contest.memory_mib)
        outcomes = race(methods, scans, Path(shared), repeat=contest.repeat, limits=limits, progress=progress)
        progress.say("judging and drawing")
        judged = {
            name: judge(runs, scans.stamps_ns, reference.truth, reference.relations)
            for name, runs in outcomes.items()
        }
        evidence = Evidence(methods, scans, outcomes, judged, maps_of(scans, outcomes), reference)
        write_evidence(directory.path, evidence)
        provenance = msgspec.structs.replace(
            provenance.hashed(hashing), complete=True, stopped=stopped, duration_s=perf_counter() - began
        )
        provenance.write(directory.path / RUN_FILE)
        table = summarize(evidence, log, limits, provenance)
        write_table(directory.path, table)
        present(directory.path)
        directory.complete()
    return Compared(directory.path, table)


def _reference(contest: Contest, log: Log, scans: StoredScans) -> Reference:
    """What errors are against, checked to fit the log before any method is run."""
    standing = Trajectory(scans.stamps_ns, np.tile(lie.identity(scans.dimension), (len(scans), 1, 1)))
    relations, note = None, ""
    if contest.relations is not None:
        relations = read_relations(contest.relations)
        relation_error(standing, relations)
    truth, source = log.ground_truth(), log.ground_truth_topic
    topic = named(contest.overrides, "log.ground_truth_topic")
    if contest.ground_truth is not None:
        truth, source = read_truth(contest.ground_truth).at(scans.stamps_ns), str(contest.ground_truth)
    elif topic and truth is None:
        raise InputError(f"{log.name}: has no poses on {topic}; scanchain info lists the topics that have")
    if truth is not None:
        try:
            missing = pair(standing, truth).missing
            note = missing and f"Of {len(scans):,} scans {missing}"
        except InputError as error:
            if contest.ground_truth is not None or topic:
                raise
            truth, note = None, f"No accuracy against {source}: {error}"
    sources = [source] if truth is not None else []
    sources += [str(contest.relations)] if relations is not None else []
    return Reference(truth, relations, " and ".join(sources), note)
