"""``scanchain check``: the verdict on a run, or on the trajectory of another tool."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from scanchain.commands.options import LOG, PATH, OverrideCommand, overrides, part_options, strict_option
from scanchain.errors import InputError
from scanchain.files import Source

if TYPE_CHECKING:
    from scanchain.verdict import Judged


@click.command(cls=OverrideCommand, options_metavar="[OPTIONS] [--section.key VALUE]...")
@click.argument("sources", metavar="RUN|LOG...", nargs=-1, required=True, type=LOG)
@click.option("--trajectory", metavar="FILE.tum", type=PATH, help="Check this trajectory of the lidar in LOG.")
@part_options()
@strict_option
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.pass_context
def check(
    ctx: click.Context,
    sources: tuple[Source, ...],
    trajectory: Path | None,
    strict: bool,
    as_json: bool,
) -> None:
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
    settings = overrides(ctx)
    if trajectory is None:
        if len(sources) != 1 or not isinstance(sources[0], Path) or settings:
            raise InputError("check takes one run directory; to check a log, name a --trajectory FILE.tum")
        from scanchain.runs.vouching import judge_run

        judged = judge_run(sources[0])
    else:
        from scanchain.errors import counted
        from scanchain.runs.vouching import judge_trajectory

        judged, missing = judge_trajectory(trajectory, sources, settings)
        if missing:
            click.echo(
                f"warning: {counted(missing, 'scan')} without a pose in {trajectory} are left out", err=True
            )
    lines = [judged.sentence, *(f"  {stretch.text}" for stretch in judged.unnamed)]
    click.echo(_json(judged) if as_json else "\n".join(lines))
    if judged.verdict.fails(strict=strict):
        ctx.exit(1)


def _json(judged: Judged) -> str:
    import msgspec

    tree = {
        "verdict": judged.verdict,
        "verdict_reason": judged.reason,
        "verdict_error": judged.error,
        "stretches": judged.stretches,
    }
    return msgspec.json.format(msgspec.json.encode(tree), indent=2).decode()
