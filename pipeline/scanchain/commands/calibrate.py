"""``scanchain calibrate``: parameters of the sensors of a log."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from scanchain.commands import options
from scanchain.commands.options import PATH, OverrideCommand
from scanchain.errors import folded
from scanchain.files import Source, json_text
from scanchain.settings import Override, load_settings

if TYPE_CHECKING:
    from scanchain.calibration import Calibration


@click.command(cls=OverrideCommand)
@options.logs
@click.option(
    "--out", metavar="FILE.toml", type=PATH, help="Write what is observable, for run --config FILE.toml."
)
@options.force("an existing file")
@options.config
@options.part()
@options.threads
@options.as_json
def calibrate(
    logs: tuple[Source, ...],
    out: Path | None,
    force: bool,
    config_file: Path | None,
    as_json: bool,
    overrides: tuple[Override, ...],
) -> None:
    """Estimate the parameters of a log's sensors from its motion, each with its standard deviation.

    \b
    Lidar        errors of its vertical angles and of its ranges
    Lidars       pose of each further --topic in the frame of the first
    IMU          rotation in the lidar's frame, bias and delay of the gyro
    Wheels       pose of the lidar on the base, scales of distances and turns, delay

    Where the motion of the log does not determine a parameter, the table says what is lacking, and nothing is
    written. Poses that the log states, or --config, are where the estimation begins.

    \b
    Examples:
      scanchain calibrate log.mcap
      scanchain calibrate log.mcap --out sensors.toml
      scanchain calibrate log.mcap --topic /front/points --topic /rear/points --out sensors.toml
      scanchain run log.mcap --config sensors.toml
    """
    options.collect_garbage_seldom()
    if out is not None:
        options.check_output(out, force=force, endings=(".toml",))
    from scanchain.calibration import calibrate as calibrate_log
    from scanchain.commands.terminal import Terminal
    from scanchain.logs import open_log

    log = open_log(logs, load_settings(file=config_file, overrides=overrides).config.log)
    with Terminal("scans") as terminal:
        config = load_settings(log.dimension, file=config_file, overrides=overrides).config
        found = calibrate_log(log, config, terminal)
    click.echo(json_text(found) if as_json else folded(_text(found)))
    if out is not None:
        out.write_text(found.toml(), encoding="utf-8")
        click.echo(f"written {out}", err=as_json)


def _text(found: Calibration) -> str:
    """A parameter per line, by sensor."""
    lines, last = list[str](), ""
    width = max((len(each.name) for each in found.parameters), default=0)
    for each in found.parameters:
        if each.sensor != last:
            lines.append(each.sensor)
            last = each.sensor
        value = f"{each.value:9.4f} ± {each.sigma:.4f} {each.unit}" if math.isfinite(each.sigma) else " " * 9
        shown = f"not observable: {each.why}" if each.why else value.rstrip()
        lines.append(f"  {each.name:<{width}}  {shown}")
    return "\n".join(lines)
