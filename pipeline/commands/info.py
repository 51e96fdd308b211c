"""``scanchain info``: what is in a log."""

from __future__ import annotations

import json
from pathlib import Path

import click


@click.command()
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def info(logs: tuple[Path, ...], as_json: bool) -> None:
    r"""Print what is in a log: topics, types, rates, and what a run would use.

    \b
    Examples:
      scanchain info log.mcap
      scanchain info part_0.mcap part_1.mcap --json
    """
    from pipeline.logs import describe

    description = describe(logs)
    click.echo(json.dumps(asdict(description), indent=2) if as_json else description)
