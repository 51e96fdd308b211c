"""``scanchain run``, ``check`` and ``view``: a run, the verdict on it, and its recording."""

from __future__ import annotations

import shlex
import sys
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands import options
from scanchain.commands.options import PATH, NumberRange, OverrideCommand
from scanchain.errors import InputError, ScanchainError, counted, folded
from scanchain.files import Source, json_text, source_of
from scanchain.settings import Override

if TYPE_CHECKING:
    from scanchain.runs.job import SinkName

_SINKS: tuple[SinkName, ...] = ("save", "spawn", "connect", "web")


@click.command(cls=OverrideCommand, options_metavar="[OPTIONS] [--section.key VALUE]...")
@options.logs
@options.result(
    "an existing run directory once the new one is complete",
    "Run directory to create.  [default: runs/NAME by the name of LOG, with a number where that is taken]",
    required=False,
)
@options.of_log
@click.option(
    "--rerun",
    default="save",
    metavar="LIST",
    help="Where the recording goes: save, spawn, connect, web, several with commas, or off.",
)
@options.no_loops
@options.error_bars
@click.option("--resume", is_flag=True, help="Resume a run that was killed or stopped from its last checkpoint.")
@click.option(
    "--checkpoint",
    "checkpoint_s",
    type=NumberRange(0.0),
    default=10.0,
    metavar="SECONDS",
    help="Time between checkpoints; writing them takes at most 5 % of the run.",
)
@options.strict
def run(out: Path | None, rerun: str, strict: bool, as_json: bool, **given: Any) -> int:
    """Compute the trajectory and the map of a log, with a rerun recording.

    LOG is an MCAP file, any other format that scanchain convert reads, or the address of one: of an MCAP at
    https:// or s3:// only the parts that are read are downloaded. Several files are read as one log. Any
    configuration key is a flag; scanchain config show lists them.

    \b
    Examples:
      scanchain run log.mcap
      scanchain run log.mcap --out runs/log --rerun save,spawn
      scanchain run intel.clf.bz2 --out runs/intel
      scanchain run scans/ --out runs/scans --log.rate_hz 10
      scanchain run part_0.mcap part_1.mcap --out runs/log --topic /lidar_front/points
      scanchain run s3://bucket/log.mcap --out runs/minute --start 600 --end 660
      scanchain run log.mcap --out runs/log --resume
      scanchain run log.mcap --out runs/svd --matcher svd --no-loops --local_map.voxel_size_m 0.5
      scanchain run log.mcap --out runs/first_minute --end 60 --gt truth.tum --json
    """
    options.collect_garbage_seldom()
    from scanchain.api import open_recorder, write_report
    from scanchain.commands.terminal import Terminal
    from scanchain.runs.job import Job
    from scanchain.runs.resume import how_to_resume
    from scanchain.runs.run import run as run_log

    command = tuple(sys.argv)
    if out is None:
        out = _unnamed(given["logs"][0], is_taken_over=given["resume"] or given["force"])
        command += ("--out", str(out))
    job = Job(out=out, sinks=_sinks(rerun), command=command, **given)
    with Terminal("scans") as terminal:
        finished = run_log(job, open_recorder, terminal, write_report)
    fails = finished.metrics.verdict.fails(strict=strict)
    if fails and as_json:  # otherwise the summary shows the verdict
        click.echo(f"error: {finished.path}: {finished.metrics.sentence}", err=True)
    is_seen = sys.stdout.isatty() and not as_json  # then the summary already shows these warnings
    for warning in [each for each in finished.warnings if not (is_seen and each in finished.summary)]:
        click.echo(f"warning: {warning}", err=True)
    options.print_summary(finished.path if finished.stopped else out, finished.summary, as_json=as_json)
    if not as_json and not finished.stopped:
        recording = f", scanchain view {shlex.quote(str(out))}" if "save" in job.sinks else ""
        click.echo(f"open           {out}/report.html{recording}")
    if finished.stopped:
        again = how_to_resume(job.command)
        raise ScanchainError(f"{finished.stopped}; the results so far are in {finished.path}; {again}")
    return int(fails)


def _unnamed(log: Source, *, is_taken_over: bool) -> Path:
    """Default run directory of a log: runs/NAME if free or taken over, else the first free of runs/NAME_2, ..."""
    name = str(log).rstrip("/").rpartition("/")[2].partition(".")[0] or "log"
    paths = (Path("runs", each) for each in chain([name], (f"{name}_{number}" for number in count(2))))
    return next(path for path in paths if is_taken_over or not path.exists())


