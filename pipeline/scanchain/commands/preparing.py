"""``scanchain config``, ``sequence`` and ``warm-up``: configuration, logs and compiled kernels ahead of a run."""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import click

from scanchain.commands.options import OverrideCommand, config_option, overrides
from scanchain.config_keys import Value
from scanchain.errors import ScanchainError
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


@click.group()
def sequence() -> None:
    """Catalog of logs known by name, simulated and published.

    \b
    Examples:
      scanchain sequence list
      scanchain sequence get demo-office --out logs
    """


@sequence.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def list_sequences(as_json: bool) -> None:
    """List the catalog.

    \b
    Examples:
      scanchain sequence list
      scanchain sequence list --json
    """
    from msgspec import to_builtins

    from scanchain import catalog

    entries = {name: catalog.load(name) for name in catalog.names()}
    if as_json:
        click.echo(json.dumps({name: to_builtins(entry) for name, entry in entries.items()}, indent=2))
        return
    width = max(map(len, entries))
    for name, entry in entries.items():
        kind = type(entry.source).__name__.lower()
        click.echo(f"{name:<{width}}  {entry.dimension}D  {kind:<9}  {entry.title}")


@sequence.command("get")
@click.argument("name", metavar="NAME")
@click.option(
    "--out",
    default=Path("logs"),
    show_default=True,
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="Folder of the log.",
)
@click.option("--force", is_flag=True, help="Make it again even if it exists.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
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
    click.echo(json.dumps({"name": name, "path": str(path)}) if as_json else path)


_WORLDS = {"2d": ("office", 8), "3d": ("town", 3)}  # with the seconds driven there
_EXPECTED = (0, 1)  # 1: logs this short are not all judged trustworthy


@click.command()
@click.argument("which", default="all", type=click.Choice(("2d", "3d", "all")))
def warm_up(which: str) -> None:
    """Compile what run, localize, merge and simulate need into the cache, instead of in the first of them.

    For container images and CI: a minute or so on two cores, seconds where all is compiled. The cache is of this
    machine's kind of processor; it lies in the folder NUMBA_CACHE_DIR, by default in ~/.cache/scanchain.

    \b
    Examples:
      scanchain warm-up
      scanchain warm-up 2d
    """
    from numba import config

    kinds = tuple(_WORLDS) if which == "all" else (which,)
    click.echo(
        f"compiling what {' and '.join(kind.upper() for kind in kinds)} logs need, once after an installation"
    )
    began = perf_counter()
    with TemporaryDirectory() as folder, ThreadPoolExecutor(len(kinds)) as together:
        for _ in together.map(_go_through, kinds, [Path(folder, kind) for kind in kinds]):
            pass
    where = config.CACHE_DIR or "beside the source"  # pyright: ignore[reportAttributeAccessIssue]
    click.echo(f"compiled in {perf_counter() - began:.0f} s: {where}")


def _go_through(kind: str, folder: Path) -> None:
    """Process a short synthetic log by every command whose kernels are compiled ahead."""
    world, seconds = _WORLDS[kind]
    log, later, run, again = f"{folder}.mcap", f"{folder}_later.mcap", f"{folder}/run", f"{folder}/again"
    for words in (
        ("simulate", world, log, "--duration", f"{seconds}"),
        ("run", log, "--out", run),
        ("simulate", world, later, "--duration", f"{seconds + 1}", "--changed", "1"),
        ("localize", later, "--map", run, "--out", f"{folder}/found"),
        ("run", later, "--out", again, "--rerun", "off"),
        ("merge", run, again, "--out", f"{folder}/merged"),
    ):
        done = subprocess.run(
            [sys.executable, "-P", "-m", "scanchain", *words], capture_output=True, text=True, check=False
        )
        if done.returncode not in _EXPECTED:
            raise ScanchainError(f"scanchain {' '.join(words)}: {done.stderr.strip().rpartition('error: ')[2]}")
