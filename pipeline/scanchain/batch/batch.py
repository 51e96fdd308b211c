"""A batch: every log without a result is run in its own process; the results of all become batch.parquet."""

from __future__ import annotations

import io
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from glob import glob
from pathlib import Path
from threading import Event
from typing import TypeVar

import msgspec
import numpy as np

from scanchain.batch.task import ROWS_FOLDER, Row, State, Task, attempt, finished_row, key_of
from scanchain.errors import InputError, MissingExtraError, counted, duration, spelled
from scanchain.files import Source, source_of, write_whole
from scanchain.logs.files import matching, misspelled
from scanchain.logs.opening import AUTO, logs_in
from scanchain.processes import MEMORY_SHARE, Limits, available_mib
from scanchain.runs.directory import check_outside_runs
from scanchain.runs.job import Progress
from scanchain.runs.metrics import Metrics
from scanchain.runs.provenance import identity_of
from scanchain.settings import Override
from scanchain.verdict import Verdict

TABLE_FILE, SUMMARY_FILE = "batch.parquet", "summary.txt"
_NUMBERS = (
    "scans", "dimension", "ok", "contradicted", "degenerate", "lost", "keyframes", "closures_tried",
    "closures_rejected_by_verification", "closures_verified", "closures_rejected_by_back_end", "closures_accepted",
    "degrees_of_freedom",
)  # fmt: skip
_FIGURES = ("log_span_s", "run_s", "scans_per_s", "times_real_time", "traveled_m", "chi2", "median_residual_m")
_ERRORS = ("ate_rmse_m", "ate_share_of_path", "kitti_translation_share", "kitti_rotation_rad_per_m")

T = TypeVar("T")
R = TypeVar("R")
Work = Callable[[Sequence[Task]], Iterator[Row]]


@dataclass(frozen=True, slots=True)
class Batch:
    """Logs to run, with configuration and limits.

    out : created or resumed
    config_file, overrides : for every log; arguments : these and others, for ``scanchain run``
    time_s, memory_mib : limits per log; None for an equal share of the free memory
    retries : further tries of a log whose process crashed
    """

    logs: tuple[Source, ...]
    out: Path
    config_file: Path | None = None
    overrides: tuple[Override, ...] = ()
    arguments: tuple[str, ...] = ()
    workers: int = 1
    time_s: float = float("inf")
    memory_mib: float | None = None
    retries: int = 1


@dataclass(frozen=True, slots=True)
class Batched:
    """A finished batch; ``kept`` is the number of rows from earlier calls."""

    rows: tuple[Row, ...]
    kept: int
    summary: str

    @property
    def failures(self) -> str:
        """Number of logs without a result or with an untrustworthy one, as text; empty if there are none."""
        absent = sum(not row.state.has_result for row in self.rows)
        untrusted = sum(row.state is State.NOT_TRUSTWORTHY for row in self.rows)
        parts = [f"{absent:,} of {len(self.rows):,} logs have no result"] if absent else []
        parts += [f"{untrusted:,} of {len(self.rows):,} logs are not trustworthy"] if untrusted else []
        return ", ".join(parts)

    @property
    def doubts(self) -> str:
        """Number of logs with segments to check, as text; empty if there are none."""
        count = sum(row.metrics is not None and row.metrics.verdict is Verdict.CHECK for row in self.rows)
        return f"{count:,} of {len(self.rows):,} logs have segments to check" if count else ""


def run_batch(batch: Batch, progress: Progress, work: Work | None = None) -> Batched:
    """Run the logs without a result and write the table.

    work : where the tasks are run; None for processes on this machine
    On Ctrl-C running logs are killed, and the table lists those not run. Raises InputError for a directory that
    cannot be created or holds something else, and for an invalid configuration.
    """
    check_out(batch.out, batch.logs, "a batch", ROWS_FOLDER)
    key_of("", batch.config_file, batch.overrides)  # an invalid configuration is invalid for every log
    try:
        (batch.out / ROWS_FOLDER).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{batch.out}: cannot be made ({error.strerror}); choose another --out") from error
    tasks = _tasks(batch)
    rows = {task.key: row for task in tasks if (row := finished_row(task)) is not None}
    kept = sum(task.key in rows for task in tasks)
    missing = {task.key: task for task in tasks if task.key not in rows}
    readable = [task for task in missing.values() if task.identity]
    if kept:
        progress.say(f"{kept:,} of {len(tasks):,} logs are done already")
    progress.count(kept, len(tasks))
    try:
        for done, row in enumerate((work or partial(_local, batch.workers))(readable), start=1):
            write_whole(missing[row.key].row_file, msgspec.json.encode(row))
            rows[row.key] = row
            warnings = f", {counted(row.warnings, 'warning')}" if row.warnings else ""
            progress.say(f"{row.log}: {row.state}{row.why and f': {row.why}'}{warnings}")
            progress.count(kept + done, len(tasks))
    except KeyboardInterrupt:
        progress.say("stopped")
    table = tuple(rows.get(task.key) or _not_run(task) for task in tasks)
    return Batched(table, kept, write_table(batch.out, table))


