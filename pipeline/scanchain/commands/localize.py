"""``scanchain localize``: the poses of a log in a map."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands.options import (
    LOG,
    PATH,
    OverrideCommand,
    collect_garbage_seldom,
    log_options,
    overrides,
    print_summary,
    result_options,
    strict_option,
)
from scanchain.errors import InputError
from scanchain.files import Source

if TYPE_CHECKING:
    from scanchain.data import Pose
    from scanchain.maps import SavedMap


@click.command(cls=OverrideCommand, options_metavar="--map RUN --out DIR [OPTIONS] [--section.key VALUE]...")
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=LOG)
@click.option("--map", "prior", required=True, metavar="RUN", type=PATH, help="Run directory or map.")
@result_options("an existing directory once the new one is complete")
@click.option(
    "--initial",
    metavar="X,Y,YAW|FILE.tum",
    help="Pose of the first scan in the map: meters and degrees, or a TUM file. [default: searched for]",
)
@log_options
@strict_option
@click.pass_context
def localize(
    ctx: click.Context,
    logs: tuple[Source, ...],
    prior: Path,
    out: Path,
    initial: str | None,
    strict: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Find a log in the map of an earlier run, and follow it there.

    Without --initial the place is searched for anywhere in the map. Exit code 1: the log is not from this place.

    \b
    Examples:
      scanchain localize monday.mcap --map runs/sunday --out runs/monday
      scanchain localize monday.mcap --map runs/sunday --out runs/monday --initial 12.5,-3,90
      scanchain localize part_0.mcap part_1.mcap --map runs/sunday --out runs/monday --topic /points
    """
    collect_garbage_seldom()
    from scanchain.api import draw_localization
    from scanchain.commands.terminal import Terminal
    from scanchain.runs.job import Job
    from scanchain.sessions.localize import localize as localize_log

    job = Job(logs=logs, out=out, overrides=overrides(ctx), command=tuple(sys.argv), **options)
    first = None if initial is None else _initial(initial)
    with Terminal("scans") as terminal:
        localized = localize_log(job, prior, terminal, draw_localization, initial=first)
    fails = localized.metrics.verdict.fails(strict=strict)
    if fails and not sys.stdout.isatty():
        click.echo(f"error: {out}: {localized.metrics.sentence}", err=True)
    print_summary(out, localized.summary, as_json=as_json)
    if fails:
        ctx.exit(1)


def _initial(text: str) -> Callable[[int, SavedMap], Pose]:
    from scanchain.sessions.localize import pose_in_file, pose_near

    if text.endswith(".tum"):
        return pose_in_file(Path(text))
    try:
        x_m, y_m, yaw_deg = map(float, text.split(","))
    except ValueError:
        raise InputError(f"--initial is {text!r}; give x,y,yaw in meters and degrees, or a file .tum") from None
    return pose_near(x_m, y_m, yaw_deg)
