"""Comparisons on several logs, each in a folder of its own, which is kept when called again; and their site."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from scanchain.baselines import BASELINES
from scanchain.batch.batch import check_out, collect
from scanchain.batch.task import key_of
from scanchain.comparison.compare import compare
from scanchain.comparison.methods import Variation, shared_settings
from scanchain.comparison.overall import (
    OVERALL_FILE,
    ComparedLog,
    Overall,
    overall_of,
    variation_folder,
    write_overall,
)
from scanchain.comparison.table import TABLE_FILE, read_table
from scanchain.errors import InputError, ScanchainError, spelled
from scanchain.files import Source
from scanchain.logs.messages.readers import is_lidar
from scanchain.logs.opening import index_files
from scanchain.logs.stream import are_parts
from scanchain.logs.topics import topics_of
from scanchain.runs.job import Progress
from scanchain.runs.provenance import identity_of, package_version
from scanchain.settings import Override, named

_STOPPED = "not compared: stopped by the user"
_RECORDING, _REPORT, _INDEX = "compare.rrd", "report.html", "index.html"
_OF_LOG = _REPORT, _RECORDING, TABLE_FILE, "table.csv", "table.md"  # what a site has of each log
_OF_ALL = OVERALL_FILE, "overall.csv", "overall.md"


@dataclass(frozen=True, slots=True)
class Task:
    """A log to compare methods on: its files, its folder, and the arguments of ``compare``."""

    files: tuple[Source, ...]
    folder: Path
    present: Callable[[Path], None]
    given: dict[str, Any]


Work = Callable[[Sequence[Task]], Iterator[tuple[Task, str]]]


def attempt(task: Task, progress: Progress | None = None) -> tuple[Task, str]:
    """Compare on a log; with the reason why there is no result, which is empty where there is one."""
    try:
        compare(
            task.files, task.folder, task.present, progress or Progress(), force=True, needs_all=True, **task.given
        )
    except ScanchainError as error:
        return task, error.text.removeprefix(f"{task.files[0]}: ")
    return task, ""


def logs_of(named: Sequence[Source], log_format: str) -> list[tuple[Source, ...]]:
    """The files of each log: of one where all are its parts, else each file, folder or match of a pattern is one.

    Raises InputError for a pattern that matches nothing.
    """
    found = collect(named, (), log_format)
    return [found] if len(found) > 1 and _are_of_one(found) else [(each,) for each in found]


def _are_of_one(files: Sequence[Source]) -> bool:
    """True for files of one drive that share a lidar topic, as far as they have any."""
    try:
        indexes = index_files(files)
    except InputError:  # the log that cannot be read becomes a row that says so
        return False
    topics = [{each.topic for each in index.channels.values() if is_lidar(each)} for index in indexes]
    return any(topics) and bool(set.intersection(*filter(None, topics))) and are_parts(indexes)


def compare_each(
    logs: Sequence[tuple[Source, ...]],
    out: Path,
    present: Callable[[Path], None],
    progress: Progress,
    *,
    work: Work | None = None,
    force: bool = False,
    **given: Any,
) -> Overall:
    """Compare methods on each log that has no result in ``out`` yet, and write the statistics over all.

    present, given : as of ``compare``; a lidar topic holds for the logs that have it, in the file of true poses or
        relations {} stands for the name of the log
    work : where it is done; None for this process, one log after the other, so that times are comparable
    force : whether results of earlier calls are replaced
    On Ctrl-C the log in progress is discarded, and those not begun are listed as such. A log that cannot be read
    is listed with the reason. Raises InputError for a directory that holds something else.
    """
    out = out.absolute()
    check_out(out, [file for files in logs for file in files], "a comparison of several logs", OVERALL_FILE)
    out.mkdir(parents=True, exist_ok=True)
    tasks = [_task(files, out, present, given | _topic_of(files, given, progress)) for files in logs]
    waiting = [task for task in tasks if force or not (task.folder / TABLE_FILE).is_file()]
    reasons = {task.folder: _STOPPED if task in waiting else "" for task in tasks}
    if kept := len(tasks) - len(waiting):
        progress.announce(f"{kept:,} of {len(tasks):,} logs are compared already")
    if not (out / OVERALL_FILE).exists():  # marks the directory, before a kill too
        write_overall(out, overall_of([]))
    try:
        for task, reason in (work or partial(map, partial(attempt, progress=progress)))(waiting):
            reasons[task.folder] = reason
            progress.announce(f"{task.folder.name}: {reason or 'compared'}")
    except KeyboardInterrupt:
        progress.announce("stopped; the same command continues")
    overall = overall_of([_compared(task, reasons[task.folder]) for task in tasks])
    write_overall(out, overall)
    return overall


def vary_each(
    variations: Mapping[str, Sequence[str]], out: Path, overall: Overall, compared: Callable[..., Overall]
) -> dict[str, dict[str, Overall]]:
    """Compare with each value of each key in turn: the statistics by key and value, up to where the user stops.

    overall : of all logs with the usual values
    compared : ``compare_each`` of a directory and a ``variation``
    """
    found: dict[str, dict[str, Overall]] = {}
    for key, value in [(key, value) for key, values in variations.items() for value in values]:
        if any(log.reason == _STOPPED for log in overall.logs):
            break
        overall = compared(out / variation_folder(key, value), variation=Variation(key, value))
        found.setdefault(key, {})[value] = overall
    return found


def _task(files: tuple[Source, ...], out: Path, present: Callable[[Path], None], given: dict[str, Any]) -> Task:
    """The task of a log, with absolute paths: workers of a cluster have other working directories."""
    files = tuple(file.absolute() if isinstance(file, Path) else file for file in files)
    first, own, others = files[0].resolve(), dict(given), list[Source]()
    stem = first.name if isinstance(first, Path) and first.is_dir() else first.stem
    for key in ("ground_truth", "relations"):
        if given.get(key) is not None:
            own[key] = Path(str(given[key]).replace("{}", stem)).absolute()
            others.append(own[key])
    identity = [identity_of(file) or spelled(str(file)) for file in (*files, *others)]
    file = given.get("config_file")
    key = key_of("\0".join(identity), None, (*shared_settings(file), *given.get("overrides", ())))
    rest = {name: value for name, value in own.items() if name not in ("overrides", "command", "config_file")}
    packages = sorted({"evalio", *(entry.package for entry in BASELINES.values())})
    versions = [package_version(name) for name in packages]
    text = f"{key} {versions} {sorted(rest.items())} {'' if file is None else file.read_text(encoding='utf-8')}"
    return Task(files, out / f"{stem}-{hashlib.sha256(text.encode()).hexdigest()[:8]}", present, own)


def _topic_of(files: Sequence[Source], given: Mapping[str, Any], progress: Progress) -> dict[str, Any]:
    """The overrides without a lidar topic that the log does not have: another log of the comparison has it."""
    overrides: Sequence[Override] = given.get("overrides", ())
    if not (wanted := named(overrides, "log.topic")):
        return {}
    try:
        known = topics_of(index_files(files))
    except InputError:  # comparing says why
        return {}
    if any(topic.strip() in known for topic in wanted.split(",")):
        return {}
    progress.announce(f"{files[0]}: has no topic {wanted}; its own lidar is used")
    return {"overrides": tuple(each for each in overrides if each.key != "log.topic")}


def _compared(task: Task, reason: str) -> ComparedLog:
    return ComparedLog(task.files[0].name, task.folder.name, None if reason else read_table(task.folder), reason)


def check_site(site: Path, out: Path) -> None:
    """Raise InputError for a folder that holds something else than a site of comparisons."""
    is_free = not site.exists() or (site.is_dir() and (not any(site.iterdir()) or (site / OVERALL_FILE).is_file()))
    if not is_free or site.resolve() == out.resolve():
        raise InputError(f"{site}: is not a site of comparisons; choose another --site")


def publish(out: Path, overall: Overall, site: Path) -> None:
    """Copy pages, recordings and tables into a folder that a web server can serve as it is."""
    site.mkdir(parents=True, exist_ok=True)
    for log in overall.logs:
        shutil.rmtree(site / log.folder, ignore_errors=True)
        if log.table is not None:
            (site / log.folder).mkdir()
            for file in _OF_LOG:
                shutil.copy(out / log.folder / file, site / log.folder / file)
    for file in _OF_ALL:
        shutil.copy(out / file, site / file)
    for name in (_INDEX, _REPORT):  # variations link to the latter
        shutil.copy(out / _REPORT, site / name)
