"""``scanchain config``, ``sequence`` and ``warm-up``: configuration, logs and compiled kernels ahead of a run."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from time import perf_counter
from typing import Any

import click

from scanchain.commands import options
from scanchain.commands.options import PATH, OverrideCommand
from scanchain.config_keys import Value
from scanchain.errors import ScanchainError
from scanchain.files import json_text
from scanchain.settings import Override, Settings, config_keys, dump, flatten, load_settings

_INDENT = 6 * " "


@click.group()
def config() -> None:
    """Show the configuration: every key with unit, range and description.

    \b
    Examples:
      scanchain config show --lidar 2d
      scanchain config dump --lidar 3d > mine.toml
    """


def _effective(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command that receives the ``settings`` resulting from --lidar, --config and all keys."""

    @wraps(command)
    def run(config_file: Path | None, lidar: str | None, overrides: tuple[Override, ...], **given: Any) -> None:
        dimension = int(lidar[0]) if lidar else None
        command(load_settings(dimension, file=config_file, overrides=overrides), **given)

    kinds, help = click.Choice(["2d", "3d"]), "The preset that a log of this kind would get."
    return options.config(click.option("--lidar", type=kinds, help=help)(run))


@config.command("show", cls=OverrideCommand)
@options.as_json
@_effective
def show(settings: Settings, as_json: bool) -> None:
    """Print every key with its value, unit and range, and what it sets.

    \b
    Examples:
      scanchain config show
      scanchain config show --lidar 2d --matching.max_distance_m 0.3
      scanchain config show --config mine.toml --json
    """
    values, keys = flatten(settings.config), config_keys()
    if as_json:
        names = ("unit", "range", "default", "description")
        rows = [
            {"key": name, "value": values[name]} | {each: getattr(key, each) for each in names}
            for name, key in keys.items()
        ]
        click.echo(json_text(rows))
        return
    click.echo(f"# {settings.source}; * differs from the default")
    cells = [
        (f"{' ' if values[name] == key.default else '*'} {name}", _text(values[name]), key.unit, key.range)
        for name, key in keys.items()
    ]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for cell, key in zip(cells, keys.values(), strict=True):
        click.echo("  ".join(map(str.ljust, cell, widths)).rstrip())
        description = key.description.replace("``", "")
        click.echo(textwrap.fill(description, 100, initial_indent=_INDENT, subsequent_indent=_INDENT))


@config.command("dump", cls=OverrideCommand)
@_effective
def dump_settings(settings: Settings) -> None:
    """Print the effective configuration as TOML, to be edited and given back with --config.

    \b
    Examples:
      scanchain config dump --lidar 2d > mine.toml
      scanchain config dump --config mine.toml --loops.enabled false
    """
    click.echo(dump(settings.config), nl=False)


def _text(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, str) else f"{value:g}"


@click.group()
def sequence() -> None:
    """Catalog of logs known by name, simulated and published.

    \b
    Examples:
      scanchain sequence list
      scanchain sequence get demo-office --out logs
    """


@sequence.command("list")
@options.as_json
def list_sequences(as_json: bool) -> None:
    """List the catalog.

    \b
    Examples:
      scanchain sequence list
      scanchain sequence list --json
    """
    from scanchain import catalog

    entries = {name: catalog.load(name) for name in catalog.names()}
    if as_json:
        click.echo(json_text(entries))
        return
    width = max(map(len, entries))
    for name, entry in entries.items():
        kind = type(entry.source).__name__.lower()
        click.echo(f"{name:<{width}}  {entry.dimension}D  {kind:<9}  {entry.title}")


@sequence.command("get")
@click.argument("name", metavar="NAME")
@click.option("--out", default=Path("logs"), metavar="DIR", type=PATH, help="Folder of the log.")
@click.option("--force", is_flag=True, help="Make it again even if it exists.")
@options.as_json
def get_sequence(name: str, out: Path, force: bool, as_json: bool) -> None:
    """Simulate a log of the catalog, or download and convert it, unless it exists, and print its path.

    An interrupted download is resumed. For recordings that require an account, the steps are printed.

    \b
    Examples:
      scanchain sequence get demo-office
      scanchain sequence get demo-town --out logs --force
      scanchain sequence get intel
    """
    from scanchain import catalog
    from scanchain.commands.terminal import Terminal

    unit = "MiB" if isinstance(catalog.load(name).source, catalog.Download) else "scans"
    with Terminal(unit) as terminal:
        path = catalog.prepare(name, out, force=force, progress=terminal.count)
    click.echo(json_text({"name": name, "path": str(path)}) if as_json else path)


@click.command()
@click.argument("which", default="all", type=click.Choice(("2d", "3d", "all")))
def warm_up(which: str) -> None:
    """Compile what run, localize, merge and simulate need into the cache, instead of in the first of them.

    For container images and CI: on all cores, half a minute on two, nothing where all is compiled. The cache is of
    this machine's kind of processor; it lies in the folder NUMBA_CACHE_DIR, by default in ~/.cache/scanchain.

    \b
    Examples:
      scanchain warm-up
      scanchain warm-up 2d
    """
    from numba import config

    from scanchain.ahead import KINDS, compile_ahead
    from scanchain.commands.terminal import Terminal

    kinds = KINDS if which == "all" else (which, "rest")
    began = perf_counter()
    with Terminal("kernels") as terminal:
        is_whole = compile_ahead(kinds, terminal.compiling)
    where: str = config.CACHE_DIR  # pyright: ignore[reportAttributeAccessIssue]
    if not where:
        raise ScanchainError("no folder can keep what is compiled: set NUMBA_CACHE_DIR to one that can be written")
    if not is_whole:
        raise ScanchainError("a process that compiles ended early (out of memory?); runs compile what they call")
    click.echo(f"compiled in {perf_counter() - began:.0f} s: {where}")
