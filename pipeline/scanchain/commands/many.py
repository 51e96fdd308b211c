"""``scanchain batch`` and ``compare``: runs of many logs, and a comparison of many methods on one log."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click

from scanchain.commands import options
from scanchain.commands.options import LOG, PATH, OverrideCommand
from scanchain.errors import InputError, ScanchainError, counted, folded
from scanchain.files import Source
from scanchain.settings import Override, load_settings


@click.command(cls=OverrideCommand, options_metavar="--out DIR [OPTIONS] [--section.key VALUE]...")
@click.argument("logs", metavar="LOG...", nargs=-1, type=LOG)
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
@click.option(
    "--retries",
    type=click.IntRange(0),
    default=1,
    show_default=True,
    help="Retries of a log whose process crashed.",
)
@click.option(
    "--rerun",
    type=click.Choice(["save", "off"]),
    default="save",
    show_default=True,
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
        batched = run_batch(job, terminal, None if ray is None else on_cluster(ray))
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
    help="Compare odometry with your own matcher as well, row CLASS.",
)
@click.option("--out", metavar="DIR", type=PATH, help="Directory to create. [default: runs/compare-LOG]")
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
@click.option(
    "--repeat", type=click.IntRange(1), default=1, show_default=True, help="Runs of every method, interleaved."
)
@options.limits("a run", time_default="300, plus 1 per scan", memory_default="three quarters of the free memory")
@options.part()
@options.threads
@options.force("an existing comparison once the new one is complete")
@click.option("--json", "as_json", is_flag=True, help="Print table.json instead of the table.")
def compare(logs: tuple[Source, ...], methods: str | None, out: Path | None, as_json: bool, **given: Any) -> None:
    """Compare odometry methods on the same decoded scans: accuracy, speed, memory.

    Writes tables, report.html and a rerun recording. Every method runs in its own process; one that crashes, hangs
    or runs out of memory becomes a row with the reason, and the exit code is 1. A verdict, also "not trustworthy",
    is a column and fails nothing. Our methods use no wheel odometry unless --odometry.prior is auto, since the
    others have none.

    \b
    Methods:
      plicp, svd               ours, odometry only
      plicp+loops, svd+loops   ours, with loop closures
      plicp+imu, svd+imu       ours, with the log's IMU
      CLASS, CLASS+loops, CLASS+imu    ours with the matcher of --matcher MODULE:CLASS
      open3d-p2p, open3d-gicp, kiss-icp, small-gicp, small-vgicp
      open3d-p2l, genz-icp, genz-icp-indoor, genz-icp-kitti    3D only
      rko-lio                  3D only, with the log's IMU
      my_module:MyOdometry     your own class, with the methods of scanchain.baselines.Baseline
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

    \b
    Examples:
      scanchain compare log.mcap
      scanchain compare log.mcap --methods plicp,kiss,open3d --every 2
      scanchain compare log.mcap --methods plicp,svd,kiss-icp --repeat 5 --out runs/three
      scanchain compare log.mcap --methods plicp,plicp-fine,mine --config mine.toml --gt truth.tum
      scanchain compare log.mcap --methods plicp,Mine --matcher mine:Mine
      scanchain compare intel.mcap --relations intel.relations --memory-limit 2 --end 600
    """
    from scanchain.commands.terminal import Terminal
    from scanchain.comparison.compare import compare as run_comparison
    from scanchain.comparison.table import TABLE_FILE, text
    from scanchain_viz.recording.results import present_comparison

    out = out or Path("runs") / f"compare-{logs[0].stem}"
    names = [name.strip() for name in (methods or "").split(",") if name.strip()]
    with Terminal("scans") as terminal:
        compared = run_comparison(
            logs, out, present_comparison, terminal, methods=names, command=sys.argv, **given
        )
    click.echo((compared.path / TABLE_FILE).read_text() if as_json else text(compared.table), nl=False)
    if not as_json:
        click.echo(f"written {out}: report.html, compare.rrd, tables")
    if compared.failures:
        raise ScanchainError(f"did not finish: {', '.join(compared.failures)}; see the table for the reason")
