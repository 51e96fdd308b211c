"""``scanchain doctor``: faults of a log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from scanchain.commands.options import OverrideCommand, json_option, json_text, logs_argument, part_options
from scanchain.files import Source
from scanchain.settings import Override, load_settings

if TYPE_CHECKING:
    from scanchain.config import Config
    from scanchain.logs.doctor.doctor import Diagnosis


@click.command(cls=OverrideCommand)
@logs_argument
@part_options()
@json_option
def doctor(logs: tuple[Source, ...], as_json: bool, overrides: tuple[Override, ...]) -> None:
    """Check every scan of a log: problems, their effect on the result, and the flags that fix them.

    Any configuration key is a flag, as for scanchain run, so that a fix can be tried.

    \b
    Examples:
      scanchain doctor log.mcap
      scanchain doctor drive.bag --topic /lidar_front/points --json
      scanchain doctor log.mcap --log.point_times ms
    """
    from scanchain.commands.terminal import Terminal
    from scanchain.logs.doctor.doctor import examine

    def config_for(dimension: int) -> Config:
        return load_settings(dimension, overrides=overrides).config

    with Terminal("scans") as terminal:
        found = examine(logs, config_for, load_settings(overrides=overrides).config.log, terminal.count)
    click.echo(json_text(found) if as_json else _text(found))


def _text(found: Diagnosis) -> str:
    lines = [f"{', '.join(found.files)} {found.topic} ({found.dimension}D)"]
    for finding in found.findings:
        lines.append(f"{finding.severity:<8} {finding.check:<12} {finding.found}")
        remedy = finding.remedy and f"→ {finding.remedy}"
        lines += [f"{'':<21} {line}" for line in (finding.effect, remedy) if line]
    return "\n".join([*lines, *(f"{'note':<21} {note}" for note in found.notes)])