def check_out(out: Path, logs: Sequence[Source], kind: str, marker: str) -> None:
    """Raise InputError for a directory that holds something else, or lies in a run or in a log folder.

    kind, marker : what may be continued there, and the file or folder that only such a directory contains
    """
    if complaint := misspelled(out):
        raise InputError(complaint)
    check_outside_runs(out)
    for log in logs:
        if isinstance(log, Path) and log.resolve() in (out.resolve(), *out.resolve().parents):
            raise InputError(f"{out}: lies in the log {log}; choose another --out")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; choose another --out")
    if out.is_dir() and any(out.iterdir()) and not (out / marker).exists():
        raise InputError(f"{out}: is not empty and not {kind} ({marker} is missing); choose another --out")


def _tasks(batch: Batch) -> list[Task]:
    share_mib = MEMORY_SHARE * available_mib() / batch.workers
    limits, tasks = Limits(batch.time_s, share_mib if batch.memory_mib is None else batch.memory_mib), []
    for log in batch.logs:
        path = str(log.absolute()) if isinstance(log, Path) else log.url
        identity = "" if misspelled(log) else identity_of(log)
        key = key_of(identity or spelled(path), batch.config_file, batch.overrides)
        tasks.append(Task(path, identity, key, str(batch.out), batch.arguments, limits, batch.retries))
    return tasks


def _not_run(task: Task) -> Row:
    """The row of a log that was not run, with the reason."""
    source, state, reason = source_of(task.log), State.FAILED, "no such file; check the path"
    if task.identity:
        state, reason = State.NOT_RUN, "stopped by the user"
    elif not isinstance(source, Path) or source.exists():
        reason = misspelled(source) or f"cannot be read; scanchain info {task.name} shows the reason"
    return Row(task.name, "", task.key, "", state, reason, 0, 0.0, 0.0, None)


def _local(workers: int, tasks: Sequence[Task]) -> Iterator[Row]:
    """Rows of tasks that are run by processes on this machine, ``workers`` at a time."""
    stop = Event()
    with ThreadPoolExecutor(workers, "batch") as pool:
        futures = [pool.submit(attempt, task, stop) for task in tasks]
        try:
            yield from (future.result() for future in as_completed(futures))
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


def on_cluster(
    address: str, attempt: Callable[[T], R], *, has_whole_node: bool = False
) -> Callable[[Sequence[T]], Iterator[R]]:
    """Runner of tasks on a Ray cluster with access to the same files, one core per task; retries if a node dies.

    address : of the cluster's head node, or "auto" for the cluster that this machine belongs to
    has_whole_node : whether a task has one of the largest nodes to itself instead, as where times are measured
    Raises MissingExtraError without Ray, InputError where no cluster responds.
    """
    try:
        import ray
    except ImportError:
        raise MissingExtraError("ray", "cluster") from None

    def connect() -> None:
        try:
            ray.init(address, ignore_reinit_error=True, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"--ray is {address!r}: {reason}; start a cluster with ray start --head") from None

    def work(tasks: Sequence[T]) -> Iterator[R]:
        connect()  # again after an earlier call
        nodes = [node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]]
        cores = max(nodes, default=1.0) if has_whole_node else 1.0
        remote = ray.remote(num_cpus=cores, max_retries=10)(attempt)  # after its node died
        waiting = [remote.remote(task) for task in tasks]
        try:
            while waiting:
                done, waiting = ray.wait(waiting)
                yield from ray.get(done)
        finally:
            for each in waiting:
                ray.cancel(each, force=True)
            ray.shutdown()

    connect()
    return work


