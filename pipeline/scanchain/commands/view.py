"""``scanchain view``: the recording of a run in the rerun viewer."""

from __future__ import annotations

from pathlib import Path

import click

from scanchain.commands.options import check_output
from scanchain.errors import InputError


@click.command()
@click.argument("directory", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--web", is_flag=True, help="Serve it to a browser on this machine, until Ctrl-C.")
@click.option(
    "--png",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Draw trajectory, ground truth and map to a PNG instead.",
)
@click.option("--force", is_flag=True, help="Replace an existing picture.")
def view(directory: Path, web: bool, png: Path | None, force: bool) -> None:
    """Open the recording of a run in the rerun viewer, or draw its map to a picture.

    DIR is a directory of run, localize, merge or changes, or a .rrd file; a picture needs a trajectory.

    \b
    Examples:
      scanchain view runs/log
      scanchain view runs/log --web
      scanchain view runs/log --png log.png
    """
    from scanchain.commands.terminal import Terminal

    if not directory.exists():
        raise InputError(
            f"{directory}: no such directory or file; check the path (scanchain run makes it by --out)"
        )
    if png is not None:
        from scanchain_viz.pictures.maps import draw_run

        check_output(png, force=force, endings=(".png",))
        draw_run(directory, png)
        click.echo(png)
        return
    path = directory / "recording.rrd" if directory.is_dir() else directory
    if not path.exists():
        raise InputError(
            f"{directory}: holds no recording.rrd; scanchain run writes it unless --rerun leaves out save"
        )
    if path.suffix != ".rrd":
        raise InputError(f"{path}: is no recording (.rrd); give a run directory")
    from scanchain_viz.recording.viewer import show

    with Terminal("recordings"):  # SIGTERM ends it like Ctrl-C: the server goes with it
        show(path, click.echo, in_browser=web)
