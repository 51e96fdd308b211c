"""``scanchain config``: the effective configuration."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from scanchain.commands.options import OverrideCommand, config_option, overrides
from scanchain.config_keys import Value
from scanchain.settings import Settings, config_keys, dump, flatten, load_settings

_INDENT = 6 * " "
_LIDAR = click.option(
    "--lidar", type=click.Choice(["2d", "3d"]), help="The preset that a log of this kind would get."
)


@click.group()
def config() -> None:
    """Show the configuration: every key with unit, range and description.

    \b
    Examples:
      scanchain config show --lidar 2d
      scanchain config dump --lidar 3d > mine.toml
    """


def _effective(command: Callable[..., Any]) -> Callable[..., Any]:
    return click.pass_context(config_option(_LIDAR(command)))


@config.command("show", cls=OverrideCommand)
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@_effective
def show(ctx: click.Context, config_file: Path | None, lidar: str | None, as_json: bool) -> None:
    """Print every key with its value, unit and range, and what it sets.

    \b
    Examples:
      scanchain config show
      scanchain config show --lidar 2d --matching.max_distance_m 0.3
      scanchain config show --config mine.toml --json
    """
    settings = _settings(ctx, config_file, lidar)
    values = flatten(settings.config)
    if as_json:
        keys = config_keys().values()
        rows = [
            {
                "key": k.name,
                "value": _plain(values[k.name]),
                "unit": k.unit,
                "range": k.range,
                "default": _plain(k.default),
                "description": k.description,
            }
            for k in keys
        ]
        click.echo(json.dumps(rows, indent=2))
        return
    click.echo(f"# {settings.source}; * differs from the default")
    cells = [
        (f"{'*' if values[k.name] != k.default else ' '} {k.name}", _text(values[k.name]), k.unit, k.range)
        for k in config_keys().values()
    ]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row, key in zip(cells, config_keys().values(), strict=True):
        click.echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
        click.echo(
            textwrap.fill(
                key.description.replace("``", ""), 100, initial_indent=_INDENT, subsequent_indent=_INDENT
            )
        )


@config.command("dump", cls=OverrideCommand)
@_effective
def dump_settings(ctx: click.Context, config_file: Path | None, lidar: str | None) -> None:
    """Print the effective configuration as TOML, to be edited and given back with --config.

    \b
    Examples:
      scanchain config dump --lidar 2d > mine.toml
      scanchain config dump --config mine.toml --loops.enabled false
    """
    click.echo(dump(_settings(ctx, config_file, lidar).config), nl=False)


def _settings(ctx: click.Context, file: Path | None, lidar: str | None) -> Settings:
    dimension = int(lidar[0]) if lidar else None
    return load_settings(dimension, file=file, overrides=overrides(ctx))


def _text(value: Value) -> str:
    return (
        str(value).lower() if isinstance(value, bool) else f"{value!r}" if isinstance(value, str) else f"{value:g}"
    )


def _plain(value: Value) -> Value | None:
    return None if value == float("inf") else value
