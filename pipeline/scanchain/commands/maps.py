"""``scanchain map``, ``localize``, ``merge`` and ``changes``: maps, their changes, and logs localized in them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands import options
from scanchain.commands.options import ABOVE_ZERO, PATH, OverrideCommand
from scanchain.errors import counted

if TYPE_CHECKING:
    from scanchain.data import Pose
    from scanchain.maps import SavedMap


@click.group("map")
def map_group() -> None:
    """Maps from elsewhere.

    \b
    Examples:
      scanchain map import site.laz --out maps/site
    """


@map_group.command("import")
@click.argument("file", metavar="FILE", type=PATH)
@options.out()
@click.option(
    "--spacing",
    "spacing_m",
    type=ABOVE_ZERO,
    metavar="METERS",
    help="Distance between the positions that the map is seen from. [default: 1.5 in the plane, 6 in space]",
)
@click.option(
    "--height",
    "height_m",
    type=ABOVE_ZERO,
    default=1.6,
    metavar="METERS",
    help="Of the lidar above the ground.",
)
@options.force("an existing map once the new one is complete")
def import_file(file: Path, out: Path, **given: Any) -> None:
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
        made = import_map(file, out, say=terminal.say, command=sys.argv, **given)
    for note in made.notes:
        click.echo(f"warning: {note}", err=True)
    click.echo(
        f"{out}: {made.dimension}D map of {counted(made.points, 'point')}, seen from "
        f"{counted(made.keyframes, 'position')} {made.spacing_m:g} m apart"
    )


@click.command(cls=OverrideCommand, options_metavar="--map RUN --out DIR [OPTIONS] [--section.key VALUE]...")
@options.logs
@click.option("--map", "prior", required=True, metavar="RUN", type=PATH, help="Run directory or map.")
@options.result("an existing directory once the new one is complete")
@click.option(
    "--initial",
    metavar="X,Y,YAW|FILE.tum",
    help="Pose of the first scan in the map: meters and degrees, or a TUM file. [default: searched for]",
)
@options.of_log
@options.strict
def localize(prior: Path, out: Path, initial: str | None, strict: bool, as_json: bool, **given: Any) -> int:
    """Find a log in the map of an earlier run, and follow it there.

    Without --initial the place is searched for anywhere in the map. Exit code 1: the log is not from this place.

    \b
    Examples:
      scanchain localize monday.mcap --map runs/sunday --out runs/monday
      scanchain localize monday.mcap --map runs/sunday --out runs/monday --initial 12.5,-3,90
      scanchain localize part_0.mcap part_1.mcap --map runs/sunday --out runs/monday --topic /points
    """
    options.collect_garbage_seldom()
    from scanchain.commands.terminal import Terminal
    from scanchain.runs.job import Job
    from scanchain.sessions.localize import localize as localize_log
    from scanchain_viz.recording.results import present_localization

    job = Job(out=out, command=tuple(sys.argv), **given)
    first = None if initial is None else _initial(initial)
    with Terminal("scans") as terminal:
        localized = localize_log(job, prior, terminal, present_localization, initial=first)
    fails = localized.metrics.verdict.fails(strict=strict)
    if fails and as_json:  # otherwise the summary shows the verdict
        click.echo(f"error: {out}: {localized.metrics.judged.sentence}", err=True)
    options.print_summary(out, localized.summary, as_json=as_json)
    return int(fails)


def _initial(text: str) -> Callable[[int, SavedMap], Pose]:
    from scanchain.sessions.localize import pose_in_file, pose_near

    if text.endswith(".tum"):
        return pose_in_file(Path(text))
    wrong = f"--initial is {text!r}; give x,y,yaw in meters and degrees, or a file .tum"
    return pose_near(*options.numbers(text, (3,), wrong))


@click.command(cls=OverrideCommand, options_metavar="--out DIR [OPTIONS] [--section.key VALUE]...")
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=PATH)
@options.result("DIR if it is the result of an earlier run or merge")
@options.config
@click.option("--fixed", is_flag=True, help="Leave the poses of the first RUN as they are.")
@click.option("--update", is_flag=True, help="Remove from older sessions what newer ones saw through.")
@options.threads
def merge(runs: tuple[Path, ...], out: Path, fixed: bool, update: bool, as_json: bool, **given: Any) -> None:
    """Merge the maps of several runs into one map in one frame.

    RUN is a run directory, or that of an earlier merge; where each began need not be known. Loops are closed
    between the runs, and the graph of all of them is optimized and certified. The map is in the frame of the first
    RUN; the order of the others does not matter. Runs that too few closures join to the others, or ambiguous
    places only, are named and stay apart; where no two belong together, the exit code is 1. DIR is a map like any
    other: it can be merged further. With --update it follows its newest session: what is gone is removed from the
    keyframes of older ones.

    \b
    Examples:
      scanchain merge runs/monday runs/tuesday --out runs/both
      scanchain merge runs/survey runs/today --fixed --out runs/extended
      scanchain merge runs/both runs/wednesday --update --out runs/week --json
    """
    from scanchain.commands.terminal import Terminal
    from scanchain.runs.job import Job
    from scanchain.sessions.merging import merge as merge_maps
    from scanchain_viz.recording.results import present_merge

    job = Job(runs, out, command=tuple(sys.argv), **given)
    with Terminal("maps") as terminal:
        merged = merge_maps(job, terminal, present_merge, fixed=fixed, update=update)
    options.print_summary(out, merged.summary, as_json=as_json)


@click.command()
@click.argument("earlier", metavar="RUN_A", type=PATH)
@click.argument("later", metavar="[RUN_B]", required=False, type=PATH)
@options.result("an existing comparison once the new one is complete")
@click.option("--aligned", is_flag=True, help="Both maps are in one frame already.")
@click.option(
    "--transform",
    metavar="X,Y[,Z],YAW",
    help="Pose of RUN_B's frame in RUN_A's, meters and degrees. [default: found]",
)
@click.option(
    "--voxel", "voxel_size_m", type=ABOVE_ZERO, metavar="METERS", help="Resolution. [default: maps.voxel_size_m]"
)
@click.option(
    "--min-size",
    "min_size_m",
    type=ABOVE_ZERO,
    default=0.2,
    metavar="METERS",
    help="Least length of a change; what is smaller is unknown.",
)
@options.threads
def changes(
    earlier: Path, later: Path | None, out: Path, aligned: bool, transform: str | None, as_json: bool, **given: Any
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
    from scanchain.commands.terminal import Terminal
    from scanchain.runs.directory import SUMMARY_FILE
    from scanchain.sessions.change_run import compare_maps
    from scanchain_viz.recording.results import present_changes

    if aligned and transform is not None:
        raise click.UsageError("--aligned and --transform are both given; give one of them")
    if later is None and (aligned or transform is not None):
        raise click.UsageError("--aligned and --transform are for two maps; give RUN_B, or leave them out")
    maps = [earlier] if later is None else [earlier, later]
    T = _pose(earlier, "0,0,0" if aligned else transform)
    with Terminal("maps") as terminal:
        compare_maps(maps, out, present_changes, terminal.say, T_earlier_later=T, command=sys.argv, **given)
    options.print_summary(out, (out / SUMMARY_FILE).read_text(encoding="utf-8"), as_json=as_json)


def _pose(earlier: Path, text: str | None) -> Pose | None:
    import numpy as np

    from scanchain import lie
    from scanchain.maps import open_saved_map

    if text is None:
        return None
    wrong = f"--transform is {text!r}; give X,Y,YAW or X,Y,Z,YAW in meters and degrees"
    x, y, *z, yaw_deg = options.numbers(text, (3, 4), wrong)
    pose = lie.pose_2d(x, y, np.radians(yaw_deg))
    if open_saved_map(earlier).dimension == 2:
        return pose
    pose = lie.lift(pose)
    pose[2, 3] = sum(z)
    return pose
