"""``scanchain convert``: logs of other formats to MCAP."""

from __future__ import annotations

import json
from pathlib import Path

import click

from pipeline.commands.log_type import LOG
from pipeline.commands.override_command import OnceCommand
from pipeline.errors import InputError
from pipeline.source import Source


@click.command(cls=OnceCommand)
@click.argument("source", metavar="SRC", type=LOG)
@click.argument("destination", metavar="DST.mcap", type=click.Path(path_type=Path))
@click.option(
    "--rate", default=0.0, metavar="HZ", help="How often scans come whose files are not named by their stamps."
)
@click.option("--force", is_flag=True, help="Replace an existing file.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def convert(source: Source, destination: Path, rate: float, force: bool, as_json: bool) -> None:
    """Write a log of another format as MCAP. The other commands take all of these as they are, too.

    \b
    SRC is one of
      a CARMEN log        .log or .clf, also .bz2 or .gz: FLASER, ROBOTLASER1, ODOM, TRUEPOS
      a ROS 1 bag         .bag
      a ROS 2 bag         .db3, or its folder
      split files         the folder of .mcap, .bag or .db3 files that are parts of one log
      a KITTI raw drive   ..._sync, calib_imu_to_velo.txt beside it for the ground truth
      KITTI odometry      sequences/00, poses/00.txt beside sequences for the ground truth
      an address          https:// or s3://, of any of the files above
      a folder of clouds  PCD, PLY, or .bin of float32 x y z intensity, named by their stamps, or with --rate

    \b
    Examples:
      scanchain convert intel.clf.bz2 intel.mcap
      scanchain convert 2011_09_26/2011_09_26_drive_0001_sync kitti_0001.mcap
      scanchain convert scans/ scans.mcap --rate 10
      scanchain convert drive.bag drive.mcap --json
    """
    if rate < 0.0:
        raise InputError(f"--rate is {rate:g} Hz; it must be positive")
    from pipeline.commands.terminal import Terminal
    from pipeline.logs.convert import convert as convert_log

    with Terminal("messages") as terminal:
        done = convert_log([source], destination, rate_hz=rate, force=force, progress=terminal.count)
    for line in done.damage:
        click.echo(f"warning: {line}", err=True)
    if as_json:
        told = {"path": str(done.path), "messages": done.messages, "notes": done.notes, "damage": done.damage}
        click.echo(json.dumps(told, indent=2))
        return
    for note in done.notes:
        click.echo(f"note: {note}", err=True)
    counted = ", ".join(f"{count:,} {topic}" for topic, count in done.messages.items())
    click.echo(f"{done.path}: {counted}")
