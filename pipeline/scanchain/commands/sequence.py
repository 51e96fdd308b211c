"""``scanchain sequence``: the catalog of logs."""

from __future__ import annotations

import json
from pathlib import Path

import click


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
