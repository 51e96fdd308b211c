"""``scanchain info``: contents of a log."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

import click

from scanchain.commands.options import OverrideCommand, json_option, json_text, logs_argument, part_options
from scanchain.errors import counted
from scanchain.files import Source
from scanchain.settings import Override, load_settings

if TYPE_CHECKING:
    from scanchain.logs.info import LogInfo


@click.command(cls=OverrideCommand)
@logs_argument
@part_options()
@json_option
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

    found = describe(logs, load_settings(overrides=overrides).config.log)
    click.echo(json_text(found) if as_json else _text(found))
    return int(bool(found.problem))


def _text(log: LogInfo) -> str:
    start = datetime.fromtimestamp(log.start_ns * 1e-9, UTC).isoformat(sep=" ", timespec="milliseconds")
    lines = [
        f"files     {', '.join(log.files)} ({log.size_bytes / 1e6:.1f} MB)",
        f"time      {log.duration_s:.1f} s from {start}",
    ]
    width = max((len(topic.topic) for topic in log.topics), default=0)
    for topic in log.topics:
        messages = f"{topic.messages:>8,} {'message ' if topic.messages == 1 else 'messages'}"
        name = f"{topic.topic:<{width}}  {topic.type_name or 'no schema':<28}"
        lines.append(f"topic     {name}  {messages}  {topic.rate_hz:7.1f} Hz  {topic.encoding}")
    if log.lidar:
        import numpy as np

        from scanchain.logs.mounting import turned_by

        T_base_lidar = np.array(log.T_base_lidar)
        place = ", ".join(f"{axis} {at_m:.3f} m" for axis, at_m in zip("xyz", T_base_lidar[:-1, -1], strict=False))
        turned = turned_by(T_base_lidar)
        lines += [
            f"lidar     {log.lidar}: {log.dimension}D, {counted(log.scans, 'scan')}",
            f"mounting  at {place} on {log.base_frame or 'the base'}{turned and f', turned by {turned}'}"
            + (f" at first; {log.mount_motion}" if log.mount_motion else ""),
        ]
    if log.lidar or log.odometry:
        lines.append(f"wheels    {log.odometry or 'none: the motion is predicted from the scans alone'}")
    if log.point_times:
        lines.append(f"times     {log.point_times.removeprefix('point times: ')}")
    lines += [f"sensor    {each.sensor} {each.topic}: {each.use}" for each in log.sensors]
    lines += [f"note      {note}" for note in log.notes]
    lines += [f"damage    {line}" for line in log.damage]
    return "\n".join([*lines, *([f"problem   {log.problem}"] if log.problem else [])])
