"""``scanchain map``, ``merge`` and ``changes``: maps of a place, imported, merged and compared."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands.options import (
    ABOVE_ZERO,
    PATH,
    OverrideCommand,
    config_option,
    overrides,
    print_summary,
    result_options,
    threads_option,
)
from scanchain.errors import InputError, counted


@click.group("map")
def map_group() -> None:
    """Maps from elsewhere.

    \b
    Examples:
      scanchain map import site.laz --out maps/site
    """


@map_group.command("import")
@click.argument("file", metavar="FILE", type=PATH)
@click.option("--out", required=True, metavar="DIR", type=PATH, help="Directory to create.")
@click.option(
    "--spacing",
    type=ABOVE_ZERO,
    metavar="METERS",
    help="Distance between the positions that the map is seen from. [default: 1.5 in the plane, 6 in space]",
)
@click.option(
    "--height",
    type=ABOVE_ZERO,
    default=1.6,
    show_default=True,
    metavar="METERS",
    help="Of the lidar above the ground.",
)
@click.option("--force", is_flag=True, help="Replace an existing map once the new one is complete.")
def import_file(file: Path, out: Path, spacing: float | None, height: float, force: bool) -> None:
    """Make a map to localize in of a point cloud or an occupancy grid.

    FILE is a cloud in meters, z up (.ply, .pcd, .laz, .las, .npy), or map.yaml of nav2's or ROS 1's map_server
    with its image. The cloud is seen from positions on a grid, where a lidar could be; points that
    others hide are not.

    \b
    Examples:
      scanchain map import site.laz --out maps/site
      scanchain map import office/map.yaml --out maps/office
      scanchain localize log.mcap --map maps/office --out runs/log
    """
    from scanchain.commands.terminal import Terminal
    from scanchain.sessions.elsewhere import import_map

    with Terminal("positions") as terminal:
        made = import_map(file, out, spacing_m=spacing, height_m=height, force=force, say=terminal.say)
    click.echo(
        f"{out}: {made.dimension}D map of {counted(made.points, 'point')}, seen from "
        f"{counted(made.keyframes, 'position')} {made.spacing_m:g} m apart"
    )


@click.command(cls=OverrideCommand, options_metavar="--out DIR [OPTIONS] [--section.key VALUE]...")
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@result_options("DIR if it is the result of an earlier run or merge")
@config_option
@click.option("--fixed", is_flag=True, help="Leave the poses of the first RUN as they are.")
@click.option("--update", is_flag=True, help="Remove from older sessions what newer ones saw through.")
@threads_option
@click.pass_context
def merge(
    ctx: click.Context,
    runs: tuple[Path, ...],
    out: Path,
    as_json: bool,
    **options: Any,
) -> None:
    """Merge the maps of several runs into one map in one frame.

    RUN is a run directory, or that of an earlier merge; where each began need not be known. Loops are closed
    between the runs, and the graph of all of them is optimized and certified. The map is in the frame of the first
    RUN; the order of the others does not matter. Runs that too few closures join to the others, or look-alike
    places only, are named and stay apart; where no two belong together, the exit code is 1. DIR is a map like any
    other: it can be merged further. With --update it follows its newest session: what is gone is removed from the
    keyframes of older ones.

    \b
    Examples:
      scanchain merge runs/monday runs/tuesday --out runs/both
      scanchain merge runs/survey runs/today --fixed --out runs/extended
      scanchain merge runs/both runs/wednesday --update --out runs/week --json
    """
    from scanchain.api import present_merge
    from scanchain.commands.terminal import Terminal
    from scanchain.sessions.merging import merge as merge_maps

    with Terminal("maps") as terminal:
        merged = merge_maps(
            runs, out, terminal, present_merge, overrides=overrides(ctx), command=tuple(sys.argv), **options
        )
    print_summary(out, merged.summary, as_json=as_json)


if TYPE_CHECKING:
    from scanchain.data import Pose


@click.command()
@click.argument("earlier", metavar="RUN_A", type=PATH)
@click.argument("later", metavar="[RUN_B]", required=False, type=PATH)
@result_options("an existing comparison once the new one is complete")
@click.option("--aligned", is_flag=True, help="Both maps are in one frame already.")
@click.option(
    "--transform",
    metavar="X,Y[,Z],YAW",
    help="Pose of RUN_B's frame in RUN_A's, meters and degrees. [default: found]",
)
@click.option("--voxel", type=ABOVE_ZERO, metavar="METERS", help="Resolution. [default: maps.voxel_size_m]")
@click.option(
    "--min-size",
    type=ABOVE_ZERO,
    default=0.2,
    show_default=True,
    metavar="METERS",
    help="Least length of a change; what is smaller is unknown.",
)
@threads_option
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
    from scanchain.sessions.change_run import SUMMARY_FILE, compare_maps

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
    print_summary(out, (out / SUMMARY_FILE).read_text(encoding="utf-8"), as_json=as_json)


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