def write_table(folder: Path, rows: Sequence[Row]) -> str:
    """Write table and summary, each completely or not at all; the text of the summary."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema(
        [(name, pa.string()) for name in ("log", "sha256", "key", "run", "state", "reason", "verdict")]
        + [(name, pa.int64()) for name in ("warnings", "tries")]
        + [(name, pa.float64()) for name in ("duration_s", "peak_mib")]
        + [(name, pa.int64()) for name in _NUMBERS]
        + [(name, pa.float64()) for name in (*_FIGURES, *_ERRORS, "odometry_ate_rmse_m")]
    )
    notes = {
        "warnings": "warnings in the run's metrics.json: data lost, skipped or wrong",
        "run": "directory of the result, next to this file; empty where there is none",
        "duration_s, peak_mib": "of the whole process of the last try",
        "ate_*, kitti_*": "against the ground truth in the log, after optimization; null without any",
    }
    table = pa.Table.from_pylist([_cells(row) for row in rows], schema=schema.with_metadata(notes))
    data, text = io.BytesIO(), summary(rows)
    pq.write_table(table, data, compression="zstd")
    write_whole(folder / TABLE_FILE, data.getvalue())
    write_whole(folder / SUMMARY_FILE, text.encode())
    return text


def summary(rows: Sequence[Row]) -> str:
    """Totals, each log without a result and its reason, each log with segments to check or warnings."""
    lines = totals(rows)
    lines += [(row.state, f"{row.log}: {row.why}") for row in rows if row.state is not State.DONE]
    results = [(row, row.metrics) for row in rows if row.metrics is not None]
    lines += [("check", f"{row.log}: {m.verdict_reason}") for row, m in results if m.verdict is Verdict.CHECK]
    for row, metrics in results:
        if metrics.warnings:
            more = f" (and {row.warnings - 1:,} more)" if row.warnings > 1 else ""
            lines.append(("warned", f"{row.log}: {metrics.warnings[0].replace(f'{row.log}: ', '')}{more}"))
    return "".join(f"{name:<14} {text}\n" for name, text in lines)


def totals(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Totals of a batch as pairs of name and text: states of the logs, scans, speed, ATE."""
    counts = Counter(row.state for row in rows)
    ended = ", ".join(f"{counts[state]:,} {state}" for state in State if counts[state])
    results = [row.metrics for row in rows if row.metrics is not None]
    warned = sum(bool(row.warnings) for row in rows)
    warnings = [("warnings", f"in {counted(warned, 'log')}, listed in summary.txt")] if warned else []
    return [("logs", f"{len(rows):,}: {ended}"), *warnings, *(_amounts(results) if results else ())]


def _amounts(results: Sequence[Metrics]) -> Iterator[tuple[str, str]]:
    scans, contradicted, degenerate, lost = (
        sum(getattr(each, name) for each in results) for name in ("scans", "contradicted", "degenerate", "lost")
    )
    traveled_m = sum(each.traveled_m for each in results)
    path = f"{traveled_m:.1f} m" if traveled_m < 1000.0 else f"{1e-3 * traveled_m:.2f} km"
    time = duration(sum(each.log_span_s for each in results))
    speed = np.array([each.times_real_time for each in results])
    yield (
        "scans",
        f"{scans:,}; of these {contradicted:,} contradicted, {degenerate:,} degenerate, {lost:,} lost, "
        f"over {path} and {time}",
    )
    yield "speed", f"{np.median(speed):.1f} x real time (median), {speed.min():.1f} at the least"
    errors_m = [each.ground_truth.optimized.ate_rmse_m for each in results if each.ground_truth is not None]
    if errors_m:
        yield (
            "ATE",
            f"rmse {np.median(errors_m):.4f} m (median), {max(errors_m):.4f} m at the most, "
            f"{counted(len(errors_m), 'log')} with ground truth",
        )


def _cells(row: Row) -> dict[str, object]:
    """Cells by column, and more; those missing for a log without result or ground truth become null."""
    cells = msgspec.to_builtins(row)
    metrics = cells["metrics"] or {}
    truth = metrics.get("ground_truth") or {"optimized": {}, "odometry": {}}
    figures = metrics | truth["optimized"] | {"odometry_ate_rmse_m": truth["odometry"].get("ate_rmse_m")}
    return figures | cells | {"warnings": row.warnings}


def collect(named: Sequence[Source], manifests: Sequence[Path], log_format: str = AUTO) -> tuple[Source, ...]:
    """Every log once, in the order named; patterns and folders are replaced by the logs in them, by name.

    log_format : a folder is searched for logs only if the format is not given
    manifests : text files with one path, address or pattern per line, relative to the file; # begins a comment
    Raises InputError for a pattern that matches nothing and a manifest that cannot be read.
    """
    paths = list(_matched(named, "the command line"))
    for manifest in manifests:
        paths += _matched(_listed(manifest), str(manifest))
    if not paths:
        raise InputError("no log is named; name some, or a --manifest that does")
    first: dict[Source, Source] = {}
    for path in paths:
        if log_format == AUTO and isinstance(path, Path) and path.is_dir():
            first |= {log.resolve(): log for log in logs_in(path) if log.resolve() not in first}
        else:
            first.setdefault(path.resolve(), path)
    return tuple(first.values())


def _listed(manifest: Path) -> list[Source]:
    try:
        lines = manifest.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise InputError(f"{manifest}: cannot be read ({reason}); --manifest takes a list of paths") from None
    words = [line.partition("#")[0].strip() for line in lines]
    sources = [source_of(word) for word in words if word]
    return [manifest.parent / source if isinstance(source, Path) else source for source in sources]


def _matched(named: Iterable[Source], where: str) -> Iterator[Source]:
    """Sources with patterns replaced; an existing path is used as it is, whatever characters it contains."""
    for source in named:
        if isinstance(source, Path):
            is_pattern = bool(set("*?[") & set(str(source))) and not source.exists()
            found = list(map(Path, sorted(glob(str(source), recursive=True)))) if is_pattern else [source]
        else:
            found = matching(source) if "*" in source.url else [source]  # ? and [ belong to addresses
        if not found:
            raise InputError(f"{source}: matches nothing; correct the pattern in {where}")
        yield from found
