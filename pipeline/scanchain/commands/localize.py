"""``scanchain localize``: the poses of a log in a map."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands.options import (
    LOG,
    OverrideCommand,
    collect_garbage_seldom,
    config_option,
    ground_truth_option,
    matcher_option,
    max_gap_option,
    overrides,
    part_options,
    threads_option,
)
from scanchain.errors import InputError
from scanchain.files import Source

if TYPE_CHECKING:
    from scanchain.data import Pose
    from scanchain.maps import SavedMap


@click.command(cls=OverrideCommand, options_metavar="--map RUN --out DIR [OPTIONS] [--section.key VALUE]...")
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=LOG)
@click.option(
    "--map", "prior", required=True, metavar="RUN", type=click.Path(path_type=Path), help="Run directory or map."
)
@click.option("--out", required=True, metavar="DIR", type=click.Path(path_type=Path), help="Directory to create.")
@click.option(
    "--initial",
    metavar="X,Y,YAW|FILE.tum",
    help="Pose of the first scan in the map: meters and degrees, or a TUM file. [default: searched for]",
)
@config_option
@part_options()
@matcher_option
@ground_truth_option()
@max_gap_option
@threads_option
@click.option("--force", is_flag=True, help="Replace an existing directory once the new one is complete.")
@click.option("--strict", is_flag=True, help="Exit with 1 unless the verdict is trustworthy.")
@click.option("--json", "as_json", is_flag=True, help="Print metrics.json instead of the summary.")
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
    click.echo((out / "metrics.json").read_text() if as_json else localized.summary, nl=False)
    if not as_json:
        click.echo(f"{'written':<15}{out}")
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
