"""``scanchain map``: maps from elsewhere."""

from __future__ import annotations

from pathlib import Path

import click

from scanchain.commands.options import NumberRange
from scanchain.errors import counted

_PATH = click.Path(path_type=Path)
_ABOVE_ZERO = NumberRange(0.0, min_open=True)


@click.group("map")
def map_group() -> None:
    """Maps from elsewhere.

    \b
    Examples:
      scanchain map import site.laz --out maps/site
    """


@map_group.command("import")
@click.argument("file", metavar="FILE", type=_PATH)
@click.option("--out", required=True, metavar="DIR", type=_PATH, help="Directory to create.")
@click.option(
    "--spacing",
    type=_ABOVE_ZERO,
    metavar="METERS",
    help="Distance between the positions that the map is seen from. [default: 1.5 in the plane, 6 in space]",
)
@click.option(
    "--height",
    type=_ABOVE_ZERO,
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
