"""``scanchain info``, ``doctor``, ``convert`` and ``simulate``: inspect, check, convert and simulate logs."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands import options
from scanchain.commands.options import PATH, OverrideCommand
from scanchain.errors import InputError, counted, folded
from scanchain.files import Source, json_text, source_of
from scanchain.settings import Override, load_settings

if TYPE_CHECKING:
    from scanchain.config import Config
    from scanchain.logs.doctor import Diagnosis

# keys that convert accepts
_KEYS = tuple(f"log.{key}" for key in ("format", "rate_hz", "bin_columns", "topic", "start_s", "end_s", "every"))


@click.command(cls=OverrideCommand)
@options.logs
@options.part()
@options.as_json
def info(logs: tuple[Source, ...], as_json: bool, overrides: tuple[Override, ...]) -> int:
    """Print the topics of a log with types and rates, and which of them a run with the same flags would use.

    Exit code 1: such a run would be refused, for the reason named as problem.

    \b
    Examples:
      scanchain info log.mcap
      scanchain info part_0.mcap part_1.mcap --json
      scanchain info drive.bag --topic /lidar_front/points
      scanchain info https://host/log.mcap
    """
    from scanchain.logs.info import describe

    config = load_settings(overrides=overrides).config
    found = describe(logs, config.log, uses_imu=config.odometry.imu)
    click.echo(json_text(found) if as_json else _info_text(found))
    return int(bool(found["problem"]))


def _info_text(log: dict[str, Any]) -> str:
    start = datetime.fromtimestamp(log["start_ns"] * 1e-9, UTC).isoformat(sep=" ", timespec="milliseconds")
    lines = [
        f"files     {', '.join(log['files'])} ({log['size_bytes'] / 1e6:.1f} MB)",
        f"time      {log['duration_s']:.1f} s from {start}",
    ]
    width = max((len(topic["topic"]) for topic in log["topics"]), default=0)
    for topic in log["topics"]:
        messages = f"{topic['messages']:>8,} {'message ' if topic['messages'] == 1 else 'messages'}"
        name = f"{topic['topic']:<{width}}  {topic['type_name'] or 'no schema':<28}"
        lines.append(f"topic     {name}  {messages}  {topic['rate_hz']:7.1f} Hz  {topic['encoding']}")
    if log["lidar"]:
        import numpy as np

        from scanchain.logs.mounting import place_text

        at = f"at {place_text(np.array(log['T_base_lidar']), log['base_frame'])}"
        if not log["base_frame"]:
            at = "assumed at the robot's origin: no transform states it" + (
                "; a run estimates it from the wheels" if log["odometry"] else ""
            )
        lines += [
            f"lidar     {log['lidar']}: {log['dimension']}D, {counted(log['scans'], 'scan')}",
            f"mounting  {at}" + (f" at first; {log['mount_motion']}" if log["mount_motion"] else ""),
        ]
    if log["lidar"] or log["odometry"]:
        lines.append(f"wheels    {log['wheels'] or 'none: the motion is predicted from the scans alone'}")
    if log["point_times"]:
        lines.append(f"times     {log['point_times'].removeprefix('point times: ')}")
    lines += [f"sensor    {each.sensor} {each.topic}: {each.use}" for each in log["sensors"]]
    lines += [f"note      {note}" for note in log["notes"]]
    lines += [f"damage    {line}" for line in log["damage"]]
    return "\n".join([*lines, *([f"problem   {log['problem']}"] if log["problem"] else [])])


@click.command(cls=OverrideCommand)
@options.logs
@options.part()
@options.as_json
def doctor(logs: tuple[Source, ...], as_json: bool, overrides: tuple[Override, ...]) -> None:
    """Check every scan of a log: problems, their effect on the result, and the flags that fix them.

    Any configuration key is a flag, as for scanchain run, so that a fix can be tried.

    \b
    Examples:
      scanchain doctor log.mcap
      scanchain doctor drive.bag --topic /lidar_front/points --json
      scanchain doctor log.mcap --log.point_times ms
    """
    from scanchain.calibration import delay_of_wheels
    from scanchain.commands.terminal import Terminal
    from scanchain.logs import Log
    from scanchain.logs.doctor import examine
    from scanchain.odometry.distortion import measure_distortion

    def config_for(dimension: int) -> Config:
        return load_settings(dimension, overrides=overrides).config

    def distortion_of(log: Log) -> tuple[str, str]:
        found = measure_distortion(log)
        if found is None:
            return "", ""
        said, remedy = found.advice(log)
        return f"{said}: {found.changes}", remedy

    with Terminal("scans") as terminal:
        log_config = load_settings(overrides=overrides).config.log
        found = examine(logs, config_for, log_config, terminal.count, distortion_of, delay_of_wheels)
    click.echo(json_text(found) if as_json else folded(_doctor_text(found)))


def _doctor_text(found: Diagnosis) -> str:
    lines = [f"{', '.join(found.files)} {found.topic} ({found.dimension}D)"]
    for finding in found.findings:
        lines.append(f"{finding.severity:<8} {finding.check:<12} {finding.found}")
        fix = finding.fix and f"→ {finding.fix}"
        lines += [f"{'':<21} {line}" for line in (finding.effect, fix) if line]
    return "\n".join([*lines, *(f"{'note':<21} {note}" for note in found.notes)])


@click.command(cls=OverrideCommand, options_metavar="[OPTIONS] [--log.key VALUE]...")
@click.argument("source", metavar="SRC", type=source_of)
@click.argument("destination", metavar="DST.mcap", type=PATH)
@options.key(
    "--rate",
    "log.rate_hz",
    metavar="HZ",
    help="Scan rate of a folder of clouds without stamps; short for --log.rate_hz.",
)
@options.part(topic="all of them")
@options.force("an existing file")
@options.as_json
def convert(
    source: Source, destination: Path, force: bool, as_json: bool, overrides: tuple[Override, ...]
) -> None:
    """Convert a log of another format to MCAP, or cut one. The other commands read all of these formats directly.

    \b
    SRC is one of
      an MCAP file        to cut it: --start, --end, --every, --topic
      a CARMEN log        .log or .clf, also .bz2 or .gz: FLASER, ROBOTLASER1, ODOM, TRUEPOS
      a ROS 1 bag         .bag
      a ROS 2 bag         .db3, or its folder
      split files         the folder of .mcap, .bag or .db3 files that are parts of one log
      a KITTI raw drive   ..._sync, calib_imu_to_velo.txt next to it for the ground truth
      KITTI odometry      sequences/00, poses/00.txt next to sequences for the ground truth
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
    for override in overrides:
        if override.key not in _KEYS:
            raise InputError(f"{override.flag} has no meaning for convert; its keys are {', '.join(_KEYS)}")
    config = load_settings(overrides=overrides).config.log
    from scanchain.commands.terminal import Terminal
    from scanchain.logs.convert import convert as convert_log

    with Terminal("messages") as terminal:
        done = convert_log([source], destination, config=config, force=force, progress=terminal.count)
    for line in done.damage:
        click.echo(f"warning: {line}", err=True)
    if as_json:
        reported = {"path": str(done.path), "messages": done.messages, "notes": done.notes, "damage": done.damage}
        click.echo(json_text(reported))
        return
    for note in done.notes:
        click.echo(f"note: {note}", err=True)
    click.echo(f"{done.path}: {', '.join(f'{count:,} {topic}' for topic, count in done.messages.items())}")


