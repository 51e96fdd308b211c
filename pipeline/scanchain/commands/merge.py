"""``scanchain merge``: sessions of one place into one map."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from scanchain.commands.options import OverrideCommand, config_option, overrides, threads_option


@click.command(cls=OverrideCommand, options_metavar="--out DIR [OPTIONS] [--section.key VALUE]...")
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, metavar="DIR", type=click.Path(path_type=Path), help="Directory to create.")
@config_option
@click.option("--fixed", is_flag=True, help="Leave the poses of the first RUN as they are.")
@click.option("--update", is_flag=True, help="Remove from older sessions what newer ones saw through.")
@threads_option
@click.option("--force", is_flag=True, help="Replace DIR if it is the result of an earlier run or merge.")
@click.option("--json", "as_json", is_flag=True, help="Print metrics.json instead of the summary.")
@click.pass_context
def merge(
    ctx: click.Context,
    runs: tuple[Path, ...],
    out: Path,
    as_json: bool,
    **options: Any,
) -> None:
    """Merge the maps of several runs into one map in one frame.

    RUN is a run directory, or that of an earlier merge; where each began need not be known. Loops are closed
    between the runs, and the graph of all of them is optimized and certified. The map is in the frame of the first
    RUN; the order of the others does not matter. Runs that too few closures join to the others, or look-alike
    places only, are named and stay apart; where no two belong together, the exit code is 1. DIR is a map like any
    other: it can be merged further. With --update it follows its newest session: what is gone is removed from the
    keyframes of older ones.

    \b
    Examples:
      scanchain merge runs/monday runs/tuesday --out runs/both
      scanchain merge runs/survey runs/today --fixed --out runs/extended
      scanchain merge runs/both runs/wednesday --update --out runs/week --json
    """
    from scanchain.api import present_merge
    from scanchain.commands.terminal import Terminal
    from scanchain.sessions.merging import merge as merge_maps

    with Terminal("maps") as terminal:
        merged = merge_maps(
            runs, out, terminal, present_merge, overrides=overrides(ctx), command=tuple(sys.argv), **options
        )
    click.echo((merged.path / "metrics.json").read_text() if as_json else merged.summary, nl=False)
    if not as_json:
        click.echo(f"written        {out}")
