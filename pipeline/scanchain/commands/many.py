"""``scanchain batch`` and ``compare``: runs of many logs, and comparisons of methods on one log or several."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands import options
from scanchain.commands.options import PATH, OverrideCommand
from scanchain.errors import InputError, ScanchainError, counted, folded
from scanchain.files import Source, source_of
from scanchain.settings import Override, load_settings

if TYPE_CHECKING:
    from scanchain.comparison.methods import Variation
    from scanchain.comparison.overall import Overall

Varied = Mapping[str, Mapping[str, "Overall"]]  # by key and value of --vary


def _variations(_: object, __: object, words: Sequence[str]) -> dict[str, list[str]]:
    """Values of ``--vary`` by key."""
    found: dict[str, list[str]] = {}
    for word in words:
        key, values = word.partition("=")[::2]
        listed = [value.strip() for value in values.split(",") if value.strip()]
        if not listed:
            raise InputError(f"--vary {word}: wanted KEY=VALUE,VALUE, as --vary every=1,2,5")
        found.setdefault(key.removeprefix("--").strip(), []).extend(listed)
    return found


@click.command(cls=OverrideCommand, options_metavar="--out DIR [OPTIONS] [--section.key VALUE]...")
@click.argument("logs", metavar="LOG...", nargs=-1, type=source_of)
@options.out("Directory to create, or to resume.")
@click.option(
    "--manifest", "manifests", multiple=True, metavar="FILE", type=PATH, help="Text file with one log per line."
)
@options.config
@options.part("each log")
@options.matcher
@options.no_loops
@options.ground_truth("TOPIC|none", "Ground truth in every log; none to ignore it. [default: /ground_truth]")
@click.option(
    "--workers", type=click.IntRange(1), metavar="N", help="Logs run in parallel. [default: one per core]"
)
@click.option("--ray", metavar="auto|ADDRESS", help="Run on a Ray cluster that sees the same files.")
@options.limits(
    "a log", time_default="a day", memory_default="an equal share of three quarters of the free memory"
)
@click.option("--retries", type=click.IntRange(0), default=1, help="Retries of a log whose process crashed.")
@click.option(
    "--rerun",
    type=click.Choice(["save", "off"]),
    default="save",
    help="Whether runs write a recording, some ten megabytes each.",
)
@click.option("--strict", is_flag=True, help="Exit with 1 unless every verdict is trustworthy.")
def batch(
    logs: tuple[Source, ...],
    out: Path,
    manifests: tuple[Path, ...],
    config_file: Path | None,
    workers: int | None,
    ray: str | None,
    rerun: str,
    ground_truth: Path | None,
    strict: bool,
    time_s: float | None,
    overrides: tuple[Override, ...],
    **limits: Any,
) -> None:
    """Run many logs, each in its own process.

    LOG is a file, folder or address that scanchain run takes, a folder of such logs, or a quoted glob pattern.
    Files of a folder that follow one another within a minute are the parts of one log. A log whose process
    crashes, hangs or runs out of memory becomes a row with the reason; the others finish, and the exit code is 1.
    Called again, batch runs only the logs that have no result yet. A result belongs to the path, size and last
    change of the log (of a remote one: its address, size and version) and the effective configuration. DIR gets a
    run directory per log, batch.parquet with a row per log, report.html and summary.txt. Logs with different lidar
    topics need separate calls, each with its --topic.

    \b
    Examples:
      scanchain batch logs/ --out runs/all
      scanchain batch 'logs/**/*.mcap' --out runs/all --workers 8 --time-limit 600 --memory-limit 4
      scanchain batch --manifest logs.txt --out runs/svd --matching.matcher svd
      scanchain batch *.bag --out runs/front --topic /lidar_front/points --end 60
      scanchain batch --manifest logs.txt --out /shared/all --ray auto
      scanchain batch 's3://bucket/drives/*.mcap' --out runs/drives
    """
    from scanchain.batch.batch import Batch, collect, on_cluster, run_batch
    from scanchain.batch.task import attempt
    from scanchain.commands.terminal import Terminal

    if ray is not None and workers is not None:
        raise InputError("--workers is for this machine alone; on a cluster every core takes a log")
    if ground_truth is not None:
        raise InputError(
            f"--gt {ground_truth}: a batch has no file of true poses for all its logs; name a topic, or use run"
        )
    file = () if config_file is None else ("--config", str(config_file.resolve()))
    job = Batch(
        logs=collect(logs, manifests, load_settings(file=config_file, overrides=overrides).config.log.format),
        out=out.resolve(),
        config_file=config_file,
        overrides=overrides,
        arguments=("--rerun", rerun, *file, *(f"--{change.key}={change.text}" for change in overrides)),
        workers=workers or os.cpu_count() or 1,
        time_s=time_s or 86_400.0,
        **limits,
    )
    from scanchain_viz.report.batch import write_batch_report

    with Terminal("logs") as terminal:
        batched = run_batch(job, terminal, None if ray is None else on_cluster(ray, attempt))
    click.echo(folded(batched.summary), nl=False)
    write_batch_report(job.out, batched.rows, sys.argv)
    files = "batch.parquet, report.html, summary.txt"
    click.echo(f"written        {out}: {files}; {counted(batched.kept, 'result')} from before")
    failures = ", ".join(filter(None, (batched.failures, batched.doubts if strict else "")))
    if failures:
        raise ScanchainError(f"{failures}; {out}/summary.txt has the reason")


@click.command(cls=OverrideCommand)
@options.logs
@click.option("--methods", metavar="LIST", help="Comma-separated names. [default: all that apply to the log]")
@click.option(
    "--matcher",
    metavar="MODULE:CLASS",
    default="",
    show_default=False,
    help="Compare odometry with your own matcher as well, row CLASS.",
)
@click.option(
    "--out",
    metavar="DIR",
    type=PATH,
    help="Directory to create; of several logs, to create or to continue. [default: runs/compare-LOG]",
)
@click.option("--site", metavar="DIR", type=PATH, help="Write the pages as a static web site, too.")
@options.ground_truth()
@options.relations
@click.option(
    "--config",
    "--settings",
    "config_file",
    metavar="FILE",
    type=PATH,
    help="TOML file on top of the preset, with a table for each method whose settings differ.",
)
@click.option("--repeat", type=click.IntRange(1), default=1, help="Runs of every method, interleaved.")
@options.limits("a run", time_default="300, plus 1 per scan", memory_default="three quarters of the free memory")
@options.part()
@options.threads
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=A,B,C",
    callback=_variations,
    help="Compare with each of these values, too: robustness to a setting or rate.",
)
@click.option("--ray", metavar="auto|ADDRESS", help="Compare on a Ray cluster that sees the same files.")
@options.force("an existing comparison once the new one is complete")
@click.option("--json", "as_json", is_flag=True, help="Print table.json or overall.json instead of the table.")
def compare(
    logs: tuple[Source, ...],
    methods: str | None,
    out: Path | None,
    site: Path | None,
    ray: str | None,
    vary: dict[str, list[str]],
    as_json: bool,
    **given: Any,
) -> None:
    """Compare odometry methods on the same decoded scans: accuracy, speed, memory.

    Writes tables, report.html and a rerun recording. Every method runs in its own process; one that crashes, hangs
    or runs out of memory becomes a row with the reason, and the exit code is 1. A verdict, also "not trustworthy",
    is a column and fails nothing. Our methods use no wheel odometry unless --odometry.prior is auto, since the
    others have none.

    Several LOGs that are the parts of one drive are one log. Otherwise methods are compared on each, also of a
    folder or a quoted pattern, and DIR gets a folder per log and the statistics over all: medians with confidence
    intervals, wins, ranks. Called again, only the logs that have no result yet are compared. --topic holds for the
    logs that have it; in --gt and --relations {} stands for the name of the log. --ray, --site and --vary hold for
    one log, too. KEY of --vary is one of the configuration or of a method, or the last part of it; methods that
    have it take part.

    \b
    Methods:
      plicp, svd               ours, odometry only
      plicp+loops, svd+loops   ours, with loop closures
      plicp+imu, svd+imu       ours, with the log's IMU
      CLASS, CLASS+loops, CLASS+imu    ours with the matcher of --matcher MODULE:CLASS
      open3d-p2p, open3d-gicp, kiss-icp, small-gicp, small-vgicp
      open3d-p2l, open3d-multiscale, genz-icp, genz-icp-indoor, genz-icp-kitti    3D only
      rko-lio                  3D only, with the log's IMU
      evalio:ct, evalio:kiss, …    3D only, the pipelines of evalio; evalio stands for all of them
      my_module:MyOdometry     your own class: register(points, stamp_s, times_s) returns the pose
    A name that several begin with stands for all of them: kiss, open3d. Sections of --config hold for all of
    ours, as in scanchain run; a table of a method's name changes that method, one of another name is a variant:

    \b
      [kiss-icp]
      voxel_size_m = 0.5
      [plicp-fine]
      method = "plicp"
      local_map.voxel_size_m = 0.5
      [mine]
      method = "my_package.odometry:MyOdometry"
      [theirs]
      command = "their_slam {scans} --out {poses}"

    A command reads a folder of PLY files, named by their stamps in nanoseconds, and writes a TUM file of poses.

    \b
    Examples:
      scanchain compare log.mcap
      scanchain compare log.mcap --methods plicp,kiss,open3d --every 2
      scanchain compare log.mcap --methods plicp,svd,kiss-icp --repeat 5 --out runs/three
      scanchain compare log.mcap --methods plicp,plicp-fine,mine --config mine.toml --gt truth.tum
      scanchain compare log.mcap --methods plicp,Mine --matcher mine:Mine
      scanchain compare intel.mcap --relations intel.relations --memory-limit 2 --end 600
      scanchain compare logs/ --methods plicp,svd,kiss --out runs/all --site public
      scanchain compare log.mcap --methods plicp,kiss --vary voxel_size_m=0.5,1,2 --vary every=1,2,5
      scanchain compare 00.mcap 05.mcap 07.mcap --gt 'truth/{}.tum' --out runs/kitti
    """
    from scanchain.batch.batch import on_cluster
    from scanchain.batch.comparisons import attempt, check_site, compare_each, logs_of, vary_each
    from scanchain.commands.terminal import Terminal
    from scanchain.comparison.compare import compare as run_comparison
    from scanchain.comparison.methods import Variation, shared_settings
    from scanchain.comparison.table import TABLE_FILE, text
    from scanchain_viz.recording.results import present_comparison

    of_log = (*shared_settings(given["config_file"]), *given["overrides"])
    each = logs_of(logs, load_settings(overrides=of_log).config.log.format)
    out = out or Path("runs") / f"compare-{logs[0].stem if len(each) == 1 else 'all'}"
    names = [name.strip() for name in (methods or "").split(",") if name.strip()]
    if site is not None:
        check_site(site, out)
    for key, value in ((key, value) for key, values in vary.items() for value in values):
        _check_variation(Variation(key, value), names, given)
    given |= {"methods": names, "command": sys.argv}
    with Terminal("scans") as terminal:
        if len(each) > 1 or site is not None or ray is not None or vary:
            work = None if ray is None else on_cluster(ray, attempt, has_whole_node=True)
            given |= {"present": present_comparison, "progress": terminal, "work": work}
            overall = compare_each(each, out, **given)
            varied = vary_each(vary, out, overall, partial(compare_each, each, **given))
            _end(overall, varied, out, site, as_json)
            return
        compared = run_comparison(each[0], out, present_comparison, terminal, **given)
    click.echo((compared.path / TABLE_FILE).read_text() if as_json else text(compared.table), nl=False)
    if not as_json:
        click.echo(f"written {out}: report.html, compare.rrd, tables")
    if compared.failures:
        raise ScanchainError(f"did not finish: {', '.join(compared.failures)}; see the table for the reason")


def _check_variation(variation: Variation, names: Sequence[str], given: dict[str, Any]) -> None:
    """Raise InputError, before anything is run, for a variation that fits neither clouds nor laser scans."""
    from scanchain.comparison.methods import default_names, resolve, shared_settings

    file, overrides, matcher = given["config_file"], given["overrides"], given["matcher"]
    load_settings(overrides=(*shared_settings(file), *overrides, *variation.of_log))
    options = {"file": file, "overrides": overrides, "matcher": matcher, "variation": variation}
    try:
        resolve(names or default_names(3, has_imu=True), 3, **options)
    except InputError:
        resolve(names or default_names(2), 2, **options)


def _end(overall: Overall, varied: Varied, out: Path, site: Path | None, as_json: bool) -> None:
    """Write the pages over all logs, print the table, and end with an error where something failed."""
    from scanchain.batch.comparisons import publish
    from scanchain.comparison.overall import OVERALL_FILE, overall_text, sensitivity_text, variation_folder
    from scanchain_viz.report.overall import write_overall_report

    folders = {"": overall}
    folders |= {
        variation_folder(key, value): each for key, found in varied.items() for value, each in found.items()
    }
    for folder, each in folders.items():
        write_overall_report(out / folder, each, {} if folder else varied)
        if site is not None:
            publish(out / folder, each, site / folder)
    texts = [overall_text(overall), *(sensitivity_text(key, found) for key, found in varied.items())]
    click.echo((out / OVERALL_FILE).read_text() if as_json else "\n".join(texts), nl=False)
    if not as_json:
        of_site = "" if site is None else f"; {site}: index.html"
        click.echo(f"written {out}: report.html, overall.csv, overall.md, a folder for each log{of_site}")
    if failures := sum(len(each.failures) for each in folders.values()):
        raise ScanchainError(f"{counted(failures, 'failure')}; the table and its page have the reasons")