@click.command()
@click.argument("world", metavar="WORLD")
@click.argument("destination", metavar="DST.mcap", type=PATH)
@click.option("--seed", default=0, metavar="N", help="Random seed; the same seed gives the same bytes.")
@click.option(
    "--duration", "duration_s", type=float, metavar="SECONDS", help="Length of the drive. [default: the world's]"
)
@click.option("--sensor", metavar="NAME", help="Lidar: lms-270, utm-30, hdl-64, os1-32, vlp-16 or rosette.")
@click.option("--imu", metavar="NAME", help="Add an IMU at 200 Hz, one of those above. [default: none]")
@click.option("--gnss", metavar="NAME", help="Add a GNSS receiver at 10 Hz, one of those above. [default: none]")
@click.option("--drift", default=1.0, metavar="FACTOR", help="Scale of the errors of the wheel odometry.")
@click.option(
    "--wheels-slip",
    nargs=3,
    type=float,
    metavar="START END METERS",
    help="Let the wheels turn so far ahead between these seconds, and the robot not move by it.",
)
@click.option(
    "--wheels-delay",
    "wheels_delay_s",
    default=0.0,
    metavar="SECONDS",
    help="How late the stamps of the wheels are.",
)
@click.option(
    "--noise",
    "noise_m",
    type=float,
    metavar="METERS",
    help="Standard deviation of the ranges. [default: the sensor's]",
)
@click.option(
    "--dropout", type=float, metavar="SHARE", help="Share of returns that are lost. [default: the sensor's]"
)
@click.option(
    "--changed",
    type=click.IntRange(0),
    metavar="N",
    help="Drive again on another day, number N: furniture or parked cars came, went and moved.",
)
@click.option("--reverse", is_flag=True, help="Drive the route the other way round.")
@click.option("--start-at", "start_m", default=0.0, metavar="METERS", help="Begin so far along the route.")
@click.option(
    "--pace",
    default=1.0,
    metavar="FACTOR",
    help="Drive so many times as fast; at 1.67 the world turns has turns of 200 deg/s.",
)
@options.force("an existing file")
def simulate(world: str, destination: Path, wheels_slip: tuple[float, float, float] | None, **given: Any) -> None:
    """Write a synthetic log with exact ground truth, and the truth next to it as .tum.

    \b
    WORLD is one of
      office     rooms and corridors, 2D laser scanner
      town       streets on rolling ground
      rounds     the town without parked cars, its streets driven again in both directions
      identical  identical corridors and rooms, 2D laser scanner
      highway    guard rails and signs at 25 m/s, from the first scan on
      corridor   80 m between bare walls: motion along it is unobservable but at its ends
      field      flat, a few poles far apart: between them only the ground is visible
      forest     trunks and crowns on rough ground
      staircase  four stories, walked with a handheld lidar
      hall       flat floor, few pillars, from standstill to 5 m/s
      turns      turns on the spot at 120 deg/s and short moves in a yard
      gap        the town, but one second of scans is missing in a bend, and one on a straight
    All but office and identical are driven with a 3D lidar by default. With --changed the world is the one of the
    same seed, and what is different in it (in office, identical, town, rounds, gap) is listed in DST.changes.csv.

    \b
    NAME of the IMU is one of
      ideal              without errors
      mems               noise, bias and its random walk as of a factory-calibrated MEMS IMU
      mems-g             acceleration in g in place of m/s²
      mems-degrees       angular velocity in deg/s in place of rad/s
      mems-sign          angular velocity of the wrong sign
      mems-frozen        values stop changing after 10 s
      mems-saturated     angular velocity limited to 60 deg/s about each axis
      mems-late          stamps 0.3 s late
      mems-half-late     stamps half a sample late
      mems-vibration     mounted on an engine: 3 deg/s and 3 m/s² of noise
      mems-no-transform  mounted on its side, without a transform
    Its topic is /imu/data, its frame imu_link, turned by 90 deg about z on base_link.

    \b
    GNSS receivers:
      standard            1.7 m east and north, 3 m in height, slowly changing
      standard-multipath  the same, and wrong by 5 to 20 m half of the time
      standard-outages    no fix from 10 to 25 s, and from 40 to 60 s
      rtk                 9 mm east and north, 15 mm in height
      rtk-multipath       the same, and wrong by 5 to 20 m half of the time
    Its topic is /fix, its frame gnss_link.

    \b
    Examples:
      scanchain simulate office office.mcap
      scanchain simulate town town.mcap --duration 20 --seed 3
      scanchain simulate highway fast.mcap --sensor os1-32
      scanchain simulate office later.mcap --changed 1
      scanchain simulate town sparse.mcap --sensor vlp-16 --noise 0.05 --dropout 0.1
      scanchain simulate town again.mcap --changed 1 --reverse --start-at 100
      scanchain simulate office slips.mcap --wheels-slip 20 24 3
      scanchain simulate turns imu.mcap --imu mems --pace 1.67
      scanchain simulate town gnss.mcap --gnss standard-multipath
    """
    if destination.suffix != ".mcap":
        raise InputError(f"{destination}: does not end in .mcap; name it {destination.with_suffix('.mcap')}")
    from scanchain.commands.terminal import Terminal
    from scanchain.simulation import NO_SLIP, Slip
    from scanchain.simulation import simulate as simulate_log

    with Terminal("scans") as terminal:
        truth = simulate_log(
            world,
            destination,
            wheels_slip=NO_SLIP if wheels_slip is None else Slip(*wheels_slip),
            progress=terminal.count,
            **given,
        )
    size_mb = destination.stat().st_size / 1e6
    click.echo(
        f"{destination}: {counted(len(truth), 'scan')}, {size_mb:.1f} MB; ground truth in it and in "
        f"{destination.with_suffix('.tum')}"
    )
