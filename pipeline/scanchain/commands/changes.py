"""``scanchain changes``: what appeared, vanished and moved between two maps of a place."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from scanchain.commands.options import NumberRange, threads_option
from scanchain.errors import InputError

if TYPE_CHECKING:
    from scanchain.data import Pose

_PATH = click.Path(path_type=Path)
_ABOVE_ZERO = NumberRange(0.0, min_open=True)


@click.command()
@click.argument("earlier", metavar="RUN_A", type=_PATH)
@click.argument("later", metavar="[RUN_B]", required=False, type=_PATH)
@click.option("--out", required=True, metavar="DIR", type=_PATH, help="Directory to create.")
@click.option("--aligned", is_flag=True, help="Both maps are in one frame already.")
@click.option(
    "--transform",
    metavar="X,Y[,Z],YAW",
    help="Pose of RUN_B's frame in RUN_A's, meters and degrees. [default: found]",
)
@click.option("--voxel", type=_ABOVE_ZERO, metavar="METERS", help="Resolution. [default: maps.voxel_size_m]")
@click.option(
    "--min-size",
    type=_ABOVE_ZERO,
    default=0.2,
    show_default=True,
    metavar="METERS",
    help="Least length of a change; what is smaller is unknown.",
)
@threads_option
@click.option("--force", is_flag=True, help="Replace an existing comparison once the new one is complete.")
@click.option("--json", "as_json", is_flag=True, help="Print metrics.json instead of the summary.")
def changes(
    earlier: Path,
    later: Path | None,
    out: Path,
    aligned: bool,
    transform: str | None,
    voxel: float | None,
    min_size: float,
    force: bool,
    as_json: bool,
) -> None:
    """Compare two maps of one place: what appeared, what vanished, what moved.

    RUN_A and RUN_B are directories of runs; RUN_B is found in RUN_A by loop closures. Of a merged map alone, its
    newest session is compared with all before it. A change is named only where the scans of the other map look
    through the place; what was not seen is unknown.

    Writes changes.ply (label 0 same, 1 appeared, 2 vanished, 3 unknown), changes.csv and .parquet with a row
    for each cluster, summary.txt, metrics.json, report.html and recording.rrd.

    \b
    Examples:
      scanchain changes runs/monday runs/friday --out runs/week
      scanchain changes runs/merged --out runs/newest
      scanchain changes runs/a runs/b --transform 1.5,-0.2,180 --out runs/ab
    """
    from scanchain.api import present_changes
    from scanchain.commands.terminal import Terminal
    from scanchain.sessions.change_run import METRICS_FILE, SUMMARY_FILE, compare_maps

    if aligned and transform is not None:
        raise click.UsageError("--aligned and --transform are both given; give one of them")
    if later is None and (aligned or transform is not None):
        raise click.UsageError("--aligned and --transform are for two maps; give RUN_B, or leave them out")
    T = _pose(earlier, "0,0,0" if aligned else transform)
    with Terminal("maps") as terminal:
        compare_maps(
            [earlier] if later is None else [earlier, later],
            out,
            present_changes,
            terminal.say,
            T_earlier_later=T,
            voxel_size_m=voxel,
            min_size_m=min_size,
            force=force,
        )
    click.echo((out / (METRICS_FILE if as_json else SUMMARY_FILE)).read_text(encoding="utf-8"), nl=False)
    if not as_json:
        click.echo(f"written        {out}")


def _pose(earlier: Path, text: str | None) -> Pose | None:
    """The transform of a position and a heading."""
    import numpy as np

    from scanchain import lie
    from scanchain.maps import open_saved_map

    if text is None:
        return None
    try:
        numbers = [float(word) for word in text.split(",")]
        x, y, *z, yaw_deg = numbers
        pose = lie.pose_2d(x, y, np.radians(yaw_deg))
        if not np.isfinite(numbers).all() or len(z) > 1:
            raise ValueError
    except ValueError:
        raise InputError(f"--transform is {text!r}; give X,Y,YAW or X,Y,Z,YAW in meters and degrees") from None
    if open_saved_map(earlier).dimension == 2:
        return pose
    pose = lie.lift(pose)
    pose[2, 3] = sum(z)
    return pose
