"""``scanchain run``: the main job."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands.options import (
    NumberRange,
    OverrideCommand,
    collect_garbage_seldom,
    log_options,
    logs_argument,
    no_loops_option,
    result_options,
    strict_option,
)
from scanchain.errors import InputError, ScanchainError

if TYPE_CHECKING:
    from scanchain.runs.job import SinkName

_SINKS: tuple[SinkName, ...] = ("save", "spawn", "connect", "web")


@click.command(cls=OverrideCommand, options_metavar="--out DIR [OPTIONS] [--section.key VALUE]...")
@logs_argument
@result_options("an existing run directory once the new one is complete", out="Run directory to create.")
@log_options
@click.option(
    "--rerun",
    default="save",
    show_default=True,
    metavar="LIST",
    help="Where the recording goes: save, spawn, connect, web, several with commas, or off.",
)
@no_loops_option
@click.option("--resume", is_flag=True, help="Resume a run that was killed or stopped from its last checkpoint.")
@click.option(
    "--checkpoint",
    "checkpoint_s",
    type=NumberRange(0.0),
    default=10.0,
    show_default=True,
    metavar="SECONDS",
    help="Time between checkpoints; writing them takes at most 5 % of the run.",
)
@strict_option
def run(out: Path, rerun: str, strict: bool, as_json: bool, **options: Any) -> int:
    """Compute the trajectory and the map of a log, with a rerun recording.

    LOG is an MCAP file, any other format that scanchain convert reads, or the address of one: of an MCAP at
    https:// or s3:// only the parts that are read are downloaded. Several files are read as one log. Any
    configuration key is a flag; scanchain config show lists them.

    \b
    Examples:
      scanchain run log.mcap --out runs/log
      scanchain run log.mcap --out runs/log --rerun save,spawn
      scanchain run intel.clf.bz2 --out runs/intel
      scanchain run scans/ --out runs/scans --log.rate_hz 10
      scanchain run part_0.mcap part_1.mcap --out runs/log --topic /lidar_front/points
      scanchain run s3://bucket/log.mcap --out runs/minute --start 600 --end 660
      scanchain run log.mcap --out runs/log --resume
      scanchain run log.mcap --out runs/svd --matcher svd --no-loops --local_map.voxel_size_m 0.5
      scanchain run log.mcap --out runs/first_minute --end 60 --gt truth.tum --json
    """
    collect_garbage_seldom()
    from scanchain.api import open_recorder, write_report
    from scanchain.commands.terminal import Terminal
    from scanchain.runs.job import Job
    from scanchain.runs.resume import how_to_resume
    from scanchain.runs.run import run as run_log

    job = Job(out=out, sinks=_sinks(rerun), command=tuple(sys.argv), **options)
    with Terminal("scans") as terminal:
        finished = run_log(job, open_recorder, terminal, write_report)
    is_seen = sys.stdout.isatty() and not as_json  # the summary holds the same sentences
    fails = finished.metrics.verdict.fails(strict=strict)
    if fails and not is_seen:
        click.echo(f"error: {finished.path}: {finished.metrics.sentence}", err=True)
    for warning in [each for each in finished.warnings if not (is_seen and each in finished.summary)]:
        click.echo(f"warning: {warning}", err=True)
    click.echo((finished.path / "metrics.json").read_text() if as_json else finished.summary, nl=False)
    if finished.stopped:
        again = how_to_resume(job.command)
        raise ScanchainError(f"{finished.stopped}; the results so far are in {finished.path}; {again}")
    if not as_json:
        click.echo(f"written        {out}")
    return int(fails)


def _sinks(text: str) -> frozenset[SinkName]:
    """Destinations of the recording, from a list such as ``save,spawn``."""
    words = [word.strip() for word in text.split(",")]
    if words == ["off"]:
        return frozenset()
    chosen = frozenset(_SINKS) & set(words)
    unknown = [word for word in words if word not in _SINKS]
    if unknown:
        raise InputError(f"--rerun is {text!r}; take off, or one or several of {', '.join(_SINKS)} with commas")
    if len(chosen - {"save"}) > 1:
        raise InputError(f"--rerun is {text!r}; take only one of spawn, connect, web beside save")
    return chosen
