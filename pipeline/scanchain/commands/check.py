"""``scanchain check``: the verdict on a run, or on the trajectory of another tool."""

from __future__ import annotations

from pathlib import Path

import click

from scanchain.commands.options import (
    LOG,
    PATH,
    OverrideCommand,
    json_option,
    json_text,
    part_options,
    strict_option,
)
from scanchain.errors import InputError, counted
from scanchain.files import Source
from scanchain.settings import Override


@click.command(cls=OverrideCommand)
@click.argument("sources", metavar="RUN|LOG...", nargs=-1, required=True, type=LOG)
@click.option("--trajectory", metavar="FILE.tum", type=PATH, help="Check this trajectory of the lidar in LOG.")
@part_options()
@strict_option
@json_option
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
        from scanchain.runs.vouching import judge_run

        judged = judge_run(sources[0])
    else:
        from scanchain.runs.foreign import judge_trajectory

        judged, missing = judge_trajectory(trajectory, sources, overrides)
        if missing:
            click.echo(
                f"warning: {counted(missing, 'scan')} without a pose in {trajectory} are left out", err=True
            )
    lines = [judged.sentence, *(f"  {stretch.text}" for stretch in judged.unnamed)]
    tree = {
        "verdict": judged.verdict,
        "verdict_reason": judged.reason,
        "verdict_error": judged.error,
        "stretches": judged.stretches,
    }
    click.echo(json_text(tree) if as_json else "\n".join(lines))
    return int(judged.verdict.fails(strict=strict))
