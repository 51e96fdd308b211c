"""``scanchain convert``: logs of other formats to MCAP."""

from __future__ import annotations

import json
from pathlib import Path

import click

from scanchain.commands.options import LOG, OverrideCommand, key_option, overrides, part_options
from scanchain.errors import InputError
from scanchain.files import Source
from scanchain.settings import load_settings

_KEYS = tuple(f"log.{name}" for name in ("format", "rate_hz", "topic", "start_s", "end_s", "every"))


@click.command(cls=OverrideCommand, options_metavar="[OPTIONS] [--log.key VALUE]...")
@click.argument("source", metavar="SRC", type=LOG)
@click.argument("destination", metavar="DST.mcap", type=click.Path(path_type=Path))
@key_option(
    "--rate",
    "log.rate_hz",
    metavar="HZ",
    help="Scan rate of a folder of clouds without stamps; short for --log.rate_hz.",
)
@part_options(topic="all of them")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.pass_context
def convert(
    ctx: click.Context,
    source: Source,
    destination: Path,
    force: bool,
    as_json: bool,
) -> None:
    """Convert a log of another format to MCAP, or cut one. The other commands read all of these formats directly.

    \b
    SRC is one of
      an MCAP file        to cut it: --start, --end, --every, --topic
      a CARMEN log        .log or .clf, also .bz2 or .gz: FLASER, ROBOTLASER1, ODOM, TRUEPOS
      a ROS 1 bag         .bag
      a ROS 2 bag         .db3, or its folder
      split files         the folder of .mcap, .bag or .db3 files that are parts of one log
      a KITTI raw drive   ..._sync, calib_imu_to_velo.txt beside it for the ground truth
      KITTI odometry      sequences/00, poses/00.txt beside sequences for the ground truth
      an address          https:// or s3://, of any of the files above
      a folder of clouds  PCD, PLY, .npy or .bin of rows x y z (intensity ...), named by their stamps, or with
                          --log.rate_hz
      a format of yours   read by a class of your own, --log.format my_module:MyFormat

    Messages are copied unchanged. --start, --end, --every and --topic (one of several lidars) choose a part.

    \b
    Examples:
      scanchain convert intel.clf.bz2 intel.mcap
      scanchain convert 2011_09_26/2011_09_26_drive_0001_sync kitti_0001.mcap
      scanchain convert scans/ scans.mcap --rate 10
      scanchain convert drive.bag minute.mcap --start 60 --end 120
      scanchain convert drive.bag drive.mcap --json
    """
    chosen = overrides(ctx)
    for override in chosen:
        if override.key not in _KEYS:
            raise InputError(f"{override.flag} has no meaning for convert; its keys are {', '.join(_KEYS)}")
    config = load_settings(overrides=chosen).config.log
    from scanchain.commands.terminal import Terminal
    from scanchain.logs.convert import convert as convert_log

    with Terminal("messages") as terminal:
        done = convert_log([source], destination, config=config, force=force, progress=terminal.count)
    for line in done.damage:
        click.echo(f"warning: {line}", err=True)
    if as_json:
        reported = {"path": str(done.path), "messages": done.messages, "notes": done.notes, "damage": done.damage}
        click.echo(json.dumps(reported, indent=2))
        return
    for note in done.notes:
        click.echo(f"note: {note}", err=True)
    counted = ", ".join(f"{count:,} {topic}" for topic, count in done.messages.items())
    click.echo(f"{done.path}: {counted}")
