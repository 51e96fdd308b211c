"""``scanchain doctor``: faults of a log."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from scanchain.commands.options import LOG, OverrideCommand, overrides, part_options
from scanchain.files import Source
from scanchain.settings import load_settings

if TYPE_CHECKING:
    from scanchain.logs.doctor import Diagnosis


@click.command(cls=OverrideCommand, options_metavar="[OPTIONS] [--section.key VALUE]...")
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=LOG)
@part_options()
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.pass_context
def doctor(ctx: click.Context, logs: tuple[Source, ...], as_json: bool) -> None:
    """Check every scan of a log: problems, their effect on the result, and the flags that fix them.

    Any configuration key is a flag, as for scanchain run, so that a fix can be tried.

    \b
    Examples:
      scanchain doctor log.mcap
      scanchain doctor drive.bag --topic /lidar_front/points --json
      scanchain doctor log.mcap --log.point_times ms
    """
    from scanchain.commands.terminal import Terminal
    from scanchain.logs.doctor import examine

    chosen = overrides(ctx)
    early = load_settings(overrides=chosen).config

    with Terminal("scans") as terminal:
        found = examine(
            logs, lambda dimension: load_settings(dimension, overrides=chosen).config, early.log, terminal.count
        )
    click.echo(json.dumps(asdict(found), indent=2) if as_json else _text(found))


def _text(found: Diagnosis) -> str:
    lines = [f"{', '.join(found.files)} {found.topic} ({found.dimension}D)"]
    for finding in found.findings:
        lines.append(f"{finding.severity:<8} {finding.check:<12} {finding.found}")
        lines += [f"{'':<21} {line}" for line in (finding.effect, _remedy(finding.remedy)) if line]
    return "\n".join([*lines, *(f"{'note':<21} {note}" for note in found.notes)])


def _remedy(remedy: str) -> str:
    return f"→ {remedy}" if remedy else ""
