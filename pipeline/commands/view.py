"""``scanchain view``: the recording of a run in the rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.errors import InputError

if TYPE_CHECKING:
    from pipeline.recorder import Viewing


@click.command()
@click.argument("directory", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--web", is_flag=True, help="Serve it to a browser on this machine, until Ctrl-C.")
@click.pass_context
def view(ctx: click.Context, directory: Path, web: bool) -> None:
    """Open the recording of a run in the rerun viewer.

    DIR is a run directory, or a .rrd file.

    \b
    Examples:
      scanchain view runs/log
      scanchain view runs/log --web
    """
    path = directory / "recording.rrd" if directory.is_dir() else directory
    if not path.exists():
        raise InputError(f"{path}: no such file; scanchain run writes it unless --rerun leaves out save")
    if path.suffix != ".rrd":
        raise InputError(f"{path}: is no recording (.rrd); give a run directory")
    viewing: Viewing = ctx.obj
    viewing.show(path, web)