def _sinks(text: str) -> frozenset[SinkName]:
    """Destinations of the recording, from a list such as ``save,spawn``."""
    words = [word.strip() for word in text.split(",")]
    if words == ["off"]:
        return frozenset()
    chosen = frozenset(_SINKS) & set(words)
    unknown = [word for word in words if word not in _SINKS]
    if unknown:
        raise InputError(f"--rerun is {text!r}; give off, or one or several of {', '.join(_SINKS)} with commas")
    if len(chosen - {"save"}) > 1:
        raise InputError(f"--rerun is {text!r}; give only one of spawn, connect, web along with save")
    return chosen


@click.command(cls=OverrideCommand)
@click.argument("sources", metavar="RUN|LOG...", nargs=-1, required=True, type=source_of)
@click.option("--trajectory", metavar="FILE.tum", type=PATH, help="Check this trajectory of the lidar in LOG.")
@options.part()
@options.strict
@options.as_json
def check(
    sources: tuple[Source, ...],
    trajectory: Path | None,
    strict: bool,
    as_json: bool,
    overrides: tuple[Override, ...],
) -> int:
    """Recompute the verdict on a run directory, or check any trajectory of a log.

    A trajectory of another tool is checked at the scans whose stamps it has: against wheel odometry and constant
    velocity, and by aligning each scan to a map of those before. Exit code 1: not trustworthy.

    \b
    Examples:
      scanchain check runs/log
      scanchain check runs/log --strict --json
      scanchain check --trajectory kiss.tum log.mcap
      scanchain check --trajectory other.tum part_0.mcap part_1.mcap --topic /lidar_front/points
    """
    if trajectory is None:
        if len(sources) != 1 or not isinstance(sources[0], Path) or overrides:
            raise InputError("check takes one run directory; to check a log, name a --trajectory FILE.tum")
        from scanchain.runs.judging import judge_run

        judged = judge_run(sources[0])
    else:
        from scanchain.runs.judging import judge_trajectory

        judged, missing = judge_trajectory(trajectory, sources, overrides)
        if missing:
            click.echo(
                f"warning: {counted(missing, 'scan')} without a pose in {trajectory} are left out", err=True
            )
    text = folded("\n".join([judged.headline, *(f"  {reason}" for reason in judged.reasons)]))
    tree = {
        "verdict": judged.verdict,
        "verdict_reason": judged.reason,
        "verdict_error": judged.error,
        "segments": judged.segments,
    }
    click.echo(json_text(tree) if as_json else text)
    return int(judged.verdict.fails(strict=strict))


@click.command()
@click.argument("directory", metavar="DIR", type=PATH)
@click.option("--web", is_flag=True, help="Serve it to a browser on this machine, until Ctrl-C.")
@click.option("--png", metavar="FILE", type=PATH, help="Draw trajectory, ground truth and map to a PNG instead.")
@click.option("--gif", metavar="FILE", type=PATH, help="Draw the growing map to an animated GIF instead.")
@options.force("an existing picture")
def view(directory: Path, web: bool, png: Path | None, gif: Path | None, force: bool) -> None:
    """Open the recording of a run in the rerun viewer, or draw its map to a picture.

    DIR is a directory of run, localize, merge or changes, or a .rrd file; a picture needs a trajectory, an
    animation (less than 3 MB) the keyframes of run or merge.

    \b
    Examples:
      scanchain view runs/log
      scanchain view runs/log --web
      scanchain view runs/log --png log.png
      scanchain view runs/log --gif log.gif
    """
    from scanchain.commands.terminal import Terminal

    if picture := png or gif:
        from scanchain_viz.pictures.animation import draw_growing_map
        from scanchain_viz.pictures.maps import draw_run

        options.check_output(picture, force=force, endings=(".png" if png else ".gif",))
        (draw_run if png else draw_growing_map)(directory, picture)
        click.echo(picture)
        return
    path = directory / "recording.rrd" if directory.is_dir() else directory
    if not path.exists() or path.suffix != ".rrd":
        raise InputError(
            f"{directory}: no recording; give a .rrd file, or a directory of scanchain run with --rerun save"
        )
    from scanchain_viz.recording.viewer import show

    with Terminal("recordings"):  # SIGTERM ends it like Ctrl-C, including the server
        show(path, click.echo, in_browser=web)
